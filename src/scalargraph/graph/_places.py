"""Applies slices, gathers and scatters to arrays of nodes: operations that move entries or take them from places.

If the places are known numbers, the primitive itself is applied to the indices of the nodes. If they depend on the
arguments, the result is a choice among the entries at all possible places, if these are few, or an entry of a table, if
the entries are known numbers.
"""

import itertools
import math
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from scalargraph.graph._arrays import Scalars, Value, Writer, nodes_of
from scalargraph.graph._constants import SLICES, gather_places, scatter_places
from scalargraph.graph._graph import Table
from scalargraph.graph._jax_forms import JaxprEquation
from scalargraph.graph._lowered import LoweringError

MOST_PLACES = 64
"""Largest number of possible places for an index that depends on the arguments, unless it is an index of a table."""
FEW_PLACES = 8
"""Largest number of places for which a choice costs no more than a table."""
MOST_ENTRIES = 2_000_000
"""Largest table of known numbers: about 40 MB of C, and 16 MB of memory at run time."""


def at_places(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    """Apply a primitive that reads entries at places, or sets them or adds to them there."""
    name = eqn.name
    move = _add_updates if name == "scatter-add" else _move_nodes
    where, ends = _places(name, eqn.params, [atom.aval.shape for atom in eqn.invars])
    fills = name == "gather" and eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    drops = name.startswith("scatter") and eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    places = [nodes_of(write.graph, values[i]) for i in where]
    flat = [int(node) for place in places for node in place.ravel()]
    known = [write.graph.nodes[node].value if write.graph.nodes[node].op == "constant" else None for node in flat]

    def result_at(numbers: Sequence) -> np.ndarray:
        remaining, arguments = iter(numbers), []
        for i, value in enumerate(values):
            if i in where:
                shape, dtype = eqn.invars[i].aval.shape, eqn.invars[i].aval.dtype
                arguments.append(np.array([next(remaining) for _ in range(math.prod(shape))], dtype).reshape(shape))
            else:
                arguments.append(nodes_of(write.graph, value))
        return move(write, eqn, arguments)

    if None not in known:
        return [Scalars(result_at([value for value in known if value is not None]))]
    largest = [ends[k % len(ends)] for k in range(len(flat))]
    choices = [range(end + 1) if value is None else (value,) for end, value in zip(largest, known, strict=True)]
    count = math.prod(len(choice) for choice in choices)
    if count > FEW_PLACES and name == "dynamic_slice" and write.tables:
        table = _table(write, nodes_of(write.graph, values[0]))
        if table is not None:
            return [Scalars(_look_up_slice(write, table, eqn, flat, largest))]
        size = math.prod(eqn.invars[0].aval.shape)
        if size > MOST_ENTRIES:
            raise LoweringError(
                f"'{name}' looks up a table of {size} numbers, and code holds at most {MOST_ENTRIES}; take a metric on "
                "a grid of fewer points, or a shorter table"
            )
    if not 0 < count <= MOST_PLACES:
        raise LoweringError(f"'{name}' at one of {count} places that the arguments decide has no graph of scalars")
    if not (fills or drops):  # places out of bounds are clipped
        limits = [(write.graph.constant(0.0), write.graph.constant(end)) for end in largest]
        flat = [
            node if value is not None else write.graph.apply("min", write.graph.apply("max", node, low), high)
            for node, value, (low, high) in zip(flat, known, limits, strict=True)
        ]
    # The index after the last place is out of bounds: the primitive's result there is the default of the choice.
    outside = [float(end + 1) for end in largest]
    result = result_at([o if v is None else v for o, v in zip(outside, known, strict=True)]) if fills or drops else None
    for combination in itertools.product(*choices):
        chosen = write.graph.constant(True)
        for node, value, number in zip(flat, known, combination, strict=True):
            if value is None:
                chosen = write.graph.apply("and", chosen, write.graph.apply("eq", node, write.graph.constant(number)))
        ids = result_at(combination)
        if result is not None:
            ids = write.map("select", Scalars(np.array(chosen)), Scalars(ids), Scalars(result)).ids
        result = ids
    assert result is not None
    return [Scalars(result)]


def _table(write: Writer, operand: np.ndarray) -> Table | None:
    """The entries of an array as a table; None if some are not known numbers or if there are too many."""
    nodes = [write.graph.nodes[i] for i in operand.ravel().tolist()]
    if len(nodes) > MOST_ENTRIES or any(node.op != "constant" for node in nodes):
        return None
    return Table(np.array([node.value for node in nodes], float))


def _look_up_slice(
    write: Writer, table: Table, eqn: JaxprEquation, starts: Sequence[int], ends: Sequence[int]
) -> np.ndarray:
    """A slice of a table whose start depends on the arguments; the start is clipped so that the slice fits."""
    graph, shape, sizes = write.graph, eqn.invars[0].aval.shape, eqn.params["slice_sizes"]
    strides = [math.prod(shape[k + 1 :]) for k in range(len(shape))]
    first = graph.constant(0.0)
    for start, end, stride in zip(starts, ends, strides, strict=True):
        inside = graph.apply("min", graph.apply("max", start, graph.constant(0.0)), graph.constant(float(end)))
        first = graph.apply("add", first, graph.apply("mul", inside, graph.constant(float(stride))))
    ids = np.empty(sizes, int)
    for offsets in np.ndindex(*sizes):
        ahead = graph.constant(float(np.dot(offsets, strides)))
        ids[offsets] = graph.look_up(table, graph.apply("add", first, ahead))
    return ids


def _places(name: str, p: dict, shapes: Sequence[tuple[int, ...]]) -> tuple[range, list[int]]:
    """The indices of the arguments that hold places, and the largest value of each number in a place (last axis)."""
    operand = shapes[0]
    if name == "dynamic_slice":
        return range(1, len(shapes)), [a - b for a, b in zip(operand, p["slice_sizes"], strict=True)]
    if name == "dynamic_update_slice":
        return range(2, len(shapes)), [a - b for a, b in zip(operand, shapes[1], strict=True)]
    numbers = p["dimension_numbers"]
    if name == "gather":
        return range(1, 2), [operand[d] - p["slice_sizes"][d] for d in numbers.start_index_map]
    free = [d for d in range(len(operand)) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    window = dict(zip(free, (shapes[2][k] for k in numbers.update_window_dims), strict=True))
    return range(1, 2), [operand[d] - window.get(d, 1) for d in numbers.scatter_dims_to_operand_dims]


def _move_nodes(write: Writer, eqn: JaxprEquation, arguments: list[np.ndarray]) -> np.ndarray:
    """Nodes moved by the primitive, which is applied to the indices of the nodes."""
    if eqn.name in SLICES:
        return SLICES[eqn.name](eqn.params, *arguments)
    if eqn.name == "gather":
        operand, starts = arguments
        places = gather_places(eqn.params, operand.shape, starts)
        outside = write.graph.constant(float("nan"))
        return np.where(places < 0, outside, np.append(operand, outside)[places])
    operand, places, updates = arguments
    moved = operand.ravel().copy()
    for target, node in _targets(eqn, operand, places, updates):
        moved[target] = node
    return moved.reshape(operand.shape)


def _add_updates(write: Writer, eqn: JaxprEquation, arguments: list[np.ndarray]) -> np.ndarray:
    operand, places, updates = arguments
    total = operand.ravel().copy()
    for target, node in _targets(eqn, operand, places, updates):
        total[target] = write.graph.apply("add", int(total[target]), node)
    return total.reshape(operand.shape)


def _targets(
    eqn: JaxprEquation, operand: np.ndarray, places: np.ndarray, updates: np.ndarray
) -> Iterator[tuple[int, int]]:
    """Pairs of a place in the flat operand and a node of the updates; updates without a place are left out."""
    targets = scatter_places(eqn.params, operand.shape, places, updates.shape)
    pairs = zip(targets.ravel().tolist(), updates.ravel().tolist(), strict=True)
    return (pair for pair in pairs if pair[0] >= 0)
