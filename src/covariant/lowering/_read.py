"""Evaluation of a graph in any arithmetic that has its operations."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from covariant.lowering._graph import FOLD, Graph
from covariant.lowering._loops import Repetition
from covariant.lowering._lowered import Lowered

Domain = Mapping[str, Callable[..., Any]]
"""An arithmetic: a function for each operation of `FOLD`, and `constant`, which converts a number or truth value."""

NUMBERS: Domain = {"constant": lambda value: value, **FOLD}
"""Numbers, and NumPy arrays of them, with which a whole batch is evaluated at once."""


def evaluate(lowered: Lowered, domain: Domain, inputs: Sequence[Any]) -> list[Any]:
    """Values of the outputs for given values of the inputs, all in the arithmetic `domain`.

    Raises `ValueError` where the number of inputs is not that of the graph.
    """
    if len(inputs) != lowered.inputs:
        raise ValueError(f"the graph has {lowered.inputs} inputs; got {len(inputs)}")
    return evaluate_nodes(lowered.graph, lowered.outputs, domain, inputs)


def evaluate_nodes(graph: Graph, outputs: Sequence[int], domain: Domain, inputs: Sequence[Any]) -> list[Any]:
    """Values of some nodes of a graph. Each is released after its last use, so that large batches fit in memory."""
    nodes = graph.nodes
    last = [-1] * len(nodes)
    for i, node in enumerate(nodes):
        for a in node.arguments:
            last[a] = i
    for i in outputs:
        last[i] = len(nodes)
    values: list[Any] = [None] * len(nodes)
    for i, node in enumerate(nodes):
        if node.op == "input":
            values[i] = inputs[node.value]  # pyright: ignore[reportArgumentType, reportCallIssue]
        elif node.op == "constant":
            values[i] = domain["constant"](node.value)
        else:
            found = [values[a] for a in node.arguments]
            if node.op == "part":
                values[i] = found[0][node.value]
            elif node.op == "table":
                values[i] = node.value.at(found[0])  # pyright: ignore[reportOptionalMemberAccess]
            else:
                values[i] = _looped(node.value, domain, found) if node.op == "loop" else domain[node.op](*found)
            for a in node.arguments:
                if last[a] == i:
                    values[a] = None
    return [values[i] for i in outputs]


def _looped(loop: Repetition, domain: Domain, values: Sequence[Any]) -> list[Any]:
    """What a loop carries in the end; lanes of a batch that are through wait for the others."""
    fixed, carried = list(values[: loop.fixed]), list(values[loop.fixed :])
    if loop.going is None:
        for _ in range(loop.turns or 0):
            carried = evaluate(loop.body, domain, [*fixed, *carried])
        return carried
    while np.any(going := evaluate(loop.going, domain, [*fixed, *carried])[0]):
        moved = evaluate(loop.body, domain, [*fixed, *carried])
        carried = [domain["select"](going, new, old) for new, old in zip(moved, carried, strict=True)]
    return carried


def numbers(lowered: Lowered, *arguments: Any) -> Any:
    """The function's result in double precision, for arguments with common leading batch axes (...).

    Operations that are undefined give NaN or infinity, as in NumPy, without a warning.
    """
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(arguments)]
    inputs = [entry for leaf, shape in zip(leaves, lowered.arguments, strict=True) for entry in _entries(leaf, shape)]
    with np.errstate(all="ignore"):
        values = evaluate(lowered, NUMBERS, inputs)
    batch = np.broadcast_shapes(*(np.shape(entry) for entry in inputs)) if inputs else ()
    return lowered.rebuild(values, batch)


def _entries(leaf: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """The scalars of a leaf, each with its batch axes."""
    batch = leaf.shape[: leaf.ndim - len(shape)]
    return [np.asarray(entry) for entry in np.moveaxis(leaf.reshape(*batch, -1), -1, 0)]
