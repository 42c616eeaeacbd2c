"""The observer with an unknown force: its three poles, in continuous time and sampled, and its limit `Intrinsic`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant import models, observers
from covariant._integrate import rk8
from covariant.certificates import error_system
from covariant.observers import Intrinsic, IntrinsicForce
from covariant.observers.base._sampled import sampled_force_gains, sampled_gains
from covariant.signals import Record, StepCode
from covariant.simulation import hold, simulate

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


@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_gains_over_a_long_step_are_those_that_a_stiff_model_needs(stiffness):
    """Solved from the three invariants of the sampled loop."""
    dt = 0.1
    poles = np.poly(np.exp(np.append(np.roots([1.0, 20.0, 200.0]), -10.0) * dt)).real

    def invariants(gains):
        return np.poly(sampled(gains, dt, stiffness))[1:].real

    # They are linear in the gains, so that differences are derivatives.
    slopes = np.stack([invariants(row) - invariants(np.zeros(3)) for row in np.eye(3)], axis=1)
    wanted = np.linalg.solve(slopes, poles[1:] - invariants(np.zeros(3)))
    np.testing.assert_allclose(one_sample(stiffness, jnp.asarray(dt), jnp.ones(1)), wanted, rtol=1e-2)


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
FORCE = jnp.array([0.5, -0.3])
ERRORS = jnp.array([[0.8, -0.6], [3.0, 5.0], [4.0, 2.0]])


@eqx.filter_jit
def errors(model, speed, size, coupling=1.0, duration=0.3):
    """Errors (3, n) of position, velocity and acceleration by the force, and those of the law; over `size`.

    A plant moves under a constant force that the observer does not know. All are components at the truth.
    """
    space, u, observer = model.space, jnp.zeros(2), IntrinsicForce(model, ALPHA, BETA, RATE)
    q, v = jnp.array([0.4, 0.6]), speed * jnp.array([0.7, -0.6])
    xi, zeta, delta = size * ERRORS
    state = observer.init(q + xi)._replace(v=v + zeta - space.connection(q, xi, v), force=FORCE + delta)
    law = jnp.stack([xi, zeta, space.raise_(q, delta)])

    def flow(t, joint):
        q, v, state, (xi, zeta, eta) = joint
        along = jax.vmap(lambda a: space.connection(q, v, a))
        delta = space.lower(q, eta)
        rates = (
            zeta - (ALPHA + RATE) * xi,
            -(BETA + ALPHA * RATE) * xi + eta,
            -BETA * RATE * xi - coupling * space.raise_(q, along(jnp.eye(2)) @ delta),
        )
        slopes = jnp.stack(rates) - along(jnp.stack([xi, zeta, eta]))
        return v, models.acceleration(model, t, q, v, FORCE), observer.flow(t, state, u, q), slopes

    start = q, v, state._replace(last_input=None, age=None), law
    q, v, end, law = rk8(flow, jnp.zeros(()), start, jnp.asarray(duration), 100)
    xi = end.q - q
    found = jnp.stack([xi, end.v + space.connection(q, xi, v) - v, space.raise_(q, end.force - FORCE)])
    return found / size, law / size


def test_the_error_law_has_three_poles_exactly_where_the_metric_is_constant():
    """At any size of the error, and whatever the potential."""
    model = models.Lagrangian(
        lambda q: jnp.array([[2.0, 0.3], [0.3, 1.0]]), lambda q: -3.0 * jnp.cos(q[0] + 2 * q[1]), inputs=2
    )
    found, law = errors(model, 3.0, 1.0)
    np.testing.assert_allclose(found, law, atol=1e-9)
    raised = np.linalg.solve([[2.0, 0.3], [0.3, 1.0]], ERRORS[2])
    np.testing.assert_allclose(found, expm(0.3 * matrix(ALPHA, BETA, RATE)) @ [*ERRORS[:2], raised], atol=1e-9)


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_on_a_curved_metric_the_force_couples_by_the_connection_alone(speed):
    found, law = errors(DOUBLE, speed, 1e-6)
    assert np.abs(found - law).max() < 1e-4 * np.abs(law).max()


def test_without_the_coupling_the_law_is_another_one():
    for coupling in (0.0, -1.0):
        found, law = errors(DOUBLE, 10.0, 1e-6, coupling)
        assert np.abs(found - law).max() > 1e-2 * np.abs(law).max()


# Behind a gate, on groups, and late.


def test_a_new_start_keeps_the_force():
    """Readings that jump and stay: the gate starts the estimate anew there, and the load is the same."""
    gated = observers.Gated(IntrinsicForce(SPRING, 20.0, 200.0, 10.0), SPRING, noise=1e-3, speed=0.05)
    step = jax.jit(gated.step)
    state, codes = gated.init(jnp.array([2.0])), []
    for y in [2.0] * 200 + [1.0] * 14:
        state, info = step(state, jnp.zeros(1), jnp.array([y]), 0.01)
        codes.append(int(info.result))
        if codes[-1] == StepCode.RESTARTED:
            break
    assert codes[-1] == StepCode.RESTARTED
    np.testing.assert_allclose(state.inner.force, 2.0, rtol=1e-3)  # on a unit spring at 2
    np.testing.assert_allclose(state.inner.q, 1.0)


def test_a_torque_on_a_body_is_found_in_the_frame_of_the_body():
    body, torque = models.free_body((0.9, 1.0, 1.2)), jnp.array([0.3, -0.2, 0.1])
    t = jnp.linspace(0.0, 3.0, 301)
    start = models.Motion(jnp.eye(3), jnp.array([0.3, 0.8, -0.2]))
    true = jax.jit(lambda: simulate(body, start, t, hold(t, jnp.broadcast_to(torque, (301, 3)))))()
    run = observers.run(IntrinsicForce(body, 28.0, 400.0, 10.0, substeps=1), Record(t, jnp.zeros((301, 3)), true.y))
    np.testing.assert_allclose(run.info.slow[-1], torque, atol=2e-3)
    np.testing.assert_allclose(run.estimate.v[-1], true.x.v[-1], atol=1e-3)


def test_late_readings_give_the_same_force():
    observer = IntrinsicForce(SPRING, 20.0, 200.0, 10.0, substeps=1)
    late = observers.Delayed(observer, delay=0.05, rate=100.0)
    t = np.arange(400) * 0.01
    y = 2.0 - np.cos(t)
    record = Record(t, np.zeros((400, 1)), y[:, None])
    delayed = Record(t, np.zeros((400, 1)), np.interp(t - 0.05, t, y)[:, None])
    one, two = observers.run(observer, record), observers.run(late, delayed)
    np.testing.assert_allclose(two.info.slow[-1], one.info.slow[-1], atol=1e-3)
    np.testing.assert_allclose(two.estimate[-1], one.estimate[-1], atol=1e-3)


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ((-1.0, 2.0, 3.0), "IntrinsicForce: alpha must be a positive"),
        ((1.0, 0.0, 3.0), "IntrinsicForce: beta must be a positive"),
        ((1.0, 2.0, -3.0), "IntrinsicForce: force_rate must be a finite number, 0 or more"),
    ],
)
def test_gains_that_make_no_sense_are_refused(gains, message):
    with pytest.raises(ValueError, match=message):
        IntrinsicForce(SPRING, *gains)


def test_no_certificate_is_about_it():
    observer = IntrinsicForce(DOUBLE, ALPHA, BETA, RATE)
    with pytest.raises(TypeError, match=r"certificates are about .*; got IntrinsicForce"):
        error_system(observer, np.eye(2))


def test_without_a_force_it_moves_as_the_observer_without_one():
    """With the gains of position and velocity that three poles have."""
    y, v, u = jnp.array([0.4, 0.6]), jnp.array([1.0, -2.0]), jnp.array([0.3, -0.2])
    pair = IntrinsicForce(DOUBLE, ALPHA, BETA, RATE), Intrinsic(DOUBLE, ALPHA + RATE, BETA + ALPHA * RATE)
    with_force, without = (o.flow(jnp.zeros(()), o.init(y)._replace(q=y + 0.1, v=v), u, y) for o in pair)
    np.testing.assert_allclose(with_force.q, without.q, rtol=1e-12)
    np.testing.assert_allclose(with_force.v, without.v, rtol=1e-12)
