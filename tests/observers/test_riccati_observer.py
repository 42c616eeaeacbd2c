"""Observers that feed the output back through a contraction metric: their rates, their samples, and the textbook."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from covariant import models
from covariant._integrate import rk8
from covariant.metrics import Equation
from covariant.models import StateSpace
from covariant.observers import Estimate, InformationEKF, Riccati
from covariant.papers.sanfelice_praly import analytic_metric
from covariant.signals import StepCode

OSCILLATOR = models.unknown_frequency()
ZERO, NONE = jnp.zeros(()), jnp.zeros(0)


LINEAR = np.array([[0.0, 1.0, 0.0], [-2.0, -0.3, 0.5], [0.0, 0.2, -0.4]])
SEEN = np.array([[1.0, 0.0, 0.0], [0.5, 0.0, 1.0]])
PROCESS = np.array([[0.2, 0.05, 0.0], [0.05, 0.3, 0.0], [0.0, 0.0, 0.1]])
MEASUREMENT = np.array([[0.04, 0.01], [0.01, 0.09]])
PLANT = StateSpace(
    lambda t, x, u: jnp.asarray(LINEAR, x.dtype) @ x,
    lambda t, x, u: jnp.asarray(SEEN, x.dtype) @ x,
    coordinates=("a", "b", "c"),
    outputs=("left", "right"),
)
LAW = Equation(process_cov=jnp.asarray(PROCESS), measurement_cov=jnp.asarray(MEASUREMENT))
COV = linalg.solve_continuous_are(LINEAR.T, SEEN.T, PROCESS, MEASUREMENT)
KALMAN = COV @ SEEN.T @ np.linalg.inv(MEASUREMENT)
"""Gain of the stationary Kalman filter."""
X, Y = np.array([0.3, -0.2, 0.7]), np.array([0.5, -0.4])


def constant(x):
    return jnp.asarray(np.linalg.inv(COV), x.dtype)


def test_the_information_filter_flows_to_the_stationary_kalman_filter():
    ekf = InformationEKF(PLANT, LAW, jnp.asarray(X), 3 * jnp.eye(3))
    y = jnp.asarray(Y)

    @jax.jit
    def end(state):
        return rk8(lambda t, s: ekf.flow(t, s, NONE, y), ZERO, state, jnp.asarray(40.0), 4000)

    final = end(ekf.init(y))
    np.testing.assert_allclose(final.information, np.linalg.inv(COV), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(final.x, np.linalg.solve(LINEAR - KALMAN @ SEEN, -KALMAN @ Y), rtol=1e-7)


@eqx.filter_jit
def follow(observer, state, y, dt):
    def step(state, y):
        state, info = observer.step(state, NONE, y, dt)
        return state, (state, info)

    return jax.lax.scan(step, state, y)[1]


def test_no_gain_makes_a_sampled_step_unstable():
    """A gain of 1e8 at five samples a second: the correction is implicit, and lands on the measurement."""
    metric, truth = analytic_metric(2.0), np.array([1.0, 0.0, 1.0])
    t = 0.2 * np.arange(1, 301)
    observer = Riccati(OSCILLATOR, metric, jnp.array([0.9, 0.1, 1.1]), 1e8)
    states, info = follow(observer, observer.init(NONE), jnp.asarray(np.cos(t)[:, None]), jnp.asarray(0.2))
    assert np.isfinite(states.x).all()
    assert (info.result == StepCode.OK).all()
    np.testing.assert_allclose(states.x[:, 0], np.cos(t), rtol=0, atol=1e-6)
    assert np.abs(states.x[-1, 2] - truth[2]) < 0.05


def one_step(observer, y, dt=0.02):
    state = Estimate(observer.start, jnp.zeros((), observer.start.dtype))
    after, info = eqx.filter_jit(observer.step)(state, NONE, y, jnp.asarray(dt, y.dtype))
    return after.x, info


def alone(model, x, dt=0.02):
    return rk8(lambda t, z: model.f(t, z, NONE), ZERO, x, jnp.asarray(dt), 4)


def test_an_observer_that_is_told_no_time_starts_at_zero():
    for observer in (Riccati(PLANT, constant, jnp.asarray(X)), InformationEKF(PLANT, LAW, jnp.asarray(X), jnp.eye(3))):
        assert observer.init(jnp.asarray(Y)).t == 0.0


def test_angles_are_wrapped():
    turning = StateSpace(
        lambda t, x, u: jnp.stack([x[1], jnp.zeros_like(x[1])]),
        lambda t, x, u: x[:1],
        coordinates=("angle", "speed"),
        circles=(0,),
    )

    def metric(x):
        return jnp.array([[2.0, -1.0], [-1.0, 1.0]])

    def moved(y):
        return one_step(Riccati(turning, metric, jnp.array([3.1, 0.0]), 0.5), jnp.array([y]))

    (x, info), (same, _) = moved(-3.1), moved(2 * np.pi - 3.1)
    np.testing.assert_allclose(x, same, rtol=1e-12)
    assert info.innovation[0] == pytest.approx(2 * np.pi - 6.2, rel=1e-9)
    assert x[0] > 3.1


def test_a_metric_that_is_not_positive_definite_is_not_used():
    def wrong(x):
        return -jnp.eye(3)

    start = jnp.array([0.8, 0.3, 1.5])
    x, info = one_step(Riccati(OSCILLATOR, wrong, start), jnp.array([0.9]))
    assert info.result == StepCode.OUT_OF_DOMAIN
    np.testing.assert_allclose(x, alone(OSCILLATOR, start), rtol=1e-8)


def test_the_gain_may_depend_on_the_estimate():
    start, y, metric = jnp.array([0.8, 0.3, 1.5]), jnp.array([0.9]), analytic_metric(2.0)
    moved = alone(OSCILLATOR, start)
    one, _ = one_step(Riccati(OSCILLATOR, metric, start, lambda x: 0.2 * x[2]), y)
    other, _ = one_step(Riccati(OSCILLATOR, metric, start, 0.2 * float(moved[2])), y)
    np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("kind", ["riccati", "ekf"])
def test_single_precision_stays_single(kind):
    x, y = jnp.asarray(X, jnp.float32), jnp.asarray(Y, jnp.float32)
    if kind == "riccati":
        observer = Riccati(PLANT, constant, x, 0.5, jnp.asarray(MEASUREMENT))
    else:
        observer = InformationEKF(PLANT, LAW, x, jnp.eye(3))
    state = observer.init(y)
    after, info = jax.eval_shape(observer.step, state, jnp.zeros(0, jnp.float32), y, jnp.float32(0.02))
    flow = jax.eval_shape(observer.flow, jnp.float32(0), state, jnp.zeros(0, jnp.float32), y)
    leaves = jax.tree.leaves((after, flow, info.innovation, info.distance))
    assert {leaf.dtype for leaf in leaves} == {jnp.dtype(jnp.float32)}
