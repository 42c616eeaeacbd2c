"""Enclosures of a symmetric matrix over boxes, from a graph of its entries and of their derivatives.

On each box the entries are enclosed in three ways: by natural interval evaluation; by the mean-value form around the
centre, `S(z) ∈ S(c) + S'(box) (z − c)`; and by Taylor's form, `S(z) ∈ S(c) + S'(c) (z − c) + ½ S''(box) (z − c)²`,
which needs about ten times fewer boxes for each variable.

Source: Neumaier 1990, Interval Methods for Systems of Equations, section 2.3.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from covariant._typing import Arithmetic
from covariant.lowering import Enclosure, Graph, Lowered, expand, graft, pairs
from covariant.proofs._box import Box
from covariant.proofs._definite import ROUND, TINY, sum_over
from covariant.proofs._tree import middle_of

MOST_DERIVED = 10
"""Most variables for which derivatives are bounded; there are half as many second ones as the square of that number."""


class Expansions(NamedTuple):
    """A symmetric matrix (n, n) as graphs of its K entries on and below the diagonal, and of their derivatives.

    - `value`, `first`, `second`: the entries, with first derivatives, and with first and second derivatives. These are
      None where Taylor models of the entries take their place.
    - `engine`: who bounds them, as for `enclose`.
    - `size`: n; `free` (f,): the variables that are read and not held fixed; `width` (d,): widths of the whole domain.
    """

    value: Lowered
    first: Lowered | None
    second: Lowered | None
    size: int
    free: Int[np.ndarray, "f"]
    width: Float[np.ndarray, "d"]
    engine: Arithmetic = "auto"

    @classmethod
    def of(
        cls,
        entries: Lowered,
        domain: Box,
        engine: Arithmetic = "auto",
        form: Literal["auto", "derivatives", "models"] = "auto",
    ) -> "Expansions":
        """The expansions of the graph of all entries. Raises `ValueError` where the matrix is not square.

        `form`: "derivatives" or "models" leave no choice; "auto" takes models of more than `MOST_DERIVED` variables.
        """
        shape = entries.results[0].shape
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            raise ValueError(f"the matrix must be square; it has shape {shape}")
        rows, columns = np.tril_indices(shape[0])
        graph = Graph.of(entries.graph.nodes)
        lower = graft(graph, lambda full: ((full + full.T) / 2)[rows, columns], entries.nodes())
        value = entries._replace(outputs=tuple(lower.tolist()))._replace(graph=graph)
        small, outputs = graph.pruned(value.outputs)
        result = jax.ShapeDtypeStruct((len(outputs),), jnp.float64)
        value = value._replace(graph=small, outputs=tuple(outputs), results=(result,), tree=jax.tree.structure(result))
        read = {int(node.value or 0) for node in small.nodes if node.op == "input"}
        free = np.array([i for i in np.flatnonzero(domain.high > domain.low) if i in read], int)
        width = domain.high - domain.low
        if form == "models" or (form == "auto" and len(free) > MOST_DERIVED):
            return cls(value, None, None, shape[0], free, width, engine)
        second = expand(value, free.tolist(), 2)
        first, value = (second.leading(count) for count in (2, 1))
        return cls(value, first, second, shape[0], free, width, engine)


class EnclosedMatrices(NamedTuple):
    """Enclosures of symmetric matrices on boxes, by their K entries on and below the diagonal, in two forms.

    - `centre + Σ wₘ terms[m]` within `rest` (K, B), |wₘ| ≤ 1, terms (f + p, K, B): Taylor's form, with one term for
      each free variable and one for each pair of them. `rest` is infinite where the matrix is not `smooth`.
    - `middle` within `radius` (K, B): bounds of the entries.
    - `shares` (f + p, K, B): contribution of each variable or pair to `rest`.
    """

    centre: np.ndarray
    terms: np.ndarray
    rest: np.ndarray
    middle: np.ndarray
    radius: np.ndarray
    shares: np.ndarray
    smooth: Bool[np.ndarray, "B"]


def half_widths(matrix: Expansions, low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, "f B"]:
    """Half widths of boxes with corners (B, d) in the free variables, rounded up."""
    centre = middle_of(low, high)
    return np.ascontiguousarray((np.maximum(high - centre, centre - low)[:, matrix.free] * (1 + ROUND)).T)


def enclosed_by(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> EnclosedMatrices:
    """Enclosures of matrices with k entries on boxes of half widths (f, B).

    `at` encloses the entries and their first derivatives at the centres, and `on` those and the second on the boxes.
    """
    f, boxes = half.shape
    with np.errstate(invalid="ignore", over="ignore"):  # the middle of bounds −∞ and ∞ is NaN
        value, terms, shares = taylor_form(at, on, half, k)
        # A form with derivatives holds where these exist everywhere in the box.
        rest = np.where(on.smooth, (value.radius + sum_over(shares)) * (1 + ROUND) + TINY, np.inf)
        radius = rest + sum_over(np.abs(terms)) * (1 + ROUND)
        low, high = on.low.T[: k + f * k], on.high.T[: k + f * k]
        lower_bound = np.fmax(_outward(value.middle - radius, -1), low[:k])
        upper_bound = np.fmin(_outward(value.middle + radius, 1), high[:k])
        # The mean-value form is around the value at the centre, which Taylor's form has shifted.
        here, size = Ball.of(at.low.T[:k], at.high.T[:k]), np.maximum(np.abs(low[k:]), np.abs(high[k:]))
        wide = sum_over(size.reshape(f, k, boxes) * half[:, None])
        spread = np.where(on.smooth, here.radius + wide * (1 + ROUND), np.inf)
        lower_bound = np.fmax(lower_bound, _outward(here.middle - spread, -1))
        upper_bound = np.fmin(upper_bound, _outward(here.middle + spread, 1))
        middle = middle_of(lower_bound, upper_bound)
        radius = np.maximum(upper_bound - middle, middle - lower_bound) * (1 + ROUND) + TINY
    return EnclosedMatrices(value.middle, terms, rest, middle, radius, shares, on.smooth)


class Ball(NamedTuple):
    """Numbers within `radius` of `middle`."""

    middle: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray) -> "Ball":
        middle = middle_of(low, high)
        return cls(middle, np.maximum(high - middle, middle - low) * (1 + ROUND) + TINY)


def taylor_form(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> tuple[Ball, np.ndarray, np.ndarray]:
    """`S(c) + Σ Sᵢ(c) δᵢ + ½ Σ Sᵢⱼ δᵢδⱼ` over δ within ± half (f, B): shifted value (K, B), terms and contributions.

    Since δᵢ² is never negative, half of its largest contribution shifts the value, and bounds the deviation from it.
    """
    f, boxes = half.shape
    first = k + f * k
    value, slopes = (Ball.of(at.low.T[part], at.high.T[part]) for part in (slice(k), slice(k, first)))
    bends = Ball.of(on.low.T[first:], on.high.T[first:])
    chosen = pairs(f)
    if not f:
        nothing = np.empty((0, k, boxes))
        return Ball(value.middle, value.radius + ROUND * np.abs(value.middle)), nothing, nothing
    terms, shares = np.empty((2, f + len(chosen), k, boxes))
    np.multiply(slopes.middle.reshape(f, k, boxes), half[:, None], out=terms[:f])
    np.multiply(slopes.radius.reshape(f, k, boxes), half[:, None], out=shares[:f])
    size = np.stack([half[i] * half[j] / (2 if i == j else 1) for i, j in chosen])[:, None]
    square = np.array([i == j for i, j in chosen])
    np.multiply(bends.middle.reshape(-1, k, boxes), size * np.where(square, 0.5, 1.0)[:, None, None], out=terms[f:])
    np.multiply(bends.radius.reshape(-1, k, boxes), size * (1 + ROUND), out=shares[f:])
    moved = value.middle + sum_over(terms[f:][square])
    rounding = ROUND * (np.abs(value.middle) + sum_over(np.abs(terms[f:])))
    return Ball(moved, value.radius + rounding), terms, shares


def _outward(x: np.ndarray, sign: int) -> np.ndarray:
    return x + sign * (np.abs(x) * ROUND + TINY)
