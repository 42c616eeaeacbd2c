"""The written-out solves against LAPACK, their derivatives, and the inertia their pivots show: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from jax.test_util import check_grads
from test_linalg import positive

from covariant import _linalg
from covariant._linalg import BLOCK, WHOLE, lower_solve, pivots, solve, triangular_with_rank, upper_solve


@pytest.mark.exhaustive("float-23", "float32-23")
@pytest.mark.parametrize("n", [1, 2, BLOCK, BLOCK + 1, 23])
@pytest.mark.parametrize("real", [float, np.float32])
def test_loops_take_the_steps_that_are_written_out(n, real, monkeypatch):
    a, b = positive(n)[0].astype(real), np.random.default_rng(n).normal(size=(n, 2)).astype(real)
    found = []
    for whole in (n, 0):
        monkeypatch.setattr(_linalg, "WHOLE", whole)
        found.append(np.asarray(jax.jit(lambda a, b: _linalg._solve.fun(a, b))(a, b)))
    assert found[0].dtype == found[1].dtype == real
    np.testing.assert_allclose(*found, rtol=0, atol=20 * np.finfo(real).eps * np.abs(found[0]).max())


@pytest.mark.exhaustive("matrix", "loops")
@pytest.mark.parametrize(("n", "columns"), [(1, ()), (2, (2,)), (WHOLE + 1, ())], ids=["number", "matrix", "loops"])
def test_solve_has_the_derivatives_that_differences_show(n, columns):
    """First and second, forward and reverse, along symmetric changes of the matrix."""
    rng = np.random.default_rng(n)

    @jax.jit
    def solved(root, b):
        return solve(root @ root.T + jnp.eye(n), b)

    root, b = jnp.asarray(rng.normal(size=(n, n))), jnp.asarray(rng.normal(size=(n, *columns)))
    check_grads(solved, (root, b), order=2, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)


jitted_pivots = jax.jit(pivots)


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_signs_of_the_pivots_are_those_of_the_eigenvalues(n, seed):
    """Sylvester's law of inertia, for matrices of either sign that can be factored without exchanging rows."""
    b = np.random.default_rng(seed).normal(size=(n, n))
    a = b + b.T
    assume(all(abs(np.linalg.det(a[:k, :k])) > 1e-3 for k in range(1, n + 1)))
    assert np.sum(jitted_pivots(a) < 0) == np.sum(np.linalg.eigvalsh(a) < 0)


@pytest.mark.parametrize("n", [1, 4])
def test_no_lapack(n):
    """So that it can be exported, and is quick side by side."""
    a, b = jnp.eye(n), jnp.ones((n, 2))
    primitives = str(jax.make_jaxpr(jax.vmap(jax.jacrev(solve)))(a[None], b[None]))
    for name in ("cholesky", "lu[", "triangular_solve", "custom_call"):
        assert name not in primitives


def test_substitutions_solve_by_a_triangle_and_leave_out_what_is_singular():
    root = np.linalg.cholesky(positive(5)[0])
    b = np.random.default_rng(3).normal(size=(5, 2))
    np.testing.assert_allclose(root @ lower_solve(jnp.asarray(root), jnp.asarray(b)), b, rtol=0, atol=1e-13)
    np.testing.assert_allclose(root.T @ upper_solve(jnp.asarray(root), jnp.asarray(b)), b, rtol=0, atol=1e-13)
    # Rank 2: the third row depends on the others, up to rounding.
    wide = np.array([[0.3, 0.1, 0.7], [1e6, 2e6, 3e5], [0.0, 0.0, 0.0]])
    wide[2] = 0.7 * wide[0] + 1e-3 * wide[1]
    singular = triangular_with_rank(jnp.asarray(wide))
    x = lower_solve(singular, jnp.asarray(wide))
    np.testing.assert_array_equal(x[2], 0.0)
    np.testing.assert_allclose(singular @ x, wide, rtol=1e-12)
