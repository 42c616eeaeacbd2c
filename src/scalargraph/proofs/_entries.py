"""The matrix of a proof, as a graph of its entries on and below the diagonal."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from scalargraph import Graph, Lowered
from scalargraph.errors import InputError
from scalargraph.graph import graft
from scalargraph.proofs._box import Box


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
        >>> from scalargraph.proofs._entries import Entries
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
        small, outputs = graph.pruned(tuple(lower.tolist()))
        result = jax.ShapeDtypeStruct((len(outputs),), jnp.float64)
        value = entries._replace(graph=small, outputs=tuple(outputs), results=(result,))
        read = {int(node.value or 0) for node in small.nodes if node.op == "input"}
        free = np.array([i for i in np.flatnonzero(domain.high > domain.low) if i in read], int)
        return cls(value, free, domain.high - domain.low)
