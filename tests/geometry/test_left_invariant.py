"""Left-invariant metrics against definitions written out, closed forms, charts, and the isometry of SE(3) to a product.

Geodesics are those of the default budget; inertias are random, of condition up to 30, but where said otherwise.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import lie

GROUPS = {
    "SO3": lie.SO3,
    "SE2": lie.SE2,
    "SE3": lie.SE3,
    "SU3": lie.SU(3),
    "SO3 x SO2": lie.Product((lie.SO3, lie.SO2)),
}
SAMPLES = 12


def close(a, b, tolerance=1e-13):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


def inertias(rng, n):
    turned = np.linalg.qr(rng.normal(size=(SAMPLES, n, n)))[0]
    return np.einsum("kia,ka,kja->kij", turned, 30.0 ** rng.uniform(-0.5, 0.5, (SAMPLES, n)), turned)


def together(group, operation):
    """`operation(metric, ...)` for many inertias and arguments at once."""
    here = group.identity()
    return jax.jit(jax.vmap(lambda inertia, *arguments: operation(lie.LeftInvariant(group, inertia), here, *arguments)))


# Connection and curvature


class Space(NamedTuple):
    """A group with a metric for each sample, its operations, and structure constants `[e_i, e_j] = c[i, j, k] e_k`."""

    group: lie.AbstractGroup
    inertia: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    bracket: Callable
    connection: Callable
    curvature: Callable
    constants: np.ndarray

    def inner(self, x, y):
        return np.einsum("ki,kij,kj->k", x, self.inertia, y)

    def b(self, x, y):
        return np.asarray(self.connection(self.inertia, x, y))

    def r(self, x, y, z):
        return np.asarray(self.curvature(self.inertia, x, y, z))


@cache
def make_space(name) -> Space:
    group = GROUPS[name]
    n, rng = group.dimension, np.random.default_rng(0)
    bracket = jax.jit(jax.vmap(group.lie_bracket))
    i, j = np.repeat(np.eye(n), n, 0), np.tile(np.eye(n), (n, 1))
    constants = np.asarray(jax.vmap(group.lie_bracket)(i, j)).reshape(n, n, n)
    operations = together(group, lie.LeftInvariant.connection), together(group, lie.LeftInvariant.curvature)
    return Space(group, inertias(rng, n), *rng.normal(size=(3, SAMPLES, n)), bracket, *operations, constants)


@pytest.fixture(scope="module", params=GROUPS)
def space(request) -> Space:
    return make_space(request.param)


@pytest.mark.parametrize("moments", [(1.0, 2.0, 2.5), (1.0, 1.0, 1.9), (3.0, 0.5, 0.7), (1.0, 1.0, 1.0)])
def test_sectional_curvatures_of_a_rigid_body_are_milnors(moments):
    """Milnor 1976, section 4: with e_i orthonormal and [e₂, e₃] = λ₁e₁, μ_i = ½Σλ − λ_i, the Ricci form is
    2(μ₂μ₃, μ₃μ₁, μ₁μ₂), and in three dimensions K(e₁, e₂) is half of r₁ + r₂ − r₃."""
    space = make_space("SO3")
    space = space._replace(inertia=np.tile(np.diag(moments), (SAMPLES, 1, 1)))
    e = np.tile(np.diag(1 / np.sqrt(moments)), (SAMPLES, 1, 1))
    l = np.array(moments) / np.sqrt(np.prod(moments))  # noqa: E741
    mu = l.sum() / 2 - l
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        curvature = space.inner(space.r(e[:, a], e[:, b], e[:, b]), e[:, a])
        close(curvature[0], mu[b] * mu[c] + mu[a] * mu[c] - mu[a] * mu[b], 1e-14)


# Charts


# Geodesics

TOP = np.diag([1.0, 2.0, 3.5])


# Inertias


@pytest.mark.parametrize(
    ("inertia", "word"),
    [
        (np.ones(3), "shape"),
        (np.ones((3, 2)), "shape"),
        (np.eye(4), r"\(3, 3\)"),
        (np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not symmetric"),
        (np.diag([1.0, 2.0, 0.0]), "positive definite"),
        (np.diag([1.0, 2.0, -1.0]), "positive definite"),
        (np.full((3, 3), np.nan), "symmetric"),
    ],
)
def test_an_inertia_names_what_is_wrong(inertia, word):
    with pytest.raises(ValueError, match=word):
        lie.LeftInvariant(lie.SO3, inertia)


def test_an_inertia_may_be_given_in_whole_numbers():
    for whole in ([[1, 0], [0, 2]], np.diag([1, 2]), jnp.diag(jnp.array([1, 2]))):
        np.testing.assert_array_equal(lie.Inertia(whole).inverse, np.diag([1.0, 0.5]))


def test_norm_has_a_derivative_at_zero():
    metric = lie.LeftInvariant(lie.SO3, TOP)
    np.testing.assert_array_equal(jax.grad(lambda x: metric.norm(jnp.eye(3), x))(jnp.zeros(3)), np.zeros(3))
    close(metric.norm(jnp.eye(3), jnp.array([0.0, 2.0, 0.0])), np.sqrt(8.0), 1e-15)
