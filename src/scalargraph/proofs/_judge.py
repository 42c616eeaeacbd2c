"""Decides about boxes: the matrix is proved positive definite on a box, refuted there, or the box is halved.

A box that is not decided is halved across the variable that widens the enclosure most.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from scalargraph import enclose
from scalargraph.graph import pairs
from scalargraph.proofs._box import Box
from scalargraph.proofs._definite import ROUND, TINY, definite, indefinite, weights
from scalargraph.proofs._entries import Entries
from scalargraph.proofs._models import polynomials
from scalargraph.proofs._tree import OPEN, PROVED, middle_of

MODELLED = 128
"""Number of boxes whose Taylor models are computed at once."""


def judge(matrix: Entries, low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    """For each box return that it is proved, or the variable across which to halve it; or find a counter-example."""
    proved, weight = _test_boxes(matrix, low, high)
    codes = np.full(len(low), PROVED)
    rest = np.flatnonzero(~proved)
    if not len(rest):
        return codes, None
    # A counter-example ends the whole search, and it is likeliest in the middle of a box that is not proved.
    counterexample = counterexample_at(matrix, middle_of(low[rest], high[rest]))
    if counterexample is not None:
        return codes, counterexample
    weight = weight[rest]
    relative = ((high - low)[rest] / np.where(matrix.width > 0, matrix.width, 1.0))[:, matrix.free]
    weight = np.where(np.isfinite(weight).all(axis=1, keepdims=True), weight, relative)
    # If no variable has an effect, or none of them can be halved any more, the widest side is halved.
    middle = middle_of(low[rest], high[rest])[:, matrix.free]
    possible = (middle > low[rest][:, matrix.free]) & (middle < high[rest][:, matrix.free])
    # Relative widths only decide between variables of equal weight; −1 marks variables that cannot be halved.
    weight = np.where(possible, weight + 1e-9 * relative * weight.max(axis=1, keepdims=True, initial=0.0), -1.0)
    # A box whose sides are adjacent floats, or that has no free variables, stays open.
    codes[rest] = np.where(possible.any(axis=1), matrix.free[weight.argmax(axis=1)] if len(matrix.free) else OPEN, OPEN)
    return codes, None


def _test_boxes(
    matrix: Entries, low: np.ndarray, high: np.ndarray
) -> tuple[Bool[np.ndarray, "B"], Float[np.ndarray, "B f"]]:
    """Which boxes are proved by Taylor models, and how much each variable widens the models of the others."""
    f = len(matrix.free)
    proved, weight = np.empty(len(low), bool), np.empty((len(low), f))
    for start in range(0, len(low), MODELLED):
        chunk = slice(start, start + MODELLED)
        models = polynomials(matrix.value, low[chunk], high[chunk], matrix.free)
        proved[chunk], c = definite(models.centre, models.rest, models.terms)
        rest = np.flatnonzero(~proved[chunk])
        shares = np.zeros_like(models.terms[..., rest])
        shares[:f] = models.shares[..., rest]
        parts = np.zeros((len(models.terms), len(c.T)))
        parts[:, rest] = weights(c[..., rest], models.terms[..., rest], shares)
        # Where nothing is bounded, the variables to blame for that are halved.
        blind = np.asarray(models.blame.any(axis=0))
        weight[chunk] = np.where(blind[:, None], models.blame.T, _weight(parts, models.owners, f))
    return proved, weight


def look_around(matrix: Entries, domain: Box, count: int = 4096) -> np.ndarray | None:
    """Search random points of a box for a point at which the matrix is not positive definite."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(size=(count, len(domain.low)))
    inside[::2] = np.round(inside[::2])  # corners, where the smallest eigenvalue often lies
    points = np.clip(domain.low + inside * (domain.high - domain.low), domain.low, domain.high)
    return counterexample_at(matrix, points)


def counterexample_at(matrix: Entries, points: np.ndarray) -> np.ndarray | None:
    """The first of some points at which the matrix is proved not to be positive definite."""
    at = enclose(matrix.value, points, points)
    low, high = at.low.T, at.high.T
    middle = middle_of(low, high)
    # Rounded up, so that both bounds lie within the radius although the middle is rounded.
    radius = np.maximum(high - middle, middle - low) * (1 + ROUND) + TINY
    wrong = np.flatnonzero(indefinite(middle, radius))
    # The box of a single point has two equal corners.
    return np.stack([points[wrong[0]]] * 2) if len(wrong) else None


def _weight(parts: np.ndarray, owners: np.ndarray, f: int) -> Float[np.ndarray, "B f"]:
    """How much each variable widens the enclosures, from their terms (m, B); the term of a pair counts for both.

    `owners`: the variable to which each symbol in the terms belongs.
    """
    weight = np.zeros((f, parts.shape[1]))
    for number, owner in enumerate(owners):
        weight[owner] += parts[number]
    for number, (i, j) in enumerate(pairs(len(owners)), start=len(owners)):
        weight[owners[i]] += parts[number]
        if owners[i] != owners[j]:
            weight[owners[j]] += parts[number]
    return weight.T
