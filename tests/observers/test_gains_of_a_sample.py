"""Gains of a sample, of position and velocity and with a force besides: the sampled error loop has the poles exp(λ dt).

Also after gaps, on stiff models, and to every digit.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant.geometry import Euclidean
from covariant.models import Motion, oscillator
from covariant.observers import IntrinsicForce
from covariant.observers.base._sampled import LONGEST_GAP, sampled_correction, sampled_force_gains, sampled_gains
from covariant.observers.constant_gain import IntrinsicForceState

gains, force_gains = jax.jit(sampled_gains), jax.jit(sampled_force_gains)


def loop(gains, dt, stiffness=0.0):
    """Of the error over a sample: what the model does to it, `ξ' = ζ, ζ' = Nξ + δ`, then the correction."""
    n = len(gains)
    model = np.eye(n, k=1)
    model[1, 0] = stiffness
    return (np.eye(n) - np.outer(gains, np.eye(n)[0])) @ expm(model * dt)


def wanted(dt, alpha, beta, *rate):
    """Characteristic polynomial of the loop with the poles of the law."""
    return np.poly(np.exp(np.append(np.roots([1.0, alpha, beta]), np.negative(rate)) * dt)).real


DAMPED = [(2 * damping * omega, omega**2) for omega in (0.5, 20.0) for damping in (0.05, 0.7, 0.999, 1.001, 1.5, 8.0)]
FORCED = [(8.0, 16.0, 3.0), (20.0, 200.0, 20.0), (50.0, 100.0, 0.5), (14.0, 1e4, 40.0)]


@pytest.mark.parametrize("dt", [1e-4, 4e-3, 0.1, 1.0])
@pytest.mark.parametrize("law", [*DAMPED, (8.0, 16.0), *FORCED], ids=str)
def test_the_sampled_loop_has_the_continuous_poles(law, dt):
    found = [float(k) for k in (gains if len(law) == 2 else force_gains)(*law, dt)]
    np.testing.assert_allclose(np.poly(loop(found, dt)), wanted(dt, *law), rtol=0, atol=1e-12)


def test_without_a_rate_of_the_force_the_gains_are_those_of_two_poles():
    for dt in (0.0, 1e-5, 0.01, 3.0):
        np.testing.assert_array_equal(force_gains(20.0, 200.0, 0.0, dt), [*gains(20.0, 200.0, dt), 0.0])


# One sample of a stiff model, `ξ` being the error that is measured.


@jax.jit
def two(stiffness, dt, xi):
    """Parts of the error taken away from position and velocity, and whether the estimate starts anew."""
    zero = jnp.zeros(1)
    taken = sampled_correction(Euclidean(), Motion(zero, zero), sampled_gains(20.0, 200.0, dt), dt, xi, -stiffness * xi)
    return jnp.concatenate([jnp.atleast_1d(taken.part), -taken.velocity]), taken.restarted


@jax.jit
def three(stiffness, dt, xi):
    """Change of position, velocity and force of a unit mass."""
    observer = IntrinsicForce(oscillator(stiffness=-stiffness), 20.0, 200.0, 10.0)
    zero = jnp.zeros(())
    state = IntrinsicForceState(xi, jnp.zeros(1), zero, jnp.zeros(1), jnp.zeros(1), dt)
    after, _ = observer.correct(state, jnp.zeros(1), jnp.zeros(1))
    return jnp.concatenate([state.q - after.q, state.v - after.v, state.force - after.force]), None


SAMPLES = {"two": (two, (20.0, 200.0)), "three": (three, (20.0, 200.0, 10.0))}
both = pytest.mark.parametrize(("sample", "law"), SAMPLES.values(), ids=SAMPLES)


@both
@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_on_a_stiff_model_the_poles_stay_to_second_order_in_the_step(sample, law, stiffness):
    gaps = []
    for dt in (0.01, 0.02):
        found = np.asarray(sample(stiffness, jnp.asarray(dt), jnp.ones(1))[0])
        gaps.append(np.abs(np.poly(loop(found, dt, stiffness)) - wanted(dt, *law)).max())
    assert gaps[1] < 5e-5
    assert np.log2(gaps[1] / gaps[0]) > 3.5  # (N dt²)²


@both
@pytest.mark.parametrize("stiffness", [-100.0, -20.0, 20.0, 100.0])
def test_it_is_stable_as_long_as_it_does_not_start_anew(sample, law, stiffness):
    for dt in np.geomspace(1e-3, 1.0, 13):
        found, restarted = sample(stiffness, jnp.asarray(dt), jnp.ones(1))
        if abs(stiffness) * dt**2 <= LONGEST_GAP:
            assert np.abs(np.linalg.eigvals(loop(np.asarray(found), dt, stiffness))).max() < 1
        assert restarted is None or bool(restarted) == (abs(stiffness) * dt**2 > LONGEST_GAP)


def test_without_an_error_nothing_starts_anew():
    (part, velocity), restarted = two(100.0, 1.0, jnp.zeros(1))
    assert (float(velocity), bool(restarted)) == (0.0, False)
    assert 0 < float(part) <= 1


def test_a_sample_that_comes_too_late_leaves_the_force_as_it_is():
    assert float(three(-100.0, jnp.asarray(0.2), jnp.ones(1))[0][2]) == 0.0


@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_gains_over_a_long_step_are_those_that_a_stiff_model_needs(stiffness):
    """Solved from the three invariants of the sampled loop, which are linear in the gains."""
    dt, (sample, law) = 0.1, SAMPLES["three"]

    def invariants(gains):
        return np.poly(loop(gains, dt, stiffness))[1:].real

    slopes = np.stack([invariants(row) - invariants(np.zeros(3)) for row in np.eye(3)], axis=1)
    needed = np.linalg.solve(slopes, wanted(dt, *law)[1:] - invariants(np.zeros(3)))
    np.testing.assert_allclose(sample(stiffness, jnp.asarray(dt), jnp.ones(1))[0], needed, rtol=1e-2)


# Digits


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_small_steps_keep_every_digit_with_a_force_too(dtype):
    dt = dtype(1e-6)
    found = [float(k) for k in force_gains(dtype(40.0), dtype(800.0), dtype(10.0), dt)]
    # The gains in continuous time, and half a step of what the other gains take away meanwhile.
    np.testing.assert_allclose(found, [50.0 * dt * (1 - 25e-6), 1200.0 * dt, 8000.0 * dt], rtol=1e-4)
    np.testing.assert_allclose(found[0], 50.0 * dt * (1 - 25e-6), rtol=8 * float(np.finfo(dtype).eps) + 1e-8)


@pytest.mark.parametrize("beta", [1.0, 399.999999, 400.0, 1e5])
def test_no_step_is_no_correction_whatever_the_gains(beta):
    """Their derivatives vanish too: a record whose first step is empty can be differentiated in the gains."""
    assert [float(k) for k in gains(40.0, beta, 0.0)] == [0.0, 0.0]
    slopes = jax.jit(jax.jacrev(lambda alpha, beta: jnp.stack(gains(alpha, beta, 0.0)), (0, 1)))(40.0, beta)
    np.testing.assert_array_equal(slopes, np.zeros((2, 2)))


@pytest.mark.parametrize("beta", [1.0, 399.9, 400.0, 400.1, 1e5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_small_steps_keep_every_digit(dtype, beta):
    dt = dtype(1e-6)
    k1, k2 = gains(dtype(40.0), dtype(beta), dt)
    assert k1.dtype == k2.dtype == dtype
    # To second order in dt, from the exponentials of the poles.
    digits = 8 * float(np.finfo(dtype).eps)
    assert float(k1) == pytest.approx(40e-6 * (1 - 20e-6), rel=digits + 1e-8)
    assert float(k2) == pytest.approx(beta * 1e-6 * (1 - 20e-6), rel=digits + 1e-8 + 1e-13 * beta)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gains_are_smooth_through_critical_damping(dtype):
    beta = np.linspace(399.0, 401.0, 41).astype(dtype)
    k2 = np.asarray(jax.vmap(lambda b: gains(dtype(40.0), b, dtype(0.02))[1])(beta), float)
    smooth = np.polyval(np.polyfit(np.linspace(-1, 1, 41), k2, 4), np.linspace(-1, 1, 41))
    assert np.abs(k2 / smooth - 1).max() < 40 * np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("alpha", "beta"), [(300.0, 300.0**2 / 8), (2000.0, 1.0), (1e5, 1e6), (10.0, 1e8)])
@pytest.mark.parametrize("dt", [1.0, 30.0, 3600.0])
def test_after_a_long_gap_the_gains_are_finite(dtype, alpha, beta, dt):
    k1, k2 = (float(k) for k in gains(dtype(alpha), dtype(beta), dtype(dt)))
    assert 0 < k1 <= 1
    assert 0 <= k2 * dt <= 4.0 + 1e-6
    if alpha**2 >= 4 * beta:
        slow = 2 * beta / (alpha + np.sqrt(alpha**2 - 4 * beta))
        assert k2 * dt == pytest.approx(-np.expm1(-slow * dt), rel=1e-5)  # the fast pole has died out


def test_gains_have_a_derivative_everywhere():
    slope = jax.vmap(jax.grad(lambda beta: gains(40.0, beta, 0.01)[1]))(jnp.array([1.0, 399.0, 401.0, 1e4]))
    higher, lower = (
        np.array([float(gains(40.0, b, 0.01)[1]) for b in (1.0 + h, 399.0 + h, 401.0 + h, 1e4 + h)])
        for h in (1e-3, -1e-3)
    )
    np.testing.assert_allclose(slope, (higher - lower) / 2e-3, rtol=1e-6)
