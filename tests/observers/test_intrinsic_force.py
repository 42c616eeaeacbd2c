"""The observer with an unknown force: its three poles, in continuous time and sampled, and its limit `Intrinsic`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant import models, observers
from covariant._integrate import rk8
from covariant.observers import Intrinsic, IntrinsicForce
from covariant.observers.base._sampled import sampled_force_gains, sampled_gains
from covariant.signals import Record

FORCE_GAINS = jax.jit(sampled_force_gains)
POLES = [(8.0, 16.0, 3.0), (20.0, 200.0, 20.0), (50.0, 100.0, 0.5), (14.0, 1e4, 40.0)]


def matrix(alpha, beta, rate, stiffness=0.0):
    """Of the error law in continuous time."""
    return np.array([[-alpha - rate, 1.0, 0.0], [stiffness - beta - alpha * rate, 0.0, 1.0], [-beta * rate, 0.0, 0.0]])


def sampled(gains, dt, stiffness=0.0):
    """Of the error over a sample: what the model does to it, then the correction."""
    alone = expm(np.array([[0.0, 1.0, 0.0], [stiffness, 0.0, 1.0], [0.0, 0.0, 0.0]]) * dt)
    return (np.eye(3) - np.outer(gains, [1.0, 0.0, 0.0])) @ alone


@pytest.mark.parametrize("dt", [1e-4, 4e-3, 0.1, 1.0])
@pytest.mark.parametrize("numbers", POLES)
def test_the_sampled_loop_has_the_three_poles(numbers, dt):
    found = np.poly(sampled(np.array([float(k) for k in FORCE_GAINS(*numbers, dt)]), dt))
    alpha, beta, rate = numbers
    wanted = np.poly(np.exp(np.append(np.roots([1.0, alpha, beta]), -rate) * dt)).real
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_without_a_rate_the_gains_are_those_of_two_poles():
    for dt in (0.0, 1e-5, 0.01, 3.0):
        np.testing.assert_array_equal(FORCE_GAINS(20.0, 200.0, 0.0, dt)[:2], jax.jit(sampled_gains)(20.0, 200.0, dt))
        assert float(FORCE_GAINS(20.0, 200.0, 0.0, dt)[2]) == 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_small_steps_keep_every_digit(dtype):
    dt = dtype(1e-6)
    found = [float(k) for k in FORCE_GAINS(dtype(40.0), dtype(800.0), dtype(10.0), dt)]
    # The gains in continuous time, and half a step of what the other gains take away meanwhile.
    wanted = [50.0 * dt * (1 - 25e-6), 1200.0 * dt, 8000.0 * dt]
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    np.testing.assert_allclose(found[0], wanted[0], rtol=8 * float(np.finfo(dtype).eps) + 1e-8)


SPRING = models.oscillator()


@jax.jit
def one_sample(stiffness, dt, xi):
    """Change of position, velocity and force by one sample of a unit mass, whose error is ξ and grows by N ξ."""
    observer = IntrinsicForce(models.oscillator(stiffness=-stiffness), 20.0, 200.0, 10.0)
    zero = jnp.zeros(())
    state = observers.IntrinsicForceState(xi, jnp.zeros(1), zero, jnp.zeros(1), jnp.zeros(1), dt)
    after, _ = observer.correct(state, jnp.zeros(1), jnp.zeros(1))
    return jnp.concatenate([state.q - after.q, state.v - after.v, state.force - after.force])


@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_on_a_stiff_model_the_poles_stay_to_second_order_in_the_step(stiffness):
    gaps = []
    for dt in (0.01, 0.02):
        found = np.poly(sampled(np.asarray(one_sample(stiffness, jnp.asarray(dt), jnp.ones(1))), dt, stiffness))
        wanted = np.poly(np.exp(np.append(np.roots([1.0, 20.0, 200.0]), -10.0) * dt)).real
        gaps.append(np.abs(found - wanted).max())
    assert gaps[1] < 5e-5
    assert np.log2(gaps[1] / gaps[0]) > 3.5  # (N dt²)²


@pytest.mark.parametrize("stiffness", [-100.0, -20.0, 20.0, 100.0])
def test_it_is_stable_after_gaps_in_which_it_does_not_start_anew(stiffness):
    for dt in np.geomspace(1e-3, np.pi / 2 / abs(stiffness) ** 0.5 * 0.999, 9):
        gains = np.asarray(one_sample(stiffness, jnp.asarray(dt), jnp.ones(1)))
        assert np.abs(np.linalg.eigvals(sampled(gains, dt, stiffness))).max() < 1


def test_a_sample_that_comes_too_late_leaves_the_force_as_it_is():
    assert float(one_sample(-100.0, jnp.asarray(0.2), jnp.ones(1))[2]) == 0.0


DOUBLE = models.pendulum_chain((1.0, 0.7), (0.5, 0.4))


def test_without_a_rate_it_is_the_observer_of_the_paper():
    """Sample by sample, in all its forms."""
    t = np.linspace(0.0, 0.5, 26)
    y = np.stack([0.4 + np.sin(3 * t), 0.6 - np.cos(4 * t)], axis=1)
    record = Record(t, np.zeros((26, 2)), y)
    for form in ({}, {"order": 2, "coefficients": "estimated", "curvature": False, "substeps": 2}):
        one = observers.run(IntrinsicForce(DOUBLE, 20.0, 200.0, 0.0, **form), record)
        two = observers.run(Intrinsic(DOUBLE, 20.0, 200.0, **form), record)
        np.testing.assert_allclose(one.estimate, two.estimate, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(one.info.slow, 0.0)


# The error law in continuous time.

ALPHA, BETA, RATE = 14.0, 100.0, 5.0


@eqx.filter_jit
def error_after(model, speed, size, duration, mistake=1.0):
    """Error (3, n) of position, velocity and acceleration by the force, at the end, of a plant under a constant force.

    Position and velocity in components at the true motion, to first order.
    """
    q, v, force = jnp.array([0.4, 0.6]), speed * jnp.array([0.7, -0.6]), jnp.array([0.5, -0.3])
    space, u = model.space, jnp.zeros(2)
    observer = IntrinsicForce(model, ALPHA, BETA, RATE)
    xi, zeta, delta = size * jnp.array([[0.8, -0.6], [3.0, 5.0], [4.0, 2.0]])
    state = observer.init(q + xi)
    start = state._replace(
        v=v + zeta - space.connection(q, xi, v), force=mistake * force + delta, last_input=None, age=None
    )

    def flow(t, joint):
        (q, v), state = joint
        return (v, models.acceleration(model, t, q, v, force)), observer.flow(t, state, u, q)

    (q, v), end = rk8(flow, jnp.zeros(()), ((q, v), start), duration, 200)
    xi = end.q - q
    zeta = end.v + space.connection(q, xi, v) - v
    first = jnp.stack(
        [jnp.array([0.8, -0.6]), jnp.array([3.0, 5.0]), space.raise_(jnp.array([0.4, 0.6]), delta) / size]
    )
    return jnp.stack([xi, zeta, space.raise_(q, end.force - force)]) / size, first
