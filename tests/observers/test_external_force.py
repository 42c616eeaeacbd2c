"""A force that the model does not know, found from positions: in a simulation that shares no code with ours."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, Motion, advance, pendulum_chain
from covariant.observers import IntrinsicKalman, external_force, run
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
    body = GroupSystem(SO3, jnp.diag(jnp.array([1.0, 2.0, 3.5])))
    torque = jnp.array([0.3, -0.2, 0.4])
    dt, steps = 0.01, 400

    def moved(motion, _):
        return advance(body, 0.0, motion, torque, dt, 2), motion.q

    start = Motion(jnp.eye(3), jnp.array([0.2, 0.5, -0.3]))
    q = jax.jit(lambda: jax.lax.scan(moved, start, None, steps)[1])()
    observer = IntrinsicKalman(body, 1e-6, 1e-8, 1.0, slow=(external_force(0.1 * jnp.eye(3)),), substeps=1)
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
