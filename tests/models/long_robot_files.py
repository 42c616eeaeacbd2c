"""What takes long of `test_robot_files.py`."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plain import rk4
from test_robot_files import STEP, chain, model, written

from covariant.models import acceleration, robots

SERVO = {"stiffness": 9.0, "gain": 2.0, "damping": 0.4, "delay": 0.03, "limit": 5.0, "viscous": 0.05, "armature": 0.03}


SERVOS = {"shoulder": SERVO | {"offset": 0.1, "sign": -1, "back_emf": 0.1}, "elbow": SERVO | {"stiffness": 4.0}}


NUMBERS = {"servos": SERVOS, "offsets": {"shoulder": 0.2, "elbow": -0.3}, "payload": {"lower": (0.2, 0.0, 0.1, -0.3)}}


def same_motion(one, other, rtol=1e-9):
    """Whether two models have the same inertia, and the same acceleration with the same inputs."""
    found = [jax.jit(lambda q, v, u, m=m: (m.space(q), acceleration(m, jnp.zeros(()), q, v, u))) for m in (one, other)]
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v = rng.normal(size=(2, len(one.coordinates)))
        u = rng.normal(size=one.inputs)
        for here, there in zip(*(each(q, v, u) for each in found), strict=True):
            np.testing.assert_allclose(there, here, rtol=rtol, atol=1e-10)


@pytest.mark.exhaustive
@pytest.mark.parametrize("suffix", [".xml", ".urdf"])
def test_what_is_written_is_the_same_robot_when_it_is_read_again(suffix, tmp_path, chain):
    """Massless links, slides, offsets, a payload, another friction and rotor: axes and zeros are those of the log."""
    numbers = {
        "offsets": {"pan": 0.3, "tilt": -0.2, "slide": 0.05},
        "payload": {"tool": (0.3, 0.1, 0.0, 0.02)},
        "friction": {"pan": {"viscous": 0.3}},
        "armature": {"tilt": 0.01, "slide": 0.2},
        "inertia": {"arm": (0.7, 0.1, 0.02, 0.03, 0.011, 0.021, 0.016, 0.001, 0.0, 0.002)},
    }
    before = robots.load(chain, **numbers)
    after = robots.load(written(tmp_path, suffix, chain, **numbers))
    assert after.coordinates == before.coordinates
    same_motion(before, after)
    limits = [{name: ends for name, *ends in model.space.limits} for model in (before, after)]
    assert limits[1]["pan"] == pytest.approx(np.array(limits[0]["pan"]) - 0.3)


@pytest.mark.exhaustive
def test_servos_are_those_of_the_model_file_when_mujocos_file_is_read_again(tmp_path):
    before = robots.load("double_pendulum", **NUMBERS)
    after = robots.load(written(tmp_path, ".xml", "double_pendulum", **NUMBERS))
    same_motion(before, after)
    for field in ("delay", "limit", "offset"):
        np.testing.assert_allclose(getattr(after.force.servos, field), getattr(before.force.servos, field))


@pytest.mark.exhaustive
def test_mujoco_follows_commands_as_the_model_does(tmp_path):
    """Open loop over two seconds with saturation, delay, an offset of the servo and a zero that is not the file's."""
    model = robots.load("double_pendulum", **NUMBERS)
    simulated = mujoco.MjModel.from_xml_path(str(written(tmp_path, ".xml", "double_pendulum", **NUMBERS)))
    data, t = mujoco.MjData(simulated), STEP * np.arange(2000)
    held = np.floor(t / 0.02) * 0.02
    commands = np.stack([1.5 * (held > 0.1), 0.5 * np.sin(6 * held)], axis=1)
    late = commands[np.maximum(np.arange(len(t)) - 30, 0)]
    start = jnp.array([0.1, 0.0])

    @jax.jit
    def ours():
        def step(x, u):
            def slope(x):
                return jnp.concatenate([x[2:], acceleration(model, jnp.zeros(()), x[:2], x[2:], u)])

            return rk4(slope, x, STEP), x[:2]

        return jax.lax.scan(step, jnp.concatenate([start, jnp.zeros(2)]), late)[1]

    data.qpos[:] = start
    theirs = np.zeros((len(t), 2))
    for i in range(2):
        mujoco.mj_initCtrlHistory(simulated, data, i, None, np.full(simulated.actuator_history[i, 0], commands[0, i]))
    for k, command in enumerate(commands):
        theirs[k], data.ctrl[:] = data.qpos, command
        mujoco.mj_step(simulated, data)
    # MuJoCo's positions are half a step ahead of its velocities, which are a few rad/s here.
    np.testing.assert_allclose(theirs, ours(), atol=6e-3)
    assert np.abs(theirs - np.asarray(ours())).mean() < 1.5e-3
    assert np.ptp(theirs[:, 0]) > 0.8


def test_mujoco_reads_the_urdf_with_friction_and_inertia(tmp_path):
    numbers = NUMBERS | {"servos": {name: table | {"coulomb": 0.2} for name, table in SERVOS.items()}}
    model = mujoco.MjModel.from_xml_path(str(written(tmp_path, ".urdf", "double_pendulum", **numbers)))
    assert model.dof_damping == pytest.approx([0.15, 0.05])
    assert model.dof_frictionloss == pytest.approx([0.2, 0.2])
    data, full, ours = mujoco.MjData(model), np.zeros((2, 2)), robots.load("double_pendulum", **numbers)
    data.qpos[:] = [0.4, -0.7]
    mujoco.mj_forward(model, data)
    for row, unit in zip(full, np.eye(2), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    # A rotor is an extension of Drake's, which MuJoCo does not read.
    np.testing.assert_allclose(full + 0.03 * np.eye(2), ours.space(jnp.array([0.4, -0.7])), rtol=1e-9)


def test_a_floating_base_and_locked_joints_are_written(tmp_path, chain):
    numbers = {"lock": {"tilt": 0.7, "pan": 0.2}, "floating": True}
    before = robots.load(chain, **numbers)
    after = robots.load(written(tmp_path, ".xml", chain, **numbers))
    q = before.manifold.origin()
    np.testing.assert_allclose(after.space(q), before.space(q), rtol=1e-9, atol=1e-12)
