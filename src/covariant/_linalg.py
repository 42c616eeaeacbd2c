"""Dense linear algebra for small symmetric matrices, written out.

LAPACK calls are slow under `vmap` on a CPU and cannot be exported, so the few factorisations a mechanical system of a
dozen joints needs are unrolled here over array slices: static shapes, no pivoting, no branching.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Inexact, Int

from covariant._typing import Matrix, Vector


class Pivot(NamedTuple):
    """A step of the elimination: the pivot d (1, 1), and the column (k, 1) of L below its diagonal."""

    d: Float[Array, "1 1"]
    below: Float[Array, "k 1"]


def ldl(a: Matrix) -> list[Pivot]:
    """Factor `a = L diag(d) Lᵀ` with a unit lower triangular L."""
    steps, rest = [], a
    for k in reversed(range(a.shape[0])):
        top, low = jax.lax.split(rest, (1, k), 0)
        d, right = jax.lax.split(top, (1, k), 1)
        left, block = jax.lax.split(low, (1, k), 1)
        steps.append(Pivot(d, left / d))
        rest = MIRRORED.bind(block - steps[-1].below @ right, rest)
    return steps


MIRRORED = core.Primitive("mirrored")
"""The first matrix, which is symmetric if the second is, as it stands.

In a graph of scalars, which shows entry by entry whether the second is, its lower triangle is the upper one: half of an
elimination is not done.
"""
MIRRORED.def_impl(lambda matrix, _: matrix)
MIRRORED.def_abstract_eval(lambda matrix, _: ShapedArray(matrix.shape, matrix.dtype))
mlir.register_lowering(MIRRORED, mlir.lower_fun(lambda matrix, _: matrix, multiple_results=False))
ad.primitive_jvps[MIRRORED] = lambda primals, tangents: (MIRRORED.bind(*primals), tangents[0])


def _mirrored_side_by_side(values, axes):
    (matrix, source), (axis, other) = values, axes
    if axis is None:
        return MIRRORED.bind(matrix, source), None
    source = source if other is None else jnp.moveaxis(source, other, 0)
    return MIRRORED.bind(jnp.moveaxis(matrix, axis, 0), source), 0


batching.primitive_batchers[MIRRORED] = _mirrored_side_by_side


def pivots(a: Matrix) -> Vector:
    """Pivots of `ldl`; by Sylvester's law of inertia as many are negative as `a` has negative eigenvalues."""
    return jnp.concatenate([step.d for step in ldl(a)])[:, 0]


@jax.custom_jvp
def solve(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve `a x = b` for symmetric positive definite `a`; columns of a matrix `b` are solved together."""
    steps = ldl(a)
    right = b.reshape(b.shape[0], -1)
    x = right[:0]
    for step, row in zip(steps[::-1], _forward(steps, right)[::-1], strict=True):
        below = step.below.T @ x
        x = jnp.concatenate([row / step.d - below, x])
    return x.reshape(b.shape)


def _forward(steps: list[Pivot], b: Float[Array, "n k"]) -> list[Float[Array, "1 k"]]:
    """Rows of `L⁻¹ b`."""
    rows = []
    for step in steps:
        top, low = jax.lax.split(b, (1, b.shape[0] - 1), 0)
        rows.append(top)
        b = low - step.below @ top
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
    steps = ldl(a)
    return jnp.concatenate([row / jnp.sqrt(step.d) for step, row in zip(steps, _forward(steps, b), strict=True)])


def whiten(a: Matrix, b: Matrix) -> Matrix:
    """`L⁻¹ b L⁻ᵀ` for symmetric b and symmetric positive definite `a = L Lᵀ`: it has the eigenvalues of `a⁻¹ b`."""
    return half_solve(a, half_solve(a, b).T)


def cholesky(a: Matrix) -> Matrix:
    """Lower triangular L with `a = L Lᵀ`, for symmetric positive definite a."""
    columns = []
    for k, step in enumerate(ldl(a)):
        columns.append(
            jnp.concatenate([jnp.zeros((k, 1), a.dtype), jnp.ones_like(step.d), step.below]) * jnp.sqrt(step.d)
        )
    return jnp.concatenate(columns, axis=1)


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


def at_places(array: Inexact[Array, "..."], places: Int[np.ndarray, "*k"]) -> Inexact[Array, "*k"]:
    """Entries of an array whose axes are counted as one, at places that are known and within it: a single operation."""
    return array.reshape(-1).at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)
