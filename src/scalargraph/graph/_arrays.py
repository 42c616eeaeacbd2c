"""Represents arrays whose entries are nodes of a graph of scalars, and applies operations to such arrays."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scalargraph.graph._graph import Graph


class Scalars(NamedTuple):
    """An array whose entries are nodes of a graph.

    Attributes:
        ids: Indices of the nodes, an integer array (...).
    """

    ids: np.ndarray


Value = Scalars | np.ndarray
"""An array that depends on the arguments, or one of known numbers."""


def nodes_of(graph: Graph, value: Value) -> np.ndarray:
    """Return the nodes of an array; known numbers become constants."""
    if isinstance(value, Scalars):
        return value.ids
    flat = [graph.constant(v) for v in np.asarray(value).ravel().tolist()]
    return np.array(flat, int).reshape(np.shape(value))


class Writer:
    """Adds operations on arrays to a graph, entry by entry.

    Args:
        graph: The graph, which is changed.
        tables: Whether known numbers may be looked up in tables.
    """

    def __init__(self, graph: Graph, tables: bool = False):
        self.graph, self.tables = graph, tables

    def map(self, op: str, *values: Value) -> Scalars:
        """Apply an operation entry by entry."""
        arrays = [nodes_of(self.graph, value) for value in values]
        shape = arrays[0].shape
        if any(array.shape != shape for array in arrays):  # checked first, since broadcasting is slow and rarely needed
            arrays = np.broadcast_arrays(*arrays)
            shape = arrays[0].shape
        apply = self.graph.apply
        flat = [apply(op, *ids) for ids in zip(*(array.ravel().tolist() for array in arrays), strict=True)]
        return Scalars(np.array(flat, int).reshape(shape))

    def reduce(self, op: str, ids: np.ndarray, axes: Sequence[int]) -> Scalars:
        """Reduce over some axes by recursive halving, which accumulates less rounding error than a loop."""
        remaining = [axis for axis in range(ids.ndim) if axis not in axes]
        shape = [ids.shape[axis] for axis in remaining]
        rows = np.transpose(ids, [*remaining, *axes]).reshape(math.prod(shape), math.prod(ids.shape[a] for a in axes))

        def together(row: list[int]) -> int:
            if len(row) < 2:
                return row[0] if row else self.graph.constant(_NEUTRAL[op])
            # Pairwise summation: its error grows with log n, the error of a loop with n (Higham 2002, section 4.2).
            middle = len(row) // 2
            return self.graph.apply(op, together(row[:middle]), together(row[middle:]))

        return Scalars(np.array([together(row) for row in rows.tolist()], int).reshape(shape))

    def stack(self, values: list[Value]) -> Value:
        """Stack arrays along a new first axis."""
        if not any(isinstance(value, Scalars) for value in values):
            return np.stack(values)
        return Scalars(np.stack([nodes_of(self.graph, value) for value in values]))

    def truth(self, value: Value) -> np.ndarray | None:
        """Return the truth values of statements, or None if one of them depends on the arguments."""
        if not isinstance(value, Scalars):
            return np.asarray(value, bool)
        nodes = [self.graph.nodes[i] for i in value.ids.ravel().tolist()]
        if any(node.op != "constant" for node in nodes):
            return None
        return np.array([bool(node.value) for node in nodes]).reshape(value.ids.shape)

    def chosen(self, first: np.ndarray, a: Value, b: Value) -> Value:
        """Choose each row from one of two arrays: from `a` where `first` is true, else from `b`."""
        # The mask covers the leading axes and is broadcast along the others.
        mask = first.reshape(first.shape + (1,) * (np.ndim(a.ids if isinstance(a, Scalars) else a) - first.ndim))
        if isinstance(a, Scalars) or isinstance(b, Scalars):
            return Scalars(np.where(mask, nodes_of(self.graph, a), nodes_of(self.graph, b)))
        return np.where(mask, a, b)

    def within(self, value: Scalars, low: float, high: float) -> None:
        """Add the condition that all entries lie strictly between two numbers."""
        for node in set(value.ids.ravel().tolist()):
            self.graph.need_between(low, node, high)


_NEUTRAL = {"add": 0.0, "mul": 1.0, "and": True, "or": False, "max": -np.inf, "min": np.inf}
"""Result of each reduction over no entries."""
