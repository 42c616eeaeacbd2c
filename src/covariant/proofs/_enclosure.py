"""Enclosures of a symmetric matrix over boxes, from a graph of its entries and of their derivatives.

On each box the entries are enclosed in three ways: by natural interval evaluation; by the mean-value form around the
centre, `S(z) ∈ S(c) + S'(box) (z − c)`; and by Taylor's form, `S(z) ∈ S(c) + S'(c) (z − c) + ½ S''(box) (z − c)²`,
which needs about ten times fewer boxes for each variable.

Source: Neumaier 1990, Interval Methods for Systems of Equations, section 2.3.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from covariant.lowering import Enclosure, Graph, Lowered, enclose, expand, graft, pairs
from covariant.proofs._box import Box
from covariant.proofs._definite import ROUND, TINY
from covariant.proofs._tree import middle_of


class Expansions(NamedTuple):
    """A symmetric matrix (n, n) as graphs of its K entries on and below the diagonal, and of their derivatives.

    - `value`, `first`, `second`: the entries, with first derivatives, and with first and second derivatives.
    - `size`: n; `free` (f,): the variables that are not held fixed; `width` (d,): widths of the whole domain.
    """

    value: Lowered
    first: Lowered
    second: Lowered
    size: int
    free: Int[np.ndarray, "f"]
    width: Float[np.ndarray, "d"]

    @classmethod
    def of(cls, entries: Lowered, domain: Box) -> "Expansions":
        """The expansions of the graph of all entries. Raises `ValueError` where the matrix is not square."""
        shape = entries.results[0].shape
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            raise ValueError(f"the matrix must be square; it has shape {shape}")
        rows, columns = np.tril_indices(shape[0])
        free = np.flatnonzero(domain.high > domain.low)
        graph = Graph.of(entries.graph.nodes)
        lower = graft(graph, lambda full: ((full + full.T) / 2)[rows, columns], entries.nodes())
        value = entries._replace(outputs=tuple(lower.tolist()))._replace(graph=graph)
        first, second = (expand(value, free.tolist(), order) for order in (1, 2))
        small, outputs = graph.pruned(value.outputs)
        value = value._replace(graph=small, outputs=tuple(outputs))
        return cls(value, first, second, shape[0], free, domain.high - domain.low)


class EnclosedMatrices(NamedTuple):
    """Enclosures of symmetric matrices (n, n) on boxes, in two forms.

    - `centre + Σ wₘ terms[m]` within `rest`, |wₘ| ≤ 1, terms (B, f + p, n, n): Taylor's form, with one term for each
      free variable and one for each pair of them. `rest` is infinite where the matrix is not `smooth`.
    - `middle` within `radius` (B, n, n): bounds of the entries.
    - `shares` (B, f + p, n, n): contribution of each variable or pair to `rest`.
    """

    centre: np.ndarray
    terms: np.ndarray
    rest: np.ndarray
    middle: np.ndarray
    radius: np.ndarray
    shares: np.ndarray
    smooth: Bool[np.ndarray, "B"]


def symmetric(entries: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices (..., n, n) from their entries on and below the diagonal (..., K)."""
    rows, columns = np.tril_indices(n)
    full = np.empty((*entries.shape[:-1], n, n))
    full[..., rows, columns] = entries
    full[..., columns, rows] = entries
    return full


def enclosed(matrix: Expansions, low: np.ndarray, high: np.ndarray) -> EnclosedMatrices:
    """Enclosures of the matrix on boxes with corners (B, d)."""
    centre = middle_of(low, high)
    at, on = enclose(matrix.first, centre, centre), enclose(matrix.second, low, high)
    k, f = matrix.size * (matrix.size + 1) // 2, len(matrix.free)
    half = np.maximum(high - centre, centre - low)[:, matrix.free] * (1 + ROUND)
    smooth = on.smooth[:, None]
    with np.errstate(invalid="ignore", over="ignore"):  # the middle of bounds −∞ and ∞ is NaN
        value, slopes, terms, shares = taylor_form(at, on, half, k)
        # A form with derivatives holds where these exist everywhere in the box.
        rest = np.where(smooth, (value.radius + shares.sum(axis=1)) * (1 + ROUND) + TINY, np.inf)
        size = np.maximum(np.abs(on.low), np.abs(on.high))[:, k : k + f * k].reshape(slopes.middle.shape)
        radius = rest + np.abs(terms).sum(axis=1) * (1 + ROUND)
        lower_bound = np.fmax(_outward(value.middle - radius, -1), on.low[:, :k])
        upper_bound = np.fmin(_outward(value.middle + radius, 1), on.high[:, :k])
        # The mean-value form is around the value at the centre, which Taylor's form has shifted.
        here = Ball.of(at.low[:, :k], at.high[:, :k])
        spread = np.where(smooth, here.radius + (size * half[:, :, None]).sum(axis=1) * (1 + ROUND), np.inf)
        lower_bound = np.fmax(lower_bound, _outward(here.middle - spread, -1))
        upper_bound = np.fmin(upper_bound, _outward(here.middle + spread, 1))
        middle = middle_of(lower_bound, upper_bound)
        radius = np.maximum(upper_bound - middle, middle - lower_bound) * (1 + ROUND) + TINY
    parts = (value.middle, terms, rest, middle, radius, shares)
    full = [symmetric(part, matrix.size) for part in parts]
    return EnclosedMatrices(*full, smooth=on.smooth)


class Ball(NamedTuple):
    """Numbers within `radius` of `middle`."""

    middle: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray) -> "Ball":
        middle = middle_of(low, high)
        return cls(middle, np.maximum(high - middle, middle - low) * (1 + ROUND) + TINY)


def taylor_form(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> tuple[Ball, Ball, np.ndarray, np.ndarray]:
    """`S(c) + Σ Sᵢ(c) δᵢ + ½ Σ Sᵢⱼ δᵢδⱼ` over δ within ± half (B, f): shifted value, slopes, terms and contributions.

    Since δᵢ² is never negative, half of its largest contribution shifts the value, and bounds the deviation from it.
    """
    boxes, f = half.shape
    value, slopes = Ball.of(at.low[:, :k], at.high[:, :k]), Ball.of(at.low[:, k:], at.high[:, k:])
    slopes = Ball(*(part.reshape(boxes, f, k) for part in slopes))
    bends = Ball(*(part.reshape(boxes, -1, k) for part in Ball.of(on.low[:, k + f * k :], on.high[:, k + f * k :])))
    chosen = pairs(f)
    size = np.stack([half[:, i] * half[:, j] / (2 if i == j else 1) for i, j in chosen], axis=1)[:, :, None]
    square = np.array([i == j for i, j in chosen])[:, None]
    bent = bends.middle * size * np.where(square, 0.5, 1.0)
    moved = value.middle + np.where(square, bent, 0.0).sum(axis=1)
    rounding = ROUND * (np.abs(value.middle) + np.abs(bent).sum(axis=1))
    terms = np.concatenate([slopes.middle * half[:, :, None], bent], axis=1)
    shares = np.concatenate([slopes.radius * half[:, :, None], bends.radius * size * (1 + ROUND)], axis=1)
    return Ball(moved, value.radius + rounding), slopes, terms, shares


def _outward(x: np.ndarray, sign: int) -> np.ndarray:
    return x + sign * (np.abs(x) * ROUND + TINY)
