"""What takes long of `test_contraction.py`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_contraction import ALPHA, BETA, PAPER, ZERO, in_frame

from covariant import models
from covariant.certificates import contraction_rate, error_system, falsify, lyapunov
from covariant.certificates.base import contraction_matrix, generalised_jacobian, in_coordinates, rate_of
from covariant.certificates.theory import lower_distance, upper_distance
from covariant.geometry import distance, hyperbolic
from covariant.observers import Intrinsic
from scalargraph.proofs import Box


def rate_at(about, z):
    point = about.at(z)
    return contraction_rate(point.flow, point.metric, ZERO, point.x)


def curved(t, x):
    return jnp.stack([x[1] - x[0] + 0.1 * x[0] ** 2, -x[0] - jnp.sin(x[1]) * jnp.cos(t)])


def theta(t, x):
    return jnp.array([[2.0, 0.3], [0.0, 1.0]]) * jnp.exp(0.2 * t) + 0.1 * jnp.outer(jnp.cos(x), jnp.array([1.0, 0.0]))


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


def test_the_middle_of_a_region_is_looked_at_first():
    """There, at rest, vanishes what does; it is never drawn."""
    found = falsify(paper_observer(), region(1.0), 0.1, attempts=1, starts=0)
    assert found.point == (0.0,) * 8
    assert found.margin == pytest.approx(rate_of(ALPHA, BETA, PAPER), rel=1e-9)
