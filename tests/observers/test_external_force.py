"""Forces that the model does not know, at joints and on links: in MuJoCo, which shares no code with ours."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plants import body

import covariant
from covariant import models
from covariant.models import Motion, advance, pendulum_chain, robots
from covariant.observers import IntrinsicKalman, external_force, run, wrench
from covariant.signals import Record

RATE = 500.0
QUANTUM = 2 * np.pi / 2**16
MASS, LENGTH = (1.2, 0.8), (0.4, 0.3)
CHAIN = f"""
<mujoco>
  <option timestep="2e-4" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body><joint name="one" axis="0 -1 0"/>
      <inertial pos="0 0 -{LENGTH[0]}" mass="{MASS[0]}" diaginertia="1e-9 1e-9 1e-9"/>
      <body pos="0 0 -{LENGTH[0]}"><joint name="two" axis="0 -1 0"/>
        <inertial pos="0 0 -{LENGTH[1]}" mass="{MASS[1]}" diaginertia="1e-9 1e-9 1e-9"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
PUSH = np.array([1.5, -0.6])
"""N m at the two joints, from the second second on."""


@pytest.fixture(scope="module")
def pushed_swing() -> tuple[Record, np.ndarray]:
    """Four seconds, encoders with steps, torques that are known and a push that is not; and the true velocities."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.6, -0.4), (0.5, 1.0)
    t = np.arange(round(4 * RATE)) / RATE
    u = np.stack([2 * np.sin(3 * t), np.cos(5 * t)], axis=1)
    y, v = np.empty((len(t), 2)), np.empty((len(t), 2))
    for k in range(len(t)):
        y[k], v[k] = data.qpos, data.qvel
        data.qfrc_applied[:] = u[k] + PUSH * (t[k] >= 1.0)
        mujoco.mj_step(model, data, nstep=10)
    return Record(t, u, QUANTUM * np.round(y / QUANTUM)), v


@eqx.filter_jit
def followed(observer, record: Record):
    """Velocities, forces and their standard deviations at every stamp but the first."""

    def step(state, sample):
        state, _ = observer.step(state, *sample)
        return state, (state.v, state.slow, observer.velocity_std(state))

    u, y, dt = record.u[:-1], record.y[1:], jnp.diff(record.t)
    return jax.lax.scan(step, observer.init(record.y[0]), (u, y, dt))[1]


def kalman(force: float | None, **named) -> IntrinsicKalman:
    noise = jnp.eye(2) * QUANTUM**2 / 12
    slow = () if force is None else (external_force(force * jnp.eye(2)),)
    return IntrinsicKalman(
        pendulum_chain(MASS, LENGTH), 1e-4 * jnp.eye(2), noise, 4.0 * jnp.eye(2), slow=slow, substeps=1, **named
    )


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


def test_its_covariance_is_one_matrix(pushed_swing):
    observer = kalman(1.0)
    state = observer.init(jnp.array(pushed_swing[0].y[0]))
    assert observer.cov(state).shape == (6, 6)
    assert kalman(None).cov(kalman(None).init(jnp.zeros(2))).shape == (4, 4)
    with pytest.raises(ValueError, match="density must have finite entries"):
        kalman(np.nan)


# Forces on links of a robot

STEP, ROWS = 0.01, 600
STAMPS = STEP * np.arange(ROWS)


@pytest.fixture(scope="module")
def arm():
    return robots.load("double_pendulum")


@pytest.mark.long
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


MODEL = """
system = "robot"

[parameters]
path = "double_pendulum"

[measurement]
std = 1e-4

[uncertainty]
acceleration = 0.2
external_force_std = 0.05
external_force_time = 0.3

[wrench.tip]
link = "lower"
force_std = [2.0, 0.0, 2.0]
time = 0.5
point = [0.0, 0.0, -0.2]
"""


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wrench.tip.link": "hand"}, r"\[wrench.tip\]: unknown link 'hand'. Known: base, upper, lower"),
        ({"wrench.tip.force_std": -1.0}, r"\[wrench.tip\]: force_std must be one number or three, numbers ≥ 0; got -1"),
        ({"wrench.tip.force_std": 0.0}, r"all zero; give the usual size"),
        ({"wrench.tip.frame": "base"}, r"frame must be one of link, world; got 'base'"),
        ({"wrench.tip.time": 0.0}, r"time"),
        ({"wrench.tip.std": 1.0}, r"unknown key of \[wrench.tip\] 'std'"),
        ({"wrench.tool.link": "lower"}, r"\[wrench.tool\] needs force_std and time"),
        ({"wrench.tool": 3.0}, r"wrench.tool must be a table"),
    ],
)
def test_what_makes_no_sense_is_named(change, words, tmp_path):
    model = tmp_path / "arm.toml"
    model.write_text(MODEL)
    log = Record(STAMPS, np.zeros((ROWS, 2)), 0.1 * np.sin(np.stack([STAMPS, 2 * STAMPS], axis=1)))
    with pytest.raises(ValueError, match=words):
        covariant.estimate(model, log, observer="intrinsic-kalman", overrides=change, anyway=True)


def test_only_robots_have_links():
    with pytest.raises(ValueError, match="has no links; give the space of a robot"):
        wrench(models.oscillator().space, "hand", 1.0, time=1.0)


def test_beside_friction_states_it_has_names_of_its_own(arm):
    slow = (external_force(std=[0.1, 0.1], time=0.2), wrench(arm.space, "lower", 1.0, time=1.0))
    filter_ = IntrinsicKalman(arm, 1e-4, 1e-8 * jnp.eye(2), jnp.eye(2), slow)
    assert filter_.slow_names == ("external_force1", "external_force2", "fx_lower", "fy_lower", "fz_lower")
