"""Encloses a symmetric matrix over boxes, from graphs of its entries and of their derivatives.

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

from scalargraph import Graph, Lowered, expand
from scalargraph._typing import Arithmetic
from scalargraph.errors import InputError
from scalargraph.graph import graft, pairs
from scalargraph.intervals import Enclosure
from scalargraph.proofs._box import Box
from scalargraph.proofs._definite import ROUND, TINY, sum_over
from scalargraph.proofs._tree import middle_of

MOST_DERIVED = 10
"""Largest number f of variables for which derivatives are bounded; there are about f²/2 second derivatives."""


class Expansions(NamedTuple):
    """A symmetric matrix (n, n) as graphs of its K entries on and below the diagonal, and of their derivatives.

    Attributes:
        value: Graph of the entries.
        first: Graph of the entries and first derivatives; None if Taylor models of the entries are used instead.
        second: Graph of the entries, first and second derivatives; None in the same case.
        size: Number of rows, n.
        free: Indices (f,) of the variables that the matrix reads and that have distinct bounds.
        width: Widths (d,) of the whole domain.
        engine: Arithmetic that bounds the graphs, as for `scalargraph.enclose`.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph import lower
        >>> from scalargraph.proofs import box
        >>> from scalargraph.proofs._enclosure import Expansions
        >>> domain = box(a=(-1.0, 1.0), b=(0.0, 1.0))
        >>> expansions = Expansions.of(lower(lambda z: jnp.array([[2.0 + z[0] ** 2]]), jnp.zeros(2)), domain)
        >>> expansions.size, expansions.free.tolist(), expansions.width.tolist()
        (1, [0], [2.0, 1.0])
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
        """The expansions of the graph of all entries."""
        shape = entries.results[0].shape
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            raise InputError(f"the matrix must be square; it has shape {shape}")
        rows, columns = np.tril_indices(shape[0])
        graph = Graph.of(entries.graph.nodes)
        # xᵀMx depends on the symmetric part only, so an entry and its mirror image are averaged to one entry.
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
    """Enclosures of symmetric matrices on B boxes, by their K entries on and below the diagonal, in two forms.

    The first is Taylor's form: the entries are within `rest` of `centre + Σ wₘ terms[m]`, |wₘ| ≤ 1. In the second they
    are within `radius` of `middle`.

    Attributes:
        centre: Shifted values (K, B) at the centres.
        terms: One term for each free variable and one for each pair of them (f + p, K, B).
        rest: Remainders (K, B); infinite if the matrix is not `smooth`.
        middle: Middles (K, B) of bounds of the entries.
        radius: Half widths (K, B) of these bounds.
        shares: Contribution (f + p, K, B) of each variable or pair of variables to `rest`.
        smooth: Boxes (B,) on which all derivatives exist everywhere.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from scalargraph import enclose, lower
        >>> from scalargraph.proofs import box
        >>> from scalargraph.proofs._enclosure import Expansions, enclosed_by, half_widths
        >>> domain = box(a=(-1.0, 1.0))
        >>> matrix = Expansions.of(lower(lambda z: jnp.array([[2.0 + z[0] ** 2]]), jnp.zeros(1)), domain)
        >>> low, high = domain.low[None], domain.high[None]
        >>> at, on = enclose(matrix.first, 0 * low, 0 * low), enclose(matrix.second, low, high)
        >>> enclosures = enclosed_by(at, on, half_widths(matrix, low, high), 1)
        >>> enclosures.middle.round(3).tolist(), enclosures.radius.round(3).tolist()
        ([[2.5]], [[0.5]])
    """

    centre: np.ndarray
    terms: np.ndarray
    rest: np.ndarray
    middle: np.ndarray
    radius: np.ndarray
    shares: np.ndarray
    smooth: Bool[np.ndarray, "B"]


def half_widths(matrix: Expansions, low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, "f B"]:
    """Half widths of boxes in the free variables, rounded up."""
    centre = middle_of(low, high)
    # The middle is rounded, so the two half widths differ by a rounding: the larger one, rounded up, covers the box.
    return np.ascontiguousarray((np.maximum(high - centre, centre - low)[:, matrix.free] * (1 + ROUND)).T)


