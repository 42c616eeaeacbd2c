"""The matrix of a proof as a graph of its entries, and the balls in which numbers between bounds lie."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from scalargraph import Graph, Lowered
from scalargraph.errors import InputError
from scalargraph.graph import graft
from scalargraph.proofs._box import Box
from scalargraph.proofs._definite import ROUND, TINY
from scalargraph.proofs._tree import middle_of


class Entries(NamedTuple):
    """A symmetric matrix (n, n) as a graph of its K entries on and below the diagonal.

    Attributes:
        value: Graph of the entries.
        free: Indices (f,) of the variables that the matrix reads and that have distinct bounds.
        width: Widths (d,) of the whole domain.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph import lower
        >>> from scalargraph.proofs import box
        >>> from scalargraph.proofs._enclosure import Entries
        >>> domain = box(a=(-1.0, 1.0), b=(0.0, 1.0))
        >>> entries = Entries.of(lower(lambda z: jnp.array([[2.0 + z[0] ** 2]]), jnp.zeros(2)), domain)
        >>> len(entries.value.outputs), entries.free.tolist(), entries.width.tolist()
        (1, [0], [2.0, 1.0])
    """

    value: Lowered
    free: Int[np.ndarray, "f"]
    width: Float[np.ndarray, "d"]

    @classmethod
    def of(cls, entries: Lowered, domain: Box) -> "Entries":
        """The entries on and below the diagonal, from the graph of all entries."""
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
        return cls(value, free, domain.high - domain.low)


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
