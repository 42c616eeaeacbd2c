"""Decision on a box: the matrix is proved positive definite on it, or shown not to be, or the box is halved.

A box that is not decided is halved across the variable that widens the enclosure most.
"""

import numpy as np
from jaxtyping import Int

from covariant.lowering import Enclosure, enclose, pairs
from covariant.proofs._box import Box
from covariant.proofs._definite import definite, factors, indefinite
from covariant.proofs._enclosure import Ball, Expansions, enclosed, symmetric, taylor_form
from covariant.proofs._tree import OPEN, PROVED, middle_of


def judge(matrix: Expansions, low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    """A code for each box: proved, the variable to halve, or open if it cannot be halved; and a counter-example."""
    found = enclosed(matrix, low, high)
    proved, c = definite(found.centre, found.rest, found.terms)
    rest = np.flatnonzero(~proved)
    proved[rest] = definite(found.middle[rest], found.radius[rest])[0]
    codes = np.full(len(low), PROVED)
    rest = np.flatnonzero(~proved)
    if not len(rest):
        return codes, None
    wrong = counterexample_at(matrix, middle_of(low[rest], high[rest]))
    if wrong is not None:
        return codes, wrong
    weight = _weight(c[rest], found.terms[rest], found.shares[rest], len(matrix.free))
    blind = np.flatnonzero(~(np.isfinite(weight).all(axis=1) & found.smooth[rest]))
    if len(blind):
        weight[blind] = _weight_at_centre(matrix, low[rest][blind], high[rest][blind])
    relative = ((high - low)[rest] / np.where(matrix.width > 0, matrix.width, 1.0))[:, matrix.free]
    lost = ~np.isfinite(weight).all(axis=1)
    weight[lost] = relative[lost]
    # Where every variable has no effect, or cannot be halved any more, the widest one is halved.
    middle = middle_of(low[rest], high[rest])[:, matrix.free]
    possible = (middle > low[rest][:, matrix.free]) & (middle < high[rest][:, matrix.free])
    weight = np.where(possible, weight + 1e-9 * relative * weight.max(axis=1, keepdims=True, initial=0.0), -1.0)
    codes[rest] = np.where(possible.any(axis=1), matrix.free[weight.argmax(axis=1)] if len(matrix.free) else OPEN, OPEN)
    return codes, None


def look_around(matrix: Expansions, domain: Box, count: int = 4096) -> np.ndarray | None:
    """A point of the domain, as a box (2, d), at which the matrix is not positive definite, from random points."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(size=(count, len(domain.low)))
    inside[::2] = np.round(inside[::2])  # corners, where the smallest eigenvalue often is
    points = np.clip(domain.low + inside * (domain.high - domain.low), domain.low, domain.high)
    return counterexample_at(matrix, points)


def counterexample_at(matrix: Expansions, points: np.ndarray) -> np.ndarray | None:
    """The first of some points (k, d), as a box (2, d), at which the matrix is shown not to be positive definite."""
    at = enclose(matrix.value, points, points)
    middle, radius = (symmetric(part, matrix.size) for part in Ball.of(at.low, at.high))
    wrong = np.flatnonzero(indefinite(middle, radius))
    return np.stack([points[wrong[0]]] * 2) if len(wrong) else None


def _weight(c: np.ndarray, terms: np.ndarray, shares: np.ndarray, f: int) -> np.ndarray:
    """How much each variable (B, f) widens the enclosures, after the factors c bring the matrices near the identity.

    The contribution of a pair counts for both of its variables.
    """
    c, size = c[:, None], np.abs(c)[:, None]
    with np.errstate(all="ignore"):
        sizes = np.abs(np.swapaxes(c, 2, 3) @ terms @ c) + np.swapaxes(size, 2, 3) @ shares @ size
    parts = sizes.sum(axis=(2, 3))
    weight = parts[:, :f].copy()
    for number, (i, j) in enumerate(pairs(f), start=f):
        weight[:, i] += parts[:, number]
        if i != j:
            weight[:, j] += parts[:, number]
    return weight


def _weight_at_centre(matrix: Expansions, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The weights from derivatives at the centre alone, for boxes on which nothing is bounded."""
    centre = middle_of(low, high)
    at, k = enclose(matrix.second, centre, centre), matrix.size * (matrix.size + 1) // 2
    count = k + len(matrix.free) * k
    near = Enclosure(at.low[:, :count], at.high[:, :count], at.smooth)
    value, _, terms, shares = taylor_form(near, at, (high - low)[:, matrix.free] / 2, k)
    c = factors(symmetric(value.middle, matrix.size))[0]
    return _weight(c, symmetric(terms, matrix.size), symmetric(shares, matrix.size), len(matrix.free))
