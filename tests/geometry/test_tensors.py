"""The directional forms against the textbook's tensors, written out, for random metrics of two to four dimensions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import Metric

SAMPLES = 20


def random_metric(weights, waves):
    """`1 + B Bᵀ` with entries of B that are random trigonometric functions of q."""

    def matrix(q):
        b = jnp.sum(weights * jnp.sin(jnp.einsum("ijkl,l->ijk", waves[..., 1:], q) + waves[..., 0]), axis=-1)
        return jnp.eye(len(q)) + b @ b.T

    return matrix


def christoffel_symbols(g):
    """`Γ^i_jk = ½ g^il (∂_j g_lk + ∂_k g_lj − ∂_l g_jk)`."""

    def symbols(q):
        d = jax.jacfwd(g)(q)  # d[i, j, k] = ∂_k g_ij
        lowered = (jnp.einsum("lkj->ljk", d) + d - jnp.einsum("jkl->ljk", d)) / 2
        return jnp.einsum("il,ljk->ijk", jnp.linalg.inv(g(q)), lowered)

    return symbols


def riemann_tensor(g):
    """`R^i_jkl = ∂_k Γ^i_lj − ∂_l Γ^i_kj + Γ^i_km Γ^m_lj − Γ^i_lm Γ^m_kj`; `R(x, y)z` is `R^i_jkl z^j x^k y^l`."""
    symbols = christoffel_symbols(g)

    def tensor(q):
        gamma, d = symbols(q), jax.jacfwd(symbols)(q)  # d[i, l, j, k] = ∂_k Γ^i_lj
        half = jnp.einsum("iljk->ijkl", d) + jnp.einsum("ikm,mlj->ijkl", gamma, gamma)
        return half - jnp.einsum("ijkl->ijlk", half)

    return tensor


@pytest.fixture(scope="module", params=[2, 3, 4])
def sample(request):
    """Coefficients of random metrics, points and vectors, side by side."""
    n = request.param
    rng = np.random.default_rng(n)
    coefficients = rng.normal(size=(SAMPLES, n, n, 3)) / 2, rng.normal(size=(SAMPLES, n, n, 3, n + 1))
    return *coefficients, *rng.normal(size=(4, SAMPLES, n))


@pytest.mark.exhaustive
def test_christoffel_is_the_contraction_of_the_symbols(sample):
    @jax.jit
    @jax.vmap
    def both(weights, waves, q, x, y, z):
        g = random_metric(weights, waves)
        return Metric(g).connection(q, x, y), jnp.einsum("ijk,j,k", christoffel_symbols(g)(q), x, y)

    directional, contracted = both(*sample)
    np.testing.assert_allclose(directional, contracted, atol=1e-10)


@pytest.mark.exhaustive
def test_curvature_is_the_contraction_of_the_tensor(sample):
    @jax.jit
    @jax.vmap
    def both(weights, waves, q, x, y, z):
        g = random_metric(weights, waves)
        return Metric(g).curvature(q, x, y, z), jnp.einsum("ijkl,j,k,l", riemann_tensor(g)(q), z, x, y)

    directional, contracted = both(*sample)
    np.testing.assert_allclose(directional, contracted, atol=1e-10 * np.abs(contracted).max())
