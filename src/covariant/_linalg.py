"""Dense linear algebra for small symmetric matrices, as explicit eliminations.

LAPACK calls are slow under `vmap` on a CPU and cannot be exported, so the few factorisations a mechanical system of a
dozen joints needs are implemented here over array slices, unrolled where they are short: static shapes, no pivoting, no
branching.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Inexact, Int

from covariant._typing import Matrix, Vector

Function = TypeVar("Function", bound=Callable[..., Any])


def traced_once(function: Function) -> Function:
    """Decorator that traces a function once for each shape, and compiles it where it is called alone."""
    return cast(Function, jax.jit(function))


class Pivot(NamedTuple):
    """A step of the elimination.

    Attributes:
        d: The pivot (1, 1).
        below: Column (k, 1) of L below its diagonal.
    """

    d: Float[Array, "1 1"]
    below: Float[Array, "k 1"]


WHOLE = 6
"""Largest matrix whose elimination `solve` unrolls: somewhat faster, and far longer to compile."""
LONG = 12
"""Most rows that `triangular` unrolls."""
BLOCK = 10
"""Number of elimination steps of a larger matrix that are one loop over a matrix of fixed size."""


def ldl(a: Matrix) -> list[Pivot]:
    """Factor `a = L diag(d) Lᵀ` with a unit lower triangular L, without pivoting."""
    # A positive definite matrix needs no pivoting: its pivots are positive and its Schur complements do not grow.
    steps, rest = [], a
    for _ in range(a.shape[0]):
        step, rest = _eliminate_first(rest)
        steps.append(step)
    return steps


def _eliminate_first(a: Matrix) -> tuple[Pivot, Float[Array, "k k"]]:
    """First step of the elimination of a, and the remaining Schur complement, a matrix smaller by one."""
    k = a.shape[0] - 1
    top, low = jax.lax.split(a, (1, k), 0)
    d, right = jax.lax.split(top, (1, k), 1)
    left, block = jax.lax.split(low, (1, k), 1)
    step = Pivot(d, left / d)
    return step, MIRRORED.bind(block - step.below @ right, a)


MIRRORED = core.Primitive("mirrored")
"""Identity on the first matrix, which is symmetric if the second is.

In a graph of scalars, which shows entry by entry whether the second is, the lower triangle is taken from the upper one,
so that half of an elimination is skipped.
"""
MIRRORED.def_impl(lambda matrix, _: matrix)
MIRRORED.def_abstract_eval(lambda matrix, _: ShapedArray(matrix.shape, matrix.dtype))
mlir.register_lowering(MIRRORED, mlir.lower_fun(lambda matrix, _: matrix, multiple_results=False))
ad.primitive_jvps[MIRRORED] = lambda primals, tangents: (MIRRORED.bind(*primals), tangents[0])


def _mirror_batch(values, axes):
    (matrix, source), (axis, other) = values, axes
    if axis is None:
        return MIRRORED.bind(matrix, source), None
    source = source if other is None else jnp.moveaxis(source, other, 0)
    return MIRRORED.bind(jnp.moveaxis(matrix, axis, 0), source), 0


batching.primitive_batchers[MIRRORED] = _mirror_batch


@traced_once
def pivots(a: Matrix) -> Vector:
    """Pivots of `ldl`; by Sylvester's law of inertia as many are negative as `a` has negative eigenvalues."""
    return jnp.concatenate([step.d for step in ldl(a)])[:, 0]


