"""The two gains of a sample against their definition: the sampled error loop has the poles exp(λ dt)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.observers.base._sampled import sampled_gains

gains = jax.jit(sampled_gains)


def loop(alpha, beta, dt):
    """The error loop of one sample: predict a double integrator over dt, then feed the measured error back."""
    k1, k2 = (float(k) for k in gains(alpha, beta, dt))
    return np.array([[1 - k1, (1 - k1) * dt], [-k2, 1 - k2 * dt]])


def poles(alpha, beta):
    return np.roots([1.0, alpha, beta])


@pytest.mark.parametrize("dt", [1e-4, 4e-3, 0.1, 1.0])
@pytest.mark.parametrize("damping", [0.05, 0.7, 0.999, 1.0, 1.001, 1.5, 8.0])
@pytest.mark.parametrize("omega", [0.5, 20.0])
def test_the_sampled_loop_has_the_continuous_poles(omega, damping, dt):
    alpha, beta = 2 * damping * omega, omega**2
    found = loop(alpha, beta, dt)
    wanted = np.exp(poles(alpha, beta) * dt)
    assert np.trace(found) == pytest.approx(wanted.sum().real, abs=1e-13)
    assert np.linalg.det(found) == pytest.approx(wanted.prod().real, abs=1e-13)


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
