"""A lowered function: its graph of scalars, the nodes of its results, and the conditions of its domain."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.lowering._graph import Condition, Graph


class LoweringError(NotImplementedError):
    """A function that cannot be written as a graph of scalars; the message names the operation and the reason."""


class Lowered(NamedTuple):
    """A function as a graph.

    - `arguments`: shapes of the leaves of the arguments, whose entries are the inputs, in order.
    - `outputs`: nodes of the entries of the results; `results`, `tree`: the leaves of the results, and their pytree.
    - `conditions`: where the function is defined and does not jump; None unless it was lowered with `real=True`.
    """

    graph: Graph
    arguments: tuple[tuple[int, ...], ...]
    outputs: tuple[int, ...]
    results: tuple[jax.ShapeDtypeStruct, ...]
    tree: Any
    conditions: "Conditions | None" = None

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return sum(math.prod(shape) for shape in self.arguments)

    def leading(self, count: int) -> "Lowered":
        """The function of the first leaves of the results alone, as a tuple, with what it needs of the graph."""
        results = self.results[:count]
        small, outputs = self.graph.pruned(self.outputs[: sum(leaf.size for leaf in results)])
        return Lowered(small, self.arguments, tuple(outputs), results, jax.tree.structure(results))

    def nodes(self) -> Any:
        """The result of the function, with nodes in place of values."""
        left = iter(self.outputs)
        leaves = [np.array([next(left) for _ in range(leaf.size)], int).reshape(leaf.shape) for leaf in self.results]
        return jax.tree.unflatten(self.tree, leaves)

    def rebuild(self, values: Sequence[Any], batch: tuple[int, ...]) -> Any:
        """The result of the function from the values of the outputs, numbers or arrays of the batch shape (...)."""
        left = iter(values)
        leaves = []
        for leaf in self.results:
            kind = float if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype
            part = np.empty((leaf.size, *batch), kind)
            for k, value in enumerate(itertools.islice(left, leaf.size)):
                part[k] = value
            leaves.append(np.ascontiguousarray(np.moveaxis(part, 0, -1)).reshape((*batch, *leaf.shape)))
        return jax.tree.unflatten(self.tree, leaves)


class Conditions(NamedTuple):
    """Conditions under which a function is defined and does not jump: a graph of their own, and what its nodes mean."""

    graph: Graph
    conditions: tuple[Condition, ...]
    inputs: int

    @classmethod
    def of(cls, graph: Graph, conditions: Sequence[Condition], inputs: int) -> "Conditions":
        """Conditions on nodes of a graph, with only the part of the graph that they need."""
        small, places = graph.pruned([condition.node for condition in conditions])
        noted = tuple(c._replace(node=place) for c, place in zip(conditions, places, strict=True))
        return cls(small, noted, inputs)
