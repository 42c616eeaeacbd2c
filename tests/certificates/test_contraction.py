"""Rates of contraction, against closed forms; the metric of intrinsic observers; distances and noise."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from covariant import models
from covariant.calibration import predict_errors
from covariant.certificates import (
    Decay,
    certify,
    conditioning,
    contraction_matrix,
    contraction_rate,
    error_bounds,
    error_matrix,
    error_system,
    falsify,
    generalised_jacobian,
    in_coordinates,
    in_frame,
    log_norm,
    lower_distance,
    lyapunov,
    optimal_lyapunov,
    rate_of,
    steady_distance,
    upper_distance,
)
from covariant.geometry import distance, hyperbolic
from covariant.observers import Intrinsic
from covariant.proofs import Box

ALPHA, BETA = math.sqrt(2), 0.5
PAPER = lyapunov(ALPHA, BETA)
ZERO = jnp.zeros(())


def rate_at(about, z):
    point = about.at(z)
    return contraction_rate(point.flow, point.metric, ZERO, point.x)


def curved(t, x):
    return jnp.stack([x[1] - x[0] + 0.1 * x[0] ** 2, -x[0] - jnp.sin(x[1]) * jnp.cos(t)])


def theta(t, x):
    return jnp.array([[2.0, 0.3], [0.0, 1.0]]) * jnp.exp(0.2 * t) + 0.1 * jnp.outer(jnp.cos(x), jnp.array([1.0, 0.0]))


@pytest.mark.long("0")
@pytest.mark.parametrize("seed", range(3))
def test_both_conditions_of_contraction_are_one(seed):
    t, x = jnp.asarray(0.3 * seed), jax.random.normal(jax.random.key(seed), (2,))
    frame, metric = in_frame(theta), in_coordinates(lambda t, x: theta(t, x).T @ theta(t, x))
    np.testing.assert_allclose(
        contraction_rate(curved, frame, t, x), contraction_rate(curved, metric, t, x), rtol=1e-10
    )
    jacobian = generalised_jacobian(curved, frame, t, x)
    np.testing.assert_allclose(
        -2 * jnp.linalg.eigvalsh((jacobian + jacobian.T) / 2)[-1], contraction_rate(curved, frame, t, x)
    )
    # (9) by hand, the derivative along the flow by a difference.
    h, full = 1e-6, metric.gram
    speed, moved = curved(t, x), jax.jacfwd(lambda y: curved(t, y))(x)
    change = (full(t + h, x + h * speed) - full(t - h, x - h * speed)) / (2 * h)
    by_hand = moved.T @ full(t, x) + change + full(t, x) @ moved
    value = theta(t, x)
    np.testing.assert_allclose(contraction_matrix(curved, metric, t, x), by_hand, atol=1e-8)
    np.testing.assert_allclose(value.T @ contraction_matrix(curved, frame, t, x) @ value, by_hand, atol=1e-8)


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


def test_rates_and_norms_of_a_linear_flow():
    a = jnp.array([[-2.0, 1.0], [0.5, -3.0]])

    def linear(t, x):
        return a @ x

    def flat(t, x):
        return jnp.eye(2)

    expected = -2 * np.linalg.eigvalsh((a + a.T) / 2)[-1]
    np.testing.assert_allclose(contraction_rate(linear, flat, ZERO, jnp.ones(2)), expected)
    assert log_norm(a) == pytest.approx(-expected / 2)
    assert log_norm(a, 1) == pytest.approx(max(-2 + 0.5, -3 + 1))
    assert log_norm(a, math.inf) == pytest.approx(max(-2 + 1, -3 + 0.5))
    for order in (1, 2, math.inf):
        step = 1e-7
        grown = (np.linalg.norm(np.eye(2) + step * np.asarray(a), order) - 1) / step
        assert log_norm(a, order) == pytest.approx(grown, abs=1e-5)
    with pytest.raises(ValueError, match="1, 2 or inf"):
        log_norm(a, 3)


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


@functools.cache
def paper_observer():
    return error_system(Intrinsic(models.ball_and_beam(), ALPHA, BETA), PAPER)


@functools.cache
def paper_laws():
    """Rate and `d/dt length² + ½(|ξ|² + |ζ|²)` at points with q̂ = q, compiled once."""

    observer, beam = paper_observer(), models.ball_and_beam()

    def both(z):
        point = observer.at(z)
        change = contraction_matrix(point.flow, point.metric, ZERO, point.x)
        metric = beam.metric(z[:2])
        return rate_at(observer, z), change + jnp.kron(jnp.eye(2), metric) / 2

    return jax.jit(jax.vmap(both))


def at_the_measurement(seed, speed):
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 1, (200, 8)) * np.array([1, 3, 1, 1, 0, 0, 10, 10])
    v = rng.normal(size=(200, 2))
    z[:, 2:4] = speed * v / np.linalg.norm(v, axis=1, keepdims=True) * rng.uniform(size=(200, 1))
    return jnp.asarray(z)


@pytest.mark.exhaustive
def test_ball_and_beam_contracts_at_the_rate_of_the_paper_and_squared_lengths_fall_at_half_the_printed_one():
    """Whatever the velocity."""
    np.testing.assert_allclose(paper_laws()(at_the_measurement(1, 50.0))[0], 0.3852220515, atol=1e-6)
    assert np.abs(paper_laws()(at_the_measurement(2, 3.0))[1]).max() < 1e-10


@pytest.mark.exhaustive
def test_on_a_group_the_same_law_holds():
    about = error_system(Intrinsic(models.heavy_top(), 10.0, 50.0), lyapunov(10.0, 50.0))
    z = np.random.default_rng(3).uniform(-1, 1, (50, 9)) * np.array([5, 5, 5, 0, 0, 0, 2, 2, 2])
    rates = np.asarray(jax.jit(jax.vmap(lambda z: rate_at(about, z)))(jnp.asarray(z)))
    np.testing.assert_allclose(rates, rate_of(10.0, 50.0, lyapunov(10.0, 50.0)), rtol=1e-6)


@pytest.mark.long
def test_distances_are_bracketed_by_the_closed_form():
    space = hyperbolic()
    metric = in_coordinates(lambda t, x: space(x))
    rng = np.random.default_rng(4)
    for size in (0.3, 0.03):
        a = jnp.asarray(rng.uniform(-0.4, 0.4, 2))
        b = a + size * jnp.asarray(rng.uniform(-0.5, 0.5, 2))
        true = distance(space, a, b)
        low, high = lower_distance(metric, ZERO, a, b), upper_distance(metric, ZERO, a, b)
        assert low <= true <= high
        assert high - low < 2 * size * true
    assert lower_distance(metric, ZERO, a, a) == upper_distance(metric, ZERO, a, a) == 0


def test_a_distance_from_below_looks_along_the_line_where_the_line_is():
    """In polar coordinates, whose lengths, other than the hyperbolic ones above, depend on the direction."""
    metric = in_coordinates(lambda t, x: jnp.diag(jnp.stack([jnp.ones(()), x[0] ** 2])))
    for size in (0.1, 0.01):
        a, b = jnp.array([1.0, 0.3]), jnp.array([1.0 + size, 0.3 + size])
        true = abs((1 + size) * np.exp(1j * size) - 1)
        assert (1 - 4 * size) * true < lower_distance(metric, ZERO, a, b) <= true <= upper_distance(metric, ZERO, a, b)


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
    bounds = error_bounds(ALPHA, BETA, PAPER, rate_of(ALPHA, BETA, PAPER), np.abs(noise).max(), 0.0)
    assert (np.abs(np.array(seen)).max(axis=(0, 2)) < bounds).all()
    # A constant error is the simplest of all noises: it moves the estimate by itself.
    steady = np.linalg.solve(a, -push)
    assert (np.abs(steady) <= error_bounds(ALPHA, BETA, PAPER, rate_of(ALPHA, BETA, PAPER), 1.0, 0.0)).all()
    with pytest.raises(ValueError, match="rate must be a positive, finite number"):
        steady_distance(0.0, 1.0)


def region(scale):
    high = scale * np.array([0.2, 1.0, 3.0, 3.0, 0.3, 0.3, 0.0, 0.0])
    return Box(paper_observer().names, paper_observer().units, -high, high)


@pytest.mark.exhaustive
def test_a_counter_example_is_returned_with_its_point():
    found = falsify(paper_observer(), region(1.0), 0.1, attempts=4000)
    assert (found.verdict, found.evidence) == ("fails", "sampled")
    sampled = falsify(paper_observer(), region(1.0), 0.1, attempts=4000, starts=0)
    for each in (found, sampled):
        same = paper_laws()(jnp.broadcast_to(jnp.asarray(each.point), (200, 8)))[0][0]
        assert float(same) == pytest.approx(each.margin, rel=1e-9)
    assert found.margin < sampled.margin - 0.1  # descent finds what sampling misses
    assert falsify(paper_observer(), region(0.03), 0.1, attempts=4000).verdict == "holds"


@pytest.mark.long
def test_the_middle_of_a_region_is_looked_at_first():
    """There, at rest, vanishes what does; it is never drawn."""
    found = falsify(paper_observer(), region(1.0), 0.1, attempts=1, starts=0)
    assert found.point == (0.0,) * 8
    assert found.margin == pytest.approx(rate_of(ALPHA, BETA, PAPER), rel=1e-9)