def enclosed_by(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> EnclosedMatrices:
    """Enclosures of symmetric matrices on boxes, from bounds of their graphs."""
    f, boxes = half.shape
    with np.errstate(invalid="ignore", over="ignore"):  # the middle of bounds −∞ and ∞ is NaN
        value, terms, shares = taylor_form(at, on, half, k)
        # A form with derivatives is valid only if these exist everywhere in the box.
        # The radii of all terms are added to one remainder; the middles stay separate, so that they can cancel.
        rest = np.where(on.smooth, (value.radius + sum_over(shares)) * (1 + ROUND) + TINY, np.inf)
        radius = rest + sum_over(np.abs(terms)) * (1 + ROUND)
        low, high = on.low.T[: k + f * k], on.high.T[: k + f * k]
        # NaN marks an unknown bound. `fmax` and `fmin` ignore it and return the bound of the other form.
        lower_bound = np.fmax(_outward(value.middle - radius, -1), low[:k])
        upper_bound = np.fmin(_outward(value.middle + radius, 1), high[:k])
        # The mean-value form needs the value at the centre itself; Taylor's form has shifted it.
        centre_value, size = Ball.of(at.low.T[:k], at.high.T[:k]), np.maximum(np.abs(low[k:]), np.abs(high[k:]))
        mean_value_term = sum_over(size.reshape(f, k, boxes) * half[:, None])
        deviation = np.where(on.smooth, centre_value.radius + mean_value_term * (1 + ROUND), np.inf)
        lower_bound = np.fmax(lower_bound, _outward(centre_value.middle - deviation, -1))
        upper_bound = np.fmin(upper_bound, _outward(centre_value.middle + deviation, 1))
        middle = middle_of(lower_bound, upper_bound)
        radius = np.maximum(upper_bound - middle, middle - lower_bound) * (1 + ROUND) + TINY
    return EnclosedMatrices(value.middle, terms, rest, middle, radius, shares, on.smooth)


class Ball(NamedTuple):
    """Numbers that are known up to a radius around a middle.

    Attributes:
        middle: Middles, an array of any shape.
        radius: Radii in the same shape, rounded up.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs._enclosure import Ball
        >>> ball = Ball.of(np.array([1.0]), np.array([2.0]))
        >>> ball.middle.tolist(), bool(ball.radius[0] >= 0.5)
        ([1.5], True)
    """

    middle: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray) -> "Ball":
        """The balls of numbers between bounds."""
        middle = middle_of(low, high)
        # Rounded up, so that both bounds lie inside the ball although its middle is rounded.
        return cls(middle, np.maximum(high - middle, middle - low) * (1 + ROUND) + TINY)


def taylor_form(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> tuple[Ball, np.ndarray, np.ndarray]:
    """Taylor's form `S(c) + Σ Sᵢ(c) δᵢ + ½ Σ Sᵢⱼ δᵢδⱼ` over all δ within ± half.

    Since δᵢ² ≥ 0, its range is not symmetric: the middle of the range shifts the value, and the half width is a term.
    """
    f, boxes = half.shape
    first = k + f * k
    value, slopes = (Ball.of(at.low.T[part], at.high.T[part]) for part in (slice(k), slice(k, first)))
    second_derivatives = Ball.of(on.low.T[first:], on.high.T[first:])
    chosen = pairs(f)
    if not f:
        nothing = np.empty((0, k, boxes))
        return Ball(value.middle, value.radius + ROUND * np.abs(value.middle)), nothing, nothing
    terms, shares = np.empty((2, f + len(chosen), k, boxes))
    np.multiply(slopes.middle.reshape(f, k, boxes), half[:, None], out=terms[:f])
    np.multiply(slopes.radius.reshape(f, k, boxes), half[:, None], out=shares[:f])
    # ½ Σ runs over all i, j: a pair i ≠ j occurs twice, a square once.
    size = np.stack([half[i] * half[j] / (2 if i == j else 1) for i, j in chosen])[:, None]
    square = np.array([i == j for i, j in chosen])
    np.multiply(
        second_derivatives.middle.reshape(-1, k, boxes), size * np.where(square, 0.5, 1.0)[:, None, None], out=terms[f:]
    )
    np.multiply(second_derivatives.radius.reshape(-1, k, boxes), size * (1 + ROUND), out=shares[f:])
    # With δ = ε · half, ε² lies in [0, 1] = ½ ± ½: half of each square shifts the centre, and half stays a term.
    shifted = value.middle + sum_over(terms[f:][square])
    rounding = ROUND * (np.abs(value.middle) + sum_over(np.abs(terms[f:])))
    return Ball(shifted, value.radius + rounding), terms, shares


def _outward(x: np.ndarray, sign: int) -> np.ndarray:
    """A bound moved by more than its rounding error, up for the sign 1 and down for −1."""
    return x + sign * (np.abs(x) * ROUND + TINY)
