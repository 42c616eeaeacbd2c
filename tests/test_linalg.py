"""The written-out solves against LAPACK, their derivatives, and the inertia their pivots show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant._linalg import BLOCK, WHOLE, ldl, solve
from scalargraph import lower, numbers

SIZES = (*range(1, 8), WHOLE + 1, 2 * BLOCK, 2 * BLOCK + 1)
BATCH = 16


def positive(n, seed=0):
    """Well conditioned symmetric positive definite matrices."""
    b = np.random.default_rng(seed + n).normal(size=(BATCH, n, n))
    return b @ np.swapaxes(b, 1, 2) + np.eye(n)


@pytest.mark.core(2)
@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("columns", [(), (3,)], ids=["vector", "matrix"])
def test_solve_is_that_of_lapack(n, columns):
    a = positive(n)
    b = np.random.default_rng(n).normal(size=(BATCH, n, *columns))
    expected = np.linalg.solve(a, b.reshape(BATCH, n, -1)).reshape(b.shape)
    np.testing.assert_allclose(jax.jit(jax.vmap(solve))(a, b), expected, rtol=0, atol=1e-12)


@pytest.mark.exhaustive("side by side-21")
@pytest.mark.core(1)
@pytest.mark.long("side by side-20", "side by side-21")
@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("batched", [False, True], ids=["alone", "side by side"])
def test_half_of_an_elimination_is_done_when_it_is_lowered(n, batched):
    """But all of it for a matrix that is not known to be symmetric, which has the solution that it has in JAX."""
    upper, b = np.triu_indices(n), np.random.default_rng(n).normal(size=n)

    def symmetric(entries):
        matrix = jnp.zeros((n, n)).at[upper].set(entries)
        return solve(jnp.where(np.tri(n, dtype=bool).T, matrix, matrix.T), jnp.asarray(b))

    def any_matrix(entries):
        return solve(entries.reshape(n, n), jnp.asarray(b))

    whole = positive(n)[0] + 0.1 * np.triu(np.ones((n, n)), 1)  # the solution is none of linear equations
    for function, x, products in (
        (symmetric, whole[upper], sum(k * (k + 1) // 2 for k in range(n))),
        (any_matrix, whole.ravel(), sum(k * k for k in range(n))),
    ):
        formed = jax.vmap(function, 1, 1) if batched else function
        given = np.stack([x, 2 * x], axis=1) if batched else x
        graph = lower(formed, jnp.asarray(given))
        np.testing.assert_allclose(numbers(graph, given), jax.jit(formed)(given), rtol=1e-12, atol=1e-13)
        count = sum(node.op == "mul" for node in graph.graph.nodes)
        assert count <= (1 + batched) * (products + n * (n - 1))


@pytest.mark.core(1)
@pytest.mark.parametrize("n", [1, 2, 5])
def test_solve_is_the_same_alone_and_side_by_side(n):
    a, b = positive(n), np.random.default_rng(n).normal(size=(BATCH, n))
    alone = jax.jit(solve)(a[3], b[3])
    np.testing.assert_allclose(jax.jit(jax.vmap(solve))(a, b)[3], alone, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(solve, (None, 0))(jnp.asarray(a[3]), b)[3], alone, rtol=1e-12)


def test_solve_has_the_exact_derivative():
    """`dx = a⁻¹ (db − da x)`."""
    a, da = positive(4)[:2]
    b, db = np.random.default_rng(0).normal(size=(2, 4))
    x, dx = jax.jvp(solve, (jnp.asarray(a), jnp.asarray(b)), (jnp.asarray(da), jnp.asarray(db)))
    np.testing.assert_allclose(dx, np.linalg.solve(a, db - da @ np.linalg.solve(a, b)), atol=1e-12)
    np.testing.assert_allclose(x, np.linalg.solve(a, b), atol=1e-12)


def test_solve_keeps_single_precision():
    a, b = jnp.asarray(positive(3)[0], jnp.float32), jnp.ones(3, jnp.float32)
    assert solve(a, b).dtype == jnp.float32
    np.testing.assert_allclose(solve(a, b), np.linalg.solve(a, b), rtol=1e-5)


@pytest.mark.exhaustive("21", "20")
@pytest.mark.core(1)
@pytest.mark.parametrize("n", SIZES)
def test_factors_multiply_to_the_matrix(n):
    a = positive(n)[0]
    lower, d = np.eye(n), np.zeros(n)
    for k, step in enumerate(ldl(jnp.asarray(a))):
        lower[k + 1 :, k], d[k] = step.below[:, 0], step.d[0, 0]
    np.testing.assert_allclose(lower @ np.diag(d) @ lower.T, a, atol=1e-12)
