"""A lowered function: its graph of scalars, where its results are in it, and where it is defined."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.lowering._graph import Condition, Graph


class LoweringError(NotImplementedError):
    """A function that cannot be written as a graph of scalars: which operation, and why."""


class Lowered(NamedTuple):
    """A function as a graph.

    - `arguments`: shapes of the leaves of the arguments, whose entries are the inputs, in order.
    - `outputs`: nodes of the entries of the results; `results`, `tree`: their leaves, and how these hang together.
    - `conditions`: where the function is defined and does not jump, if it was asked for as one of real numbers.
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

    def nodes(self) -> Any:
        """The function's result with the nodes in the places of their values."""
        left = iter(self.outputs)
        leaves = [np.array([next(left) for _ in range(leaf.size)], int).reshape(leaf.shape) for leaf in self.results]
        return jax.tree.unflatten(self.tree, leaves)

    def rebuild(self, values: Sequence[np.ndarray]) -> Any:
        """The function's result from the values of the outputs, arrays of one batch shape (...)."""
        left = iter(values)
        leaves = []
        for leaf in self.results:
            part = np.array(list(itertools.islice(left, leaf.size)))
            kind = float if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype
            leaves.append(np.moveaxis(part, 0, -1).reshape((*part.shape[1:], *leaf.shape)).astype(kind))
        return jax.tree.unflatten(self.tree, leaves)


class Conditions(NamedTuple):
    """What must be so wherever a function is defined and does not jump: a graph of its own, and what its nodes mean."""

    graph: Graph
    conditions: tuple[Condition, ...]
    inputs: int

    @classmethod
    def of(cls, graph: Graph, conditions: Sequence[Condition], inputs: int) -> "Conditions":
        """These conditions on nodes of a graph, without what they do not need of it."""
        small, places = graph.pruned([condition.node for condition in conditions])
        noted = tuple(c._replace(node=place) for c, place in zip(conditions, places, strict=True))
        return cls(small, noted, inputs)
