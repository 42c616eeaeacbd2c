"""Positive definiteness of all matrices in an interval matrix: the tests of the prover, with all rounding bounded.

A congruence with floating-point factors brings the interval matrix near the identity, `I − CᵀSC = E`. It is positive
definite where the spectral radius of |E| is below one, by Collatz & Wielandt: `|E| x < x` for some positive x. The
rounding of this test is bounded as well.

Source: Rump 2010, Verification methods, Acta Numerica 19, section 10.8.
"""

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Int

SLACK = 1e-3
"""Relative margin by which |E| x must stay below x, so that another implementation of the test agrees on every box."""
ROUND = 1e-12
"""A generous bound of the relative rounding error of a sum of a few hundred terms."""
TINY = 1e-290
"""Larger than all underflows of such a sum together."""
HUGE = 1e100
"""LAPACK need not converge for matrices with larger entries; nothing is shown of them."""


def places(n: int) -> Int[np.ndarray, "n n"]:
    """The place of each entry of a symmetric matrix among those on and below its diagonal."""
    rows, columns = np.tril_indices(n)
    positions = np.empty((n, n), int)
    positions[rows, columns] = positions[columns, rows] = np.arange(len(rows))
    return positions


def size_of(entries: np.ndarray) -> int:
    """Number of rows n of symmetric matrices, from K = n (n + 1)/2."""
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
    """The sum of new arrays, one after the other; the first of them is overwritten."""
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


def definite(
    middle: np.ndarray, radius: np.ndarray, terms: np.ndarray | None = None
) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
    """Whether all symmetric matrices in an enclosure are positive definite."""
    c, positive = factors(middle)
    n, at = len(c), places(len(c))
    with np.errstate(all="ignore"):
        error, size = np.abs(np.eye(n)[np.tril_indices(n)][:, None] - congruent(c, middle)), np.abs(middle)
        if terms is not None:
            error += sum_over(np.abs(congruent(c, terms)))
            size += sum_over(np.abs(terms))
        # |C|ᵀ R |C| bounds what the radii add, and ROUND times the sizes what rounding of the congruences above adds.
        error += congruent(np.abs(c), radius + ROUND * size)
        # Rounded up, by a relative and an absolute margin, so that E bounds |I − CᵀSC| despite all rounding.
        e = (error * (1 + ROUND) + ROUND)[at]
        x = np.ones((n, e.shape[2]))
        # A few steps of power iteration: any positive x proves the claim, the Perron vector of E does so most often.
        for _ in range(4):
            x = sum_over(e * x[:, None]) + 1e-6
            x /= x.max(axis=0)
        # The left side is rounded up. SLACK lowers the right side, so that another implementation decides alike.
        # With an unbounded radius both sides may be ∞ or NaN (∞ · 0), for which the comparison is False.
        below = (sum_over(e * x[:, None]) * (1 + ROUND) + TINY <= (1 - SLACK) * x).all(axis=0)
    return below & positive, c


def weights(c: np.ndarray, terms: np.ndarray, shares: np.ndarray) -> Float[np.ndarray, "m B"]:
    """How much each term of an enclosure and its share widen it, after the congruence by C."""
    n = len(c)
    rows, columns = np.tril_indices(n)
    with np.errstate(all="ignore"):
        # The sum of all entries: those below the diagonal stand for those above it too.
        size = sum_over(np.swapaxes(np.abs(c), 0, 1))
        parts = np.abs(congruent(c, terms))
        parts += shares * (size[rows] * size[columns])
        parts *= np.where(rows == columns, 1.0, 2.0)[:, None]
        return sum_over(np.swapaxes(parts, 0, 1))


def indefinite(middle: np.ndarray, radius: np.ndarray) -> Bool[np.ndarray, "B"]:
    """Whether no symmetric matrix in an enclosure is positive definite: xᵀSx < 0 for some x and all of them."""
    middle, radius = symmetric(middle), symmetric(radius)
    finite = np.asarray(((np.abs(middle) < HUGE) & np.isfinite(radius)).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], middle, 0.0)
    # The eigenvector of the least eigenvalue makes xᵀSx least; any x would do for the proof.
    x = np.linalg.eigh(safe)[1][:, :, :1]
    xt = np.swapaxes(x, 1, 2)
    with np.errstate(all="ignore"):
        # An upper bound of xᵀSx over the enclosure: a negative one refutes definiteness.
        most = xt @ safe @ x + np.abs(xt) @ (radius + ROUND * np.abs(safe)) @ np.abs(x) * (1 + ROUND) + TINY
    return finite & (most[:, 0, 0] < 0)


def factors(middle: np.ndarray) -> tuple[Float[np.ndarray, "n n B"], Bool[np.ndarray, "B"]]:
    """Factors C with `CᵀSC` near the identity, for entries of S in any units.

    Of all such factors it is the inverse square root: it rotates least, and rotation increases sums of absolute values.
    """
    n, full = size_of(middle), symmetric(middle)
    diagonal = np.abs(np.diagonal(full, axis1=1, axis2=2))
    # Scaled to a diagonal of ones first: eigenvectors of entries in mixed units would be lost to rounding.
    units = 1 / np.sqrt(np.where(np.isfinite(diagonal) & (diagonal > TINY), diagonal, 1.0))
    with np.errstate(all="ignore"):
        scaled = full * units[:, :, None] * units[:, None, :]
    finite = np.asarray((np.abs(scaled) < HUGE).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], scaled, np.eye(n)))
    # Eigenvalues of magnitude zero would make C infinite; its accuracy does not matter for the proof.
    sizes = np.maximum(np.abs(values), np.abs(values).max(axis=1, keepdims=True) * 1e-12 + TINY)
    # S^−½ of the scaled matrix: congruence by it gives the identity, up to rounding and the signs of eigenvalues.
    root = (vectors / np.sqrt(sizes)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.ascontiguousarray((units[:, :, None] * root).transpose(1, 2, 0)), finite & (values[:, 0] > 0)
