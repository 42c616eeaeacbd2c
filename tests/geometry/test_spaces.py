"""Closed forms against the forms derived from the matrix, and against sphere and hyperboloid in one dimension more.

The sampler aims at the seams of the closed forms: lengths on both sides of the threshold of their series, the
zero vector, coinciding points, antipodes and the edge of the ball, with the base point of order one.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant.geometry import Budget, Metric
from covariant.geometry._functions import inner
from covariant.geometry._geodesics import Shot
from covariant.signals import StepCode

EXACT = 1e-10
"""What sixteen eighth-order steps leave of geodesics of order one."""


def close(a, b, tolerance=EXACT):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


# Closed forms and the forms derived from the matrix


@pytest.fixture(scope="module")
def derived(closed):
    """The operations derived from the matrix of a space with closed forms, batched and compiled once."""
    metric = Metric(closed.metric)
    return closed._replace(
        christoffel=jax.jit(jax.vmap(metric.connection)),
        curvature=jax.jit(jax.vmap(metric.curvature)),
        fly=jax.jit(jax.vmap(lambda p, v, w: metric.transport_along(p, v, w, Budget(steps=16)))),
    )


@pytest.mark.core(1)
def test_christoffel_is_that_of_the_matrix(closed, derived):
    close(closed.christoffel(closed.p, closed.x, closed.y), derived.christoffel(closed.p, closed.x, closed.y))


@pytest.mark.exhaustive("hyperbolic", "plane, curved chart", "sphere x hyperbolic")
def test_curvature_is_that_of_the_matrix(closed, derived):
    arguments = closed.p, closed.x, closed.y, closed.z
    close(closed.curvature(*arguments), derived.curvature(*arguments))


@pytest.mark.exhaustive("hyperbolic", "plane, curved chart", "sphere", "sphere x hyperbolic")
def test_transport_is_that_of_the_matrix(closed, derived):
    w = np.stack([closed.velocity, closed.x], 1)
    for mine, theirs in zip(*(space.fly(closed.p, closed.velocity, w) for space in (closed, derived)), strict=True):
        close(mine, theirs)


# The one sign of curvature


@pytest.mark.core(1)
@pytest.mark.parametrize(("make", "sign"), [(geometry.sphere, 1.0), (geometry.hyperbolic, -1.0)])
@pytest.mark.parametrize("radius", [1.0, 2.0])
@pytest.mark.parametrize("form", [lambda m: m, Metric], ids=["closed", "derived"])
def test_curvature_is_constant(make, sign, radius, form):
    """`R(x, y)z = K(<y, z>x − <x, z>y)`: positive on a sphere."""
    q, x, y, z = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)) * np.array([[0.3], [1.0], [1.0], [1.0]]))
    metric = make(radius)
    expected = sign / radius**2 * (inner(metric, q, y, z) * x - inner(metric, q, x, z) * y)
    close(geometry.curvature(form(metric), q, x, y, z), expected)


# The sphere and the hyperboloid


def form(k, a, b):
    """The quadric's bilinear form, positive on tangent vectors."""
    return np.sign(k) * a[0] * b[0] + a[1:] @ b[1:]


@pytest.mark.core(1)
@pytest.mark.exhaustive("hyperbolic", "sphere", "sphere x hyperbolic")
def test_exp_and_log_have_derivatives_at_zero(closed):
    """`D exp_p(0) = 1`, `D log_p(q) = 1` in q and −1 in p at q = p, where norms have no derivative."""
    metric, n = closed.metric, closed.p.shape[1]

    @jax.jit
    def derivatives(p):
        def log(p, q):
            return geometry.log(metric, p, q)

        of_exp = jax.jacfwd(lambda v: geometry.exp(metric, p, v))(jnp.zeros(n))
        return of_exp, *jax.jacfwd(log, (1, 0))(p, p), *jax.jacrev(log, (1, 0))(p, p)

    for derivative, sign in zip(derivatives(closed.p[3]), (1, 1, -1, 1, -1), strict=True):
        close(derivative, sign * np.eye(n), 1e-13)


@pytest.mark.core(1)
@pytest.mark.exhaustive("sphere", "sphere x hyperbolic")
def test_transport_between_points_is_along_the_geodesic(closed):
    metric = closed.metric
    shot = closed.shoot(closed.p, closed.q)
    moved = jax.jit(jax.vmap(lambda p, v, q: geometry.transport(metric, p, v, q)))
    close(moved(closed.p, shot.velocity, closed.q), shot.arrival, 1e-12)
    close(moved(closed.q, moved(closed.p, closed.x, closed.q), closed.p), closed.x, 1e-12)


OUTSIDE = {
    "outside the ball": (geometry.hyperbolic(), [0.1, 0.2], [1.2, 0.1]),
    "antipode": (geometry.sphere(), [0.5, 0.0], [-2.0, 0.0]),
}


@pytest.mark.parametrize(("space", "p", "q"), OUTSIDE.values(), ids=OUTSIDE)
def test_where_there_is_no_log_it_is_nan_and_shoot_says_so(space, p, q):
    assert np.isnan(geometry.log(space, jnp.array(p), jnp.array(q))).all()
    assert geometry.shoot(space, jnp.array(p), jnp.array(q)).result == StepCode.NOT_CONVERGED


# Putting spaces together


def test_torus_goes_the_short_way_round():
    torus = geometry.FlatTorus(jnp.array([2 * np.pi, 1.0]))
    p, q = jnp.array([3.0, 0.9]), jnp.array([-3.0, 5.1])
    close(geometry.log(torus, p, q), [2 * np.pi - 6.0, 0.2], 1e-14)


class Shoots(geometry.Euclidean):
    """Straight lines whose search ends as it is told, and leaves so much; it notes its guess."""

    result: StepCode = StepCode.OK
    residual: float = 0.0
    guesses: list = dataclasses.field(default_factory=list)

    def shoot(self, p, q, guess, budget):
        self.guesses.append(guess)
        return Shot(q - p, q - p, jnp.asarray(self.residual), jnp.asarray(self.result))


def test_product_hands_on_the_guess():
    p, q, guess = jnp.array([0.1, 0.2, 0.3]), jnp.array([0.4, 0.1, 0.2]), jnp.array([1.0, 2.0, 3.0])
    seen: list = []
    geometry.shoot(geometry.Product((Shoots(guesses=seen), Shoots(guesses=seen)), (1, 2)), p, q, guess)
    np.testing.assert_array_equal(np.concatenate(seen), guess)


def test_product_of_a_lost_and_a_found_geodesic_is_lost():
    both = geometry.Product((Shoots(StepCode.CONJUGATE_POINT), Shoots(StepCode.NOT_CONVERGED)), (1, 1))
    assert np.isnan(geometry.log(both, jnp.zeros(2), jnp.ones(2))).all()


def test_product_misses_by_the_root_of_the_squares():
    both = geometry.Product((Shoots(residual=0.3), Shoots(residual=0.4)), (1, 1))
    assert geometry.shoot(both, jnp.zeros(2), jnp.ones(2)).residual == pytest.approx(0.5, rel=1e-15)


def test_product_needs_a_size_for_each_space():
    with pytest.raises(ValueError, match="2 spaces but 1 sizes"):
        geometry.Product((geometry.sphere(), geometry.hyperbolic()), (4,))


def test_radius_sets_the_curvature():
    assert geometry.sphere(2.0).k == 0.25
    assert geometry.hyperbolic(0.5).k == -4.0
