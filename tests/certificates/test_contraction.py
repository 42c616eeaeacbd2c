"""Rates of contraction, against closed forms; the metric of intrinsic observers; distances and noise."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from covariant import models
from covariant.calibration import predict_errors
from covariant.certificates import certify, contraction_rate, lyapunov, optimal_lyapunov
from covariant.certificates.base import StateMetric, conditioning, error_matrix, rate_of, steady_distance
from covariant.certificates.theory import Decay
from covariant.observers import Intrinsic

ALPHA, BETA = math.sqrt(2), 0.5
PAPER = lyapunov(ALPHA, BETA)
ZERO = jnp.zeros(())


def in_frame(theta):
    """The metric `ΘᵀΘ`, in the frame of Θ."""
    return StateMetric(theta, lambda t, x: jnp.linalg.inv(theta(t, x)), lambda t, x: jnp.eye(len(x)))


def test_a_moving_frame_without_its_own_change_would_deceive():
    def shrink(t, x):
        return -x

    growing = in_frame(lambda t, x: jnp.exp(2 * t) * jnp.eye(2))
    frozen = in_frame(lambda t, x: jnp.eye(2))
    declared = in_frame(lambda t, x: jnp.exp(2 * jax.lax.stop_gradient(t)) * jnp.eye(2))
    x = jnp.array([0.3, -1.0])
    assert contraction_rate(shrink, growing, ZERO, x) == pytest.approx(-2.0)
    assert contraction_rate(shrink, frozen, ZERO, x) == pytest.approx(2.0)
    assert contraction_rate(shrink, declared, ZERO, x) == pytest.approx(-2.0)


def test_the_rate_of_a_linear_flow():
    a = jnp.array([[-2.0, 1.0], [0.5, -3.0]])

    def linear(t, x):
        return a @ x

    def flat(t, x):
        return jnp.eye(2)

    expected = -2 * np.linalg.eigvalsh((a + a.T) / 2)[-1]
    np.testing.assert_allclose(contraction_rate(linear, flat, ZERO, jnp.ones(2)), expected)


def test_the_metric_of_the_paper():
    np.testing.assert_allclose(PAPER, [[0.5303300859, -0.5], [-0.5, 2.4748737342]], rtol=1e-9)
    assert rate_of(ALPHA, BETA, PAPER) == pytest.approx(0.3852220515, abs=1e-10)
    with pytest.raises(ValueError, match=r"1\.414 1/s at best"):
        lyapunov(ALPHA, BETA, 1.5)


BAD_Q = [
    *([[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[2.0, 0.1], [0.2, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]),
    *([[np.inf, 0.0], [0.0, 1.0]], np.eye(3), 1.0, [[1.0], [0.0, 1.0]]),
]
BOUNDS = {"velocity": 1.0, "error": 0.01, "position": (-0.1, 0.1)}


@pytest.mark.parametrize("bad", BAD_Q, ids=str)
def test_a_matrix_that_is_no_metric_is_refused_in_one_line(bad):
    observer = Intrinsic(models.ball_and_beam(), ALPHA, BETA)
    uses = {
        "certify": lambda: certify(observer, **BOUNDS, q=bad),
        "rate_of": lambda: rate_of(ALPHA, BETA, bad),
        "conditioning": lambda: conditioning(BETA, bad),
    }
    for name, use in uses.items():
        with pytest.raises(ValueError, match=rf"^{name}: q must be a symmetric positive definite matrix \(2, 2\) .*$"):
            use()


BAD_GAINS = {
    "rate_of: alpha must be a finite number; got": lambda bad: rate_of(bad, BETA, PAPER),
    "lyapunov: beta must be a finite number; got": lambda bad: lyapunov(ALPHA, bad),
    "lyapunov: rate must be a finite number; got": lambda bad: lyapunov(ALPHA, BETA, bad),
    "conditioning: beta must be a positive, finite number; got": lambda bad: conditioning(bad, PAPER),
    "lyapunov: weight must be a positive, finite number": lambda bad: lyapunov(ALPHA, BETA, 0.0, -1.0),
    "certify: alpha of the observer must be a finite number; got": lambda bad: certify(
        eqx.tree_at(lambda o: o.alpha, Intrinsic(models.ball_and_beam(), ALPHA, BETA), bad), **BOUNDS
    ),
}


@pytest.mark.parametrize("message", BAD_GAINS)
def test_gains_that_are_no_numbers_are_refused_in_one_line(message):
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match=rf"^{message}.*$"):
            BAD_GAINS[message](bad)


@settings(deadline=None, max_examples=30)
@given(st.floats(0.1, 100), st.floats(0.01, 1e4), st.floats(0.05, 0.95))
def test_a_metric_for_a_rate_has_it(alpha, beta, share):
    wanted = -2 * np.linalg.eigvals(error_matrix(alpha, beta)).real.max() * share
    best = optimal_lyapunov(alpha, beta, wanted)
    assert rate_of(alpha, beta, best) >= wanted * (1 - 1e-6)
    assert conditioning(beta, best) <= conditioning(beta, lyapunov(alpha, beta, wanted, 1 / beta)) * (1 + 1e-9)


def test_a_matrix_that_rounding_spoils_is_refused():
    for rate in (1.9999999999, 1.999999999999998):  # just below what both equal poles allow
        for use in (lyapunov, optimal_lyapunov):
            with pytest.raises(ValueError, match="rounding leaves no positive definite matrix"):
                use(2.0, 1.0, rate)
    with pytest.raises(ValueError, match="rounding leaves no positive definite matrix"):
        optimal_lyapunov(1e160, 1e300, 1.0)


@settings(deadline=None, max_examples=30)
@given(st.floats(0.1, 100), st.floats(0.01, 1e4), st.floats(0.0, 0.95), st.floats(0.01, 100))
def test_it_solves_lyapunovs_equation(alpha, beta, share, weight):
    rate = -2 * np.linalg.eigvals(error_matrix(alpha, beta)).real.max() * share
    half = lyapunov(alpha, beta, rate, weight) @ error_matrix(alpha, beta)
    terms = np.array([half, half.T, rate * lyapunov(alpha, beta, rate, weight), np.diag([1.0, weight])])
    np.testing.assert_array_less(np.abs(terms.sum(0)), 1e-12 * np.abs(terms).max())


def test_tiny_distances_are_compared_to_what_solutions_are_computed_to():
    """What they are computed to is a part of the first distance, for which no lower bound need be known."""
    first, last, bound = 1.0, 5e-10, 1e-12

    def measured(low, high):
        return Decay(
            np.array([0.0, 60.0]), np.array([[0.0, low]]), np.array([[first, high]]), np.array([[first, bound]])
        )

    assert measured(last, last).holds
    assert measured(0.0, 4 * last).statement.verdict == "undecided"
    assert measured(4 * last, 4 * last).statement.verdict == "fails"


def test_bound_of_the_error_under_noise_against_simulation():
    """The bound from the rate holds for the worst noise and for white noise, and the white-noise prediction is met."""
    a = error_matrix(ALPHA, BETA)
    dt, steps, runs = 0.01, 40_000, 16
    density = 1e-4
    rng = np.random.default_rng(6)
    noise = rng.normal(size=(steps, runs)) * math.sqrt(density / dt)
    push = np.array([ALPHA, BETA])
    one, gain = np.eye(2) + dt * a + (dt * a) @ (dt * a) / 2, dt * (np.eye(2) + dt * a / 2) @ push
    x, seen = np.zeros((2, runs)), []
    for k in range(steps):
        x = one @ x + np.outer(gain, noise[k])
        if k > 2000:
            seen.append(x)
    measured = np.std(np.array(seen), axis=(0, 2))
    predicted = predict_errors(ALPHA, BETA, density, 0.0)
    np.testing.assert_allclose(measured, [predicted.position_std, predicted.velocity_std], rtol=0.05)
    with pytest.raises(ValueError, match="rate must be a positive, finite number"):
        steady_distance(0.0, 1.0)
