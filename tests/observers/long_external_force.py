"""What takes long of `test_external_force.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plants import body
from test_external_force import MODEL, PUSH, arm, kalman, pushed_swing

import covariant
from covariant.models import Motion, advance, robots
from covariant.observers import IntrinsicKalman, external_force, run, wrench
from covariant.signals import Record


@eqx.filter_jit
def followed(observer, record: Record):
    """Velocities, forces and their standard deviations at every stamp but the first."""

    def step(state, sample):
        state, _ = observer.step(state, *sample)
        return state, (state.v, state.slow, observer.velocity_std(state))

    u, y, dt = record.u[:-1], record.y[1:], jnp.diff(record.t)
    return jax.lax.scan(step, observer.init(record.y[0]), (u, y, dt))[1]


@pytest.mark.exhaustive
def test_a_push_is_found_and_leaves_no_bias(pushed_swing):
    record, true = pushed_swing
    v, force, std = (np.asarray(a) for a in followed(kalman(1.0), jax.tree.map(jnp.asarray, record)))
    late = record.t[1:] > 1.5
    np.testing.assert_allclose(force[late].mean(axis=0), PUSH, rtol=0.02)
    assert np.sqrt(np.mean((force[late] - PUSH) ** 2, axis=0)).max() < 0.05 * np.abs(PUSH).max()
    before = (record.t[1:] > 0.5) & (record.t[1:] < 1.0)
    assert np.abs(force[before].mean(axis=0)).max() < 0.05
    errors = v[late] - true[1:][late]
    assert np.abs(errors.mean(axis=0)).max() < 0.1 * std[late].max()
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 3 * std[late].max()
    # Without a force the push is a bias.
    plain = np.asarray(run(kalman(None), record).estimate)[1:, 2:]
    assert np.abs((plain - true[1:])[late].mean(axis=0)).max() > 20 * np.abs(errors.mean(axis=0)).max()


@pytest.mark.exhaustive
def test_a_torque_on_a_body_is_found_in_the_body():
    """On SO(3) a force is a covector of the body's own axes."""
    rigid, torque = body(), jnp.array([0.3, -0.2, 0.4])
    dt, steps = 0.01, 400

    def moved(motion, _):
        return advance(rigid, 0.0, motion, torque, dt, 2), motion.q

    start = Motion(jnp.eye(3), jnp.array([0.2, 0.5, -0.3]))
    q = jax.jit(lambda: jax.lax.scan(moved, start, None, steps)[1])()
    observer = IntrinsicKalman(rigid, 1e-6, 1e-8, 1.0, slow=(external_force(0.1 * jnp.eye(3)),), substeps=1)
    record = Record(dt * jnp.arange(0.0, steps), jnp.zeros((steps, 3)), q)
    _, force, _ = followed(observer, record)
    np.testing.assert_allclose(force[-1], torque, rtol=0.01)


@pytest.mark.exhaustive("panda-panda_link7")
@pytest.mark.parametrize(("robot", "link"), [("double_pendulum", "lower"), ("panda", "panda_link7")])
def test_its_torques_are_those_of_mujoco(robot, link):
    model = robots.load(robot)
    theirs = mujoco.MjModel.from_xml_string(robots.located(robot).read_text(encoding="utf-8"))
    data, rng = mujoco.MjData(theirs), np.random.default_rng(0)
    carried = mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_BODY, link)
    order = [mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_JOINT, name) for name in model.coordinates]
    place = np.array([0.1, -0.05, 0.2])
    for _ in range(3):
        q, w = rng.uniform(-2, 2, len(order)), rng.normal(size=6)
        data.qpos[theirs.jnt_qposadr[order]] = q
        mujoco.mj_forward(theirs, data)
        rotation = data.xmat[carried].reshape(3, 3)
        at = data.xpos[carried] + rotation @ place
        for frame in ("link", "world"):
            force, torque = (rotation @ part if frame == "link" else part for part in (w[:3], w[3:]))
            felt = np.zeros(theirs.nv)
            mujoco.mj_applyFT(theirs, data, force, torque, at, carried, felt)
            ours = wrench(model.space, link, 1.0, 1.0, time=1.0, frame=frame, point=place)
            assert ours.names == tuple(f"{axis}_{link}" for axis in ("fx", "fy", "fz", "tx", "ty", "tz"))
            got = ours.force(jnp.asarray(q), jnp.zeros(len(q)), jnp.asarray(w))
            np.testing.assert_allclose(got, felt[theirs.jnt_dofadr[order]], atol=1e-9)


@pytest.mark.exhaustive
def test_a_model_file_names_forces_and_every_engine_estimates_them(tmp_path):
    model = tmp_path / "arm.toml"
    model.write_text(MODEL)
    log = covariant.simulate(model, duration=1.0, rate=100.0, amplitude=[0.5, 0.2], noise=1e-4).record
    c, jaxs = (covariant.estimate(model, log, observer="intrinsic-kalman", engine=e).columns for e in ("c", "jax"))
    assert list(c)[-9:] == [
        *("fx_tip", "fz_tip", "external_force1", "external_force2"),
        *(f"{name}_std" for name in ("fx_tip", "fz_tip", "external_force1", "external_force2")),
        "pushed",
    ]
    for name, column in c.items():
        np.testing.assert_allclose(column, jaxs[name], atol=1e-9)
