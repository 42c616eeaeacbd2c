"""Tests whether all matrices in an interval matrix are positive definite; the prover's test, with rounding bounded.

A congruence with floating-point factors brings the interval matrix near the identity, `I − CᵀSC = E`. The matrix is
positive definite if the spectral radius of |E| is below one, that is (Collatz and Wielandt) if `|E| x < x` for some
positive x. The rounding of this test is bounded as well.

Source: Rump 2010, Verification methods, Acta Numerica 19, section 10.8.
"""

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Int

SLACK = 1e-3
"""Relative margin of |E| x < x, so that another implementation of the test reaches the same verdict on every box."""
ROUND = 1e-12
"""A generous bound of the relative rounding error of a sum of a few hundred terms."""
TINY = 1e-290
"""Larger than the sum of all underflows in such a sum."""
HUGE = 1e100
"""Largest entries for which the test is tried: for larger ones LAPACK need not converge, and nothing is shown."""


def places(n: int) -> Int[np.ndarray, "n n"]:
    """Index of each entry of a symmetric matrix in the list of entries on and below its diagonal."""
    rows, columns = np.tril_indices(n)
    positions = np.empty((n, n), int)
    positions[rows, columns] = positions[columns, rows] = np.arange(len(rows))
    return positions


def size_of(entries: np.ndarray) -> int:
    """Number of rows n of symmetric matrices, from their K = n (n + 1)/2 entries."""
    return (math.isqrt(8 * entries.shape[-2] + 1) - 1) // 2


def symmetric(entries: np.ndarray) -> Float[np.ndarray, "B n n"]:
    """Symmetric matrices from their entries on and below the diagonal."""
    return entries.T[:, places(size_of(entries))]


def congruent(c: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """The entries of CᵀSC on and below the diagonal."""
    n, result = len(c), np.empty_like(entries)
    at = places(n)
    for b in range(n):
        column = [sum_of(entries[..., at[i, j], :] * c[j, b] for j in range(n)) for i in range(n)]
        for a in range(b, n):
            result[..., at[a, b], :] = sum_of(column[i] * c[i, a] for i in range(n))
    return result


def sum_of(arrays: Iterable[np.ndarray]) -> np.ndarray:
    """The sum of arrays, one after the other; the first of them is overwritten, so it must be new."""
    total, *rest = arrays
    for array in rest:
        total += array
    return total


def sum_over(rows: np.ndarray) -> np.ndarray:
    """The sum over the first axis, one row after the other, from zero."""
    total = np.zeros(rows.shape[1:])
    for row in rows:
        total += row
    return total


def definite(middle: np.ndarray, radius: np.ndarray, terms: np.ndarray) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
    """Whether all symmetric matrices within `radius` of `middle + Σ wₘ terms[m]`, |wₘ| ≤ 1, are positive definite."""
    c, positive = factors(middle)
    n, at = len(c), places(len(c))
    with np.errstate(all="ignore"):
        error, size = np.abs(np.eye(n)[np.tril_indices(n)][:, None] - congruent(c, middle)), np.abs(middle)
        error += sum_over(np.abs(congruent(c, terms)))
        size += sum_over(np.abs(terms))
        # |C|ᵀ R |C| bounds the contribution of the radii; ROUND times the sizes bounds rounding of the congruences.
        error += congruent(np.abs(c), radius + ROUND * size)
        # Relative and absolute margins make E an upper bound of |I − CᵀSC| despite all rounding.
        e = (error * (1 + ROUND) + ROUND)[at]
        x = np.ones((n, e.shape[2]))
        # A few steps of power iteration: any positive x may prove the claim, and the Perron vector of E is the best.
        for _ in range(4):
            x = sum_over(e * x[:, None]) + 1e-6
            x /= x.max(axis=0)
        # The left side is rounded up. SLACK lowers the right side, so that another implementation agrees. With an
        # unbounded radius both sides may be ∞ or NaN (∞ · 0); the comparison is then False.
        below = (sum_over(e * x[:, None]) * (1 + ROUND) + TINY <= (1 - SLACK) * x).all(axis=0)
    return below & positive, c


def weights(c: np.ndarray, terms: np.ndarray, shares: np.ndarray) -> Float[np.ndarray, "m B"]:
    """How much each term of an enclosure, with its share of the remainder, widens it after the congruence by C."""
    n = len(c)
    rows, columns = np.tril_indices(n)
    with np.errstate(all="ignore"):
        # The sum runs over all entries of the matrix: each entry below the diagonal counts twice.
        size = sum_over(np.swapaxes(np.abs(c), 0, 1))
        parts = np.abs(congruent(c, terms))
        parts += shares * (size[rows] * size[columns])
        parts *= np.where(rows == columns, 1.0, 2.0)[:, None]
        return sum_over(np.swapaxes(parts, 0, 1))


def indefinite(middle: np.ndarray, radius: np.ndarray) -> Bool[np.ndarray, "B"]:
    """Whether no symmetric matrix in an enclosure is positive definite: some x gives xᵀSx < 0 for all of them."""
    middle, radius = symmetric(middle), symmetric(radius)
    finite = np.asarray(((np.abs(middle) < HUGE) & np.isfinite(radius)).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], middle, 0.0)
    # The eigenvector of the least eigenvalue minimises xᵀSx; any other x would also be valid in the proof.
    x = np.linalg.eigh(safe)[1][:, :, :1]
    xt = np.swapaxes(x, 1, 2)
    with np.errstate(all="ignore"):
        # An upper bound of xᵀSx over the enclosure; if it is negative, no matrix is positive definite.
        most = xt @ safe @ x + np.abs(xt) @ (radius + ROUND * np.abs(safe)) @ np.abs(x) * (1 + ROUND) + TINY
    return finite & (most[:, 0, 0] < 0)


def factors(middle: np.ndarray) -> tuple[Float[np.ndarray, "n n B"], Bool[np.ndarray, "B"]]:
    """Factors C for which `CᵀSC` is near the identity; the entries of S may have any units.

    Of all such factors C is the inverse square root: it rotates least, and rotation increases sums of absolute values.
    """
    n, full = size_of(middle), symmetric(middle)
    diagonal = np.abs(np.diagonal(full, axis1=1, axis2=2))
    # S is first scaled to a unit diagonal: otherwise rounding would spoil eigenvectors if entries have mixed units.
    units = 1 / np.sqrt(np.where(np.isfinite(diagonal) & (diagonal > TINY), diagonal, 1.0))
    with np.errstate(all="ignore"):
        scaled = full * units[:, :, None] * units[:, None, :]
    finite = np.asarray((np.abs(scaled) < HUGE).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], scaled, np.eye(n)))
    # Eigenvalues near zero would make C infinite, so they are raised; the proof does not depend on the accuracy of C.
    sizes = np.maximum(np.abs(values), np.abs(values).max(axis=1, keepdims=True) * 1e-12 + TINY)
    # S^−½ of the scaled matrix: congruence by it gives the identity, up to rounding and the signs of eigenvalues.
    root = (vectors / np.sqrt(sizes)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.ascontiguousarray((units[:, :, None] * root).transpose(1, 2, 0)), finite & (values[:, 0] > 0)
