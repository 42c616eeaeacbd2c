"""The functions every user calls: what they accept, the shapes and types they keep, norms at zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant.geometry import Budget
from covariant.geometry._functions import gradient, inner, norm


def stretched(q):
    return jnp.diag(jnp.stack([jnp.ones_like(q[0]), 1 + q[0] ** 2]))


P, V, W = jnp.array([[0.3, 0.1], [0.2, -0.4], [0.5, 0.6]])


def test_metric_is_left_as_it_is():
    sphere = geometry.sphere()
    assert geometry.as_space(sphere) is sphere


def test_inner_and_norm_are_those_of_the_matrix():
    assert inner(stretched, P, V, W) == pytest.approx(0.2 * 0.5 - 0.4 * 0.6 * 1.09, rel=1e-15)
    assert norm(stretched, P, V) ** 2 == pytest.approx(0.2**2 + 0.4**2 * 1.09, rel=1e-15)


def test_norm_of_zero_has_zero_derivative():
    np.testing.assert_array_equal(jax.grad(lambda x: norm(stretched, P, x))(jnp.zeros(2)), jnp.zeros(2))


@pytest.mark.core(1)
def test_carried_vectors_keep_their_shape(space):
    n = space.p.shape[1]
    for shape in ((), (1,), (3,), (2, 3), (0,)):
        p, w = jax.ShapeDtypeStruct((n,), jnp.float64), jax.ShapeDtypeStruct((*shape, n), jnp.float64)
        end = jax.eval_shape(lambda p, v, w: geometry.transport_along(space.metric, p, v, w), p, p, w)
        assert (end.q.shape, end.velocity.shape, end.w.shape) == ((n,), (n,), (*shape, n))


def single_precision(function, n, arguments):
    """Types of the results for single-precision arguments of n coordinates."""
    results = jax.eval_shape(function, *[jax.ShapeDtypeStruct((n,), jnp.float32)] * arguments)
    return {leaf.dtype for leaf in jax.tree.leaves(results) if leaf.dtype != jnp.int64}


@pytest.mark.core(1)
def test_single_precision_stays_single(space):
    metric, n = space.metric, space.p.shape[1]

    def at_a_point_and_along(q, x, y, z):
        return (
            metric(q),
            geometry.christoffel(metric, q, x, y),
            geometry.curvature(metric, q, x, y, z),
            inner(metric, q, x, y),
            norm(metric, q, x),
            gradient(metric, q, x),
            geometry.exp(metric, q, x),
            geometry.transport_along(metric, q, x, y),
        )

    assert single_precision(at_a_point_and_along, n, 4) == {jnp.dtype(jnp.float32)}


@pytest.mark.core(2)
@pytest.mark.exhaustive("oscillator in r-open")
@pytest.mark.parametrize("budget", [Budget(), Budget(newton=1, steps=4)], ids=["open", "fixed"])
@pytest.mark.parametrize("name", ["sphere, curved chart", "torus", "sphere x hyperbolic", "oscillator in r"])
def test_single_precision_stays_single_between_points(spaces, name, budget):
    metric, n = spaces[name].metric, spaces[name].p.shape[1]

    def between(p, q, x):
        log = geometry.log(metric, p, q, budget), geometry.distance(metric, p, q, budget)
        return log, geometry.transport(metric, p, x, q, budget), geometry.shoot(metric, p, q, x, budget)

    assert single_precision(between, n, 3) == {jnp.dtype(jnp.float32)}


def test_radius_from_numpy_keeps_single_precision():
    q = jax.ShapeDtypeStruct((2,), jnp.float32)
    assert jax.eval_shape(geometry.sphere(np.float64(2.0)).__call__, q).dtype == jnp.float32
