"""Defines a lowered function: its graph of scalars, the nodes of its results, and the conditions of its domain."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph.errors import InputError
from scalargraph.graph._graph import Condition, Graph


class LoweringError(InputError, NotImplementedError):
    """A function cannot be written as a graph of scalars; the message names the operation and the reason.

    It means that the number of operations depends on the values of the arguments, or that an operation has no scalar
    form. Give an observer fixed `substeps` and a `Budget` with a number of corrections, or write the function with
    other operations.

    Example:
        >>> import jax
        >>> import scalargraph
        >>> def double(x):
        ...     return jax.lax.while_loop(lambda z: z < 1.0, lambda z: 2.0 * z, x)
        >>> scalargraph.lower(double, 0.1)
        Traceback (most recent call last):
        ...
        scalargraph.graph._lowered.LoweringError: a 'while' loop runs until something the arguments decide; ...
    """


class Lowered(NamedTuple):
    """A function as a graph of scalar operations.

    `lower` creates it; `evaluate`, `enclose` and `c_function` use it. Shapes of the arguments are fixed. The number of
    nodes indicates the cost of a call on a controller.

    Attributes:
        graph: The nodes.
        arguments: Shapes of the leaves of the arguments, whose entries are the inputs, in order.
        outputs: Nodes of the entries of the results, in order.
        results: Shape and type of each leaf of the results.
        tree: Pytree structure of the results.
        conditions: Conditions under which the function is defined and does not jump; None unless lowered with
            `real=True`.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda x: jnp.sin(x), jnp.zeros(2))
        >>> lowered.inputs, [node.op for node in lowered.graph.nodes]
        (2, ['input', 'input', 'sin', 'sin'])
    """

    graph: Graph
    arguments: tuple[tuple[int, ...], ...]
    outputs: tuple[int, ...]
    results: tuple[jax.ShapeDtypeStruct, ...]
    tree: Any
    conditions: "Conditions | None" = None

    @property
    def inputs(self) -> int:
        """Number of scalar inputs."""
        return sum(math.prod(shape) for shape in self.arguments)

    def nodes(self) -> Any:
        """Return the result of the function with nodes in place of values.

        Returns:
            The pytree of the results; each leaf is an integer array of indices of nodes.
        """
        remaining = iter(self.outputs)
        leaves = [
            np.array([next(remaining) for _ in range(leaf.size)], int).reshape(leaf.shape) for leaf in self.results
        ]
        return jax.tree.unflatten(self.tree, leaves)

    def rebuild(self, values: Sequence[Any], batch: tuple[int, ...]) -> Any:
        """Assemble the result of the function from the values of the outputs.

        Args:
            values: Value of each output, a number or an array of the batch shape (...).
            batch: The batch shape; `()` for single values.

        Returns:
            The pytree of the results; each leaf has the batch axes first.
        """
        remaining = iter(values)
        leaves = []
        for leaf in self.results:
            # NumPy evaluates in double precision, so results of single-precision functions are doubles too.
            kind = float if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype
            part = np.empty((leaf.size, *batch), kind)
            for k, value in enumerate(itertools.islice(remaining, leaf.size)):
                part[k] = value
            leaves.append(np.ascontiguousarray(np.moveaxis(part, 0, -1)).reshape((*batch, *leaf.shape)))
        return jax.tree.unflatten(self.tree, leaves)


class Conditions(NamedTuple):
    """Conditions under which a function is defined and does not jump, with a graph that computes what they refer to.

    Attributes:
        graph: Graph of the nodes of the conditions, separate from the graph of the function.
        conditions: The conditions; each `node` is an index in this graph.
        inputs: Number of scalar inputs, the same as of the function.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> conditions = scalargraph.lower(lambda x: jnp.log(x), jnp.array(1.0), real=True).conditions
        >>> len(conditions.conditions), conditions.inputs
        (1, 1)
    """

    graph: Graph
    conditions: tuple[Condition, ...]
    inputs: int

    @classmethod
    def of(cls, graph: Graph, conditions: Sequence[Condition], inputs: int) -> "Conditions":
        """Collect conditions on nodes of a graph, with only the part of the graph that they need.

        Args:
            graph: The graph that the conditions refer to.
            conditions: The conditions.
            inputs: Number of scalar inputs of the function.
        """
        small, places = graph.pruned([condition.node for condition in conditions])
        noted = tuple(c._replace(node=place) for c, place in zip(conditions, places, strict=True))
        return cls(small, noted, inputs)
