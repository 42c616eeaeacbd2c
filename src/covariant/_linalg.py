"""Dense linear algebra for small symmetric matrices, written out.

LAPACK calls are slow under `vmap` on a CPU and cannot be exported, so the few factorisations a mechanical system of a
dozen joints needs are unrolled here over array slices: static shapes, no pivoting, no branching.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Matrix, Vector


def ldl(a: Matrix) -> tuple[list[Array], Vector]:
    """Factor `a = L diag(d) Lᵀ`; column k of the unit lower triangular L is returned from its diagonal down."""
    columns, pivots, rest = [], [], a
    for _ in range(a.shape[0]):
        column = rest[:, 0] / rest[0, 0]
        columns.append(column)
        pivots.append(rest[0, 0])
        rest = rest[1:, 1:] - jnp.outer(column[1:], rest[0, 1:])
    return columns, jnp.stack(pivots)


def pivots(a: Matrix) -> Vector:
    """Pivots of `ldl`; by Sylvester's law of inertia as many are negative as `a` has negative eigenvalues."""
    return ldl(a)[1]


@jax.custom_jvp
def solve(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve `a x = b` for symmetric positive definite `a`; columns of a matrix `b` are solved together."""
    columns, d = ldl(a)
    width = (1,) * (b.ndim - 1)
    x = jnp.zeros_like(b[:0])
    for column, entry, pivot in zip(columns[::-1], _forward(columns, b)[::-1], d[::-1], strict=True):
        below = jnp.sum(column[1:].reshape(-1, *width) * x, axis=0)
        x = jnp.concatenate([(entry / pivot - below)[None], x])
    return x


def _forward(columns: list[Array], b: Float[Array, "n *k"]) -> list[Array]:
    """Rows of `L⁻¹ b`, L being given by the columns of `ldl`."""
    width = (1,) * (b.ndim - 1)
    rows = []
    for column in columns:
        rows.append(b[0])
        b = b[1:] - column[1:].reshape(-1, *width) * b[:1]
    return rows


@solve.defjvp
def _(primals, tangents):
    # The derivative of the solution is another solve with the same factor, which the compiler reuses.
    (a, b), (da, db) = primals, tangents
    x = solve(a, b)
    return x, solve(a, db - da @ x)


def solve_square(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """`a⁻¹ b` for any invertible a, by the normal equations, which lose no accuracy where a is orthogonal."""
    return solve(a.T @ a, a.T @ b)


def half_solve(a: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """`L⁻¹ b` for symmetric positive definite `a = L Lᵀ`: b in the basis in which a is the identity."""
    columns, d = ldl(a)
    return jnp.stack(_forward(columns, b)) / jnp.sqrt(d)[:, None]


def whiten(a: Matrix, b: Matrix) -> Matrix:
    """`L⁻¹ b L⁻ᵀ` for symmetric b and symmetric positive definite `a = L Lᵀ`: it has the eigenvalues of `a⁻¹ b`."""
    return half_solve(a, half_solve(a, b).T)


def cholesky(a: Matrix) -> Matrix:
    """Lower triangular L with `a = L Lᵀ`, for symmetric positive definite a."""
    columns, d = ldl(a)
    n = a.shape[0]
    full = [jnp.concatenate([jnp.zeros(n - c.shape[0], a.dtype), c]) for c in columns]
    return jnp.stack(full, axis=1) * jnp.sqrt(d)[None, :]


def semidefinite_root(a: Matrix) -> Matrix:
    """Lower triangular L with `a = L Lᵀ`, for symmetric a ≥ 0 that may be singular."""
    columns, rest = [], a
    for k in range(a.shape[0]):
        known = rest[0, 0] > 0
        column = jnp.where(known, rest[:, 0] / jnp.sqrt(jnp.where(known, rest[0, 0], 1.0)), 0.0)
        columns.append(jnp.concatenate([jnp.zeros(k, a.dtype), column]))
        rest = rest[1:, 1:] - jnp.outer(column[1:], column[1:])
    return jnp.stack(columns, axis=1)


def triangular(a: Float[Array, "n k"]) -> Matrix:
    """Lower triangular L with `L Lᵀ = a aᵀ`: a square root of a covariance from a wide one, without squaring it.

    It uses Gram–Schmidt orthogonalisation of the rows, which may be linearly dependent.
    """
    columns, rest = [], a
    for k in range(a.shape[0]):
        length = jnp.sqrt(jnp.sum(rest[0] ** 2))
        axis = rest[0] / jnp.where(length > 0, length, 1.0)
        below = rest @ axis
        columns.append(jnp.concatenate([jnp.zeros(k, a.dtype), below]))
        rest = rest[1:] - jnp.outer(below[1:], axis)
    return jnp.stack(columns, axis=1)