@traced_once
def solve(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve `a x = b` for symmetric positive definite `a`."""
    return _solve(a, b)


@jax.custom_jvp
def _solve(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    right = b.reshape(b.shape[0], -1)
    return (_solve_unrolled_rows if b.shape[0] <= WHOLE else _in_loops)(a, right).reshape(b.shape)


def _solve_unrolled_rows(a: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    steps, x = ldl(a), b[:0]
    # Back substitution starts at the last row.
    for step, row in zip(steps[::-1], _forward(steps, b)[::-1], strict=True):
        x = jnp.concatenate([_back(step, row, x), x])
    return x


def _in_loops(a: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """The same steps in loops over blocks of them.

    Arrays that shrink are padded by zeros at the end. Rows of `b` that are done are moved behind those that are not,
    where these zeros meet them. Loops that are linear in `b` are apart from the others, and carry it: JAX transposes no
    others.
    """

    def shrink(rest, _):
        step, rest = _eliminate_first(rest)
        # Padded to the size it had: a scan carries arrays of one shape.
        return jnp.pad(rest, ((0, 1), (0, 1))), step

    def down(rows, step):
        row, left = _down(step, rows)
        return jnp.concatenate([left, row]), None

    def back(rows, step):
        return jnp.concatenate([_back(step, rows[-1:], rows[:-1]), rows[:-1]]), None

    factors, rest = [], a
    while rest.shape[0]:
        count = min(BLOCK, rest.shape[0])
        rest, steps = jax.lax.scan(shrink, rest, None, count)
        # Each step has padded the matrix by a row and a column of zeros, which are cut off here.
        rest = rest[:-count, :-count]
        b, _ = jax.lax.scan(down, b, steps)
        factors.append((steps, b[-count:]))
        b = b[:-count]
    x = b
    for steps, rows in factors[::-1]:
        x, _ = jax.lax.scan(back, jnp.concatenate([x, rows]), steps, reverse=True)
    return x


def _down(step: Pivot, b: Float[Array, "m k"]) -> tuple[Float[Array, "1 k"], Float[Array, "_ k"]]:
    """A row of `L⁻¹ b`, and the right side of the rows after it."""
    top, low = jax.lax.split(b, (1, b.shape[0] - 1), 0)
    return top, low - step.below @ top


def _forward(steps: list[Pivot], b: Float[Array, "n k"]) -> list[Float[Array, "1 k"]]:
    """Rows of `L⁻¹ b`."""
    rows = []
    for step in steps:
        row, b = _down(step, b)
        rows.append(row)
    return rows


def _back(step: Pivot, row: Float[Array, "1 k"], x: Float[Array, "m k"]) -> Float[Array, "1 k"]:
    """A row of the solution, from those after it."""
    known = step.below.T @ x
    # Dividing here by d applies diag(d)⁻¹ between the forward and the backward substitution.
    return row / step.d - known


@_solve.defjvp
def _(primals, tangents):
    # The derivative of the solution is another solve with the same factor, which the compiler reuses.
    # From d(a x) = db: a dx = db − da x.
    (a, b), (da, db) = primals, tangents
    x = solve(a, b)
    return x, solve(a, db - da @ x)


def solve_square(a: Matrix, b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve `a x = b` for any invertible a, by the normal equations, which lose no accuracy where a is orthogonal."""
    return solve(a.T @ a, a.T @ b)


@traced_once
def half_solve(a: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve `L x = b`, where `a = L Lᵀ`: b in the basis in which a is the identity."""
    steps = ldl(a)
    # The Cholesky factor is the unit lower triangular one times diag(√d), so each row is divided by √d as well.
    return jnp.concatenate([row / jnp.sqrt(step.d) for step, row in zip(steps, _forward(steps, b), strict=True)])


@traced_once
def whiten(a: Matrix, b: Matrix) -> Matrix:
    """Whiten one symmetric matrix by another: `L⁻¹ b L⁻ᵀ` with `a = L Lᵀ`, which has the eigenvalues of `a⁻¹ b`."""
    return half_solve(a, half_solve(a, b).T)


@traced_once
def cholesky(a: Matrix) -> Matrix:
    """Cholesky factor: lower triangular L with `a = L Lᵀ`."""
    columns = []
    for k, step in enumerate(ldl(a)):
        column = jnp.concatenate([jnp.zeros((k, 1), a.dtype), jnp.ones_like(step.d), step.below])
        columns.append(column * jnp.sqrt(step.d))
    return jnp.concatenate(columns, axis=1)


@traced_once
def semidefinite_root(a: Matrix) -> Matrix:
    """Cholesky factor of a matrix that may be singular: lower triangular L with `a = L Lᵀ`."""
    columns, rest = [], a
    for k in range(a.shape[0]):
        positive = rest[0, 0] > 0
        # In a ≥ 0 a pivot that is zero has a column of zeros. The inner `where` keeps derivatives finite there.
        column = jnp.where(positive, rest[:, 0] / jnp.sqrt(jnp.where(positive, rest[0, 0], 1.0)), 0.0)
        columns.append(jnp.concatenate([jnp.zeros(k, a.dtype), column]))
        rest = rest[1:, 1:] - jnp.outer(column[1:], column[1:])
    return jnp.stack(columns, axis=1)


ROUNDING = 8
"""Length of a row that depends on others, in roundings of its length and in its number of entries."""


@traced_once
def triangular(a: Float[Array, "n k"]) -> Matrix:
    """Lower triangular L with `L Lᵀ = a aᵀ`: a square root of a covariance from a wide one, without squaring it.

    It uses Gram–Schmidt orthogonalisation of the rows, which may be linearly dependent.
    """
    return _triangular(a, 0.0)


@traced_once
def triangular_with_rank(a: Float[Array, "n k"]) -> Matrix:
    """The same as `triangular`, with a column of exact zeros for each row that depends on others up to rounding.

    Without that the rounding errors of such a row would be an axis of their own, along which later rows have parts: of
    no matter for the product, but not for a solution by L.
    """
    return _triangular(a, ROUNDING * a.shape[1] * float(jnp.finfo(a.dtype).eps))


def _triangular(a: Float[Array, "n k"], rounding: float) -> Matrix:
    def first(rest: Array, row: Array) -> tuple[Array, Array]:
        """The column of L of the first row, which was `row` in a, and the rows after it."""
        length = jnp.sqrt(jnp.sum(rest[0] ** 2))
        if rounding:
            length = jnp.where(length > rounding * jnp.sqrt(jnp.sum(row**2)), length, 0.0)
            rest = rest.at[0].set(jnp.where(length > 0, rest[0], 0.0))
        # A row that depends on those before it has length zero here, and a column of zeros in L.
        axis = rest[0] / jnp.where(length > 0, length, 1.0)
        # Modified Gram and Schmidt, a = L Qᵀ: the rows that remain lose their part along `axis`.
        below = rest @ axis
        return below, rest[1:] - jnp.outer(below[1:], axis)

    def turn(_, carried):
        # Rows that are done are zeros at the end, so that all turns are of one shape.
        rest, columns, rows = carried
        below, rest = first(rest, rows[0])
        rows = jnp.roll(rows, -1, 0) if rounding else rows
        return jnp.pad(rest, ((0, 1), (0, 0))), jnp.concatenate([columns[1:], below[None]]), rows

    n, columns, rest = len(a), [], a
    if n > LONG:
        columns = jax.lax.fori_loop(0, n, turn, (a, jnp.zeros((n, n), a.dtype), a))[1]
        return jnp.stack([jnp.roll(column, k) for k, column in enumerate(columns)], axis=1)
    for k in range(n):
        below, rest = first(rest, a[k])
        columns.append(jnp.concatenate([jnp.zeros(k, a.dtype), below]))
    return jnp.stack(columns, axis=1)


@traced_once
def lower_solve(root: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve `L x = b` by forward substitution, without squaring the condition of L."""
    inverse = _inverse_pivots(root)
    x = jnp.zeros_like(b)
    for i in range(len(root)):
        x = x.at[i].set((b[i] - root[i, :i] @ x[:i]) * inverse[i])
    return x


@traced_once
def upper_solve(root: Matrix, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve `Lᵀ x = b` by backward substitution, without squaring the condition of L."""
    # Counted from the last row, the upper triangular Lᵀ is a lower one.
    return lower_solve(root.T[::-1, ::-1], b[::-1])[::-1]


def _inverse_pivots(root: Matrix) -> Vector:
    """Inverse of the pivots of a triangular matrix; 0 for those that are zero."""
    pivots = jnp.diag(root)
    # The inner `where` keeps derivatives finite.
    return jnp.where(pivots == 0, 0.0, 1 / jnp.where(pivots == 0, 1.0, pivots))


def at_places(array: Inexact[Array, "..."], places: Int[np.ndarray, "*k"]) -> Inexact[Array, "*k"]:
    """Entries of an array at known indices within it, counted as if its axes were one: a single operation."""
    return array.reshape(-1).at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def known_rms(x: Float[np.ndarray, "..."], axis: int | tuple[int, ...] = 0) -> np.ndarray:
    """Root mean square of the entries that are known, along axes; NaN, without a warning, where none is."""
    known = ~np.isnan(x)
    count = known.sum(axis=axis)
    mean = np.where(count, np.sum(np.where(known, x, 0.0) ** 2, axis=axis) / np.maximum(count, 1), np.nan)
    return np.asarray(np.sqrt(mean))
