"""Defines loops of a graph: the turn of a loop is a graph of its own, which is evaluated repeatedly.

A node `loop` holds a `Repetition`; its arguments are the numbers that stay fixed, then the carried ones. Nodes `part`
are the carried numbers after the last turn. Loops are for generated code and not for proofs, as neither derivatives nor
intervals have rules for them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from scalargraph.graph._arrays import Scalars, Value, nodes_of
from scalargraph.graph._graph import Graph, Node
from scalargraph.graph._lowered import Lowered

NO_OPERATIONS = ("input", "constant", "loop", "part")
"""Kinds of nodes that compute nothing by themselves."""
LONG = 400
"""Number of operations in a turn above which a loop of known length is not unrolled."""
MOST_UNROLLED = 0.8
"""A loop is unrolled if this saves operations: if all turns together have at most this share of those of the loop.
Otherwise it stays a loop, which is shorter to write and to compile."""
SLOWLY = 4
"""Number of attempts after which all entries of an array count as changing if some do. Otherwise, if a turn shifts an
array by a row, each attempt would find only one more changing row."""
Turn = Callable[[Graph, list[Value]], tuple[list[Value], Value | None]]


class Repetition(NamedTuple):
    """A loop: numbers carried from turn to turn.

    Attributes:
        body: A turn, `(fixed, carried) -> carried`.
        going: `(fixed, carried) -> [truth]`, whether there is another turn; None if the number of turns is known.
        turns: Number of turns; None if `going` decides.
        fixed: Number of fixed inputs of both functions; the other inputs are carried.
    """

    body: Lowered
    going: Lowered | None
    turns: int | None
    fixed: int

    @property
    def carried(self) -> int:
        """Number of carried numbers."""
        return len(self.body.outputs)

    @property
    def graphs(self) -> tuple[Lowered, ...]:
        """The graphs of a turn: the body and, if there is one, the condition."""
        return (self.body,) if self.going is None else (self.body, self.going)

    def over(self, change: Callable[[Lowered], Lowered]) -> "Repetition":
        """Return the loop with its graphs changed."""
        return self._replace(body=change(self.body), going=None if self.going is None else change(self.going))

    def key(self) -> tuple:
        """Return a hashable description of the loop.

        Loops with equal keys do the same.
        """
        graphs = ((tuple(map(_node_key, each.graph.nodes)), each.outputs) for each in self.graphs)
        return self.turns, self.fixed, *graphs


def _node_key(node: Node) -> tuple:
    return node.op, node.arguments, node.value.key() if isinstance(node.value, Repetition) else node.value


def add_loop(graph: Graph, loop: Repetition, arguments: Sequence[int]) -> int:
    """Return the node of a loop, adding it to the graph unless an equal one is there."""
    return graph.block("loop", loop.key(), tuple(arguments), loop)


def part_of(graph: Graph, loop: int, k: int) -> int:
    """Return the node of a carried number after the last turn."""
    return graph.block("part", k, (loop,), k)


def loop_of(
    graph: Graph,
    turn: Turn,
    fixed: Sequence[Value],
    carry: Sequence[Value],
    count: int | None = None,
    least: int = 0,
    all_change: bool = False,
) -> list[Value] | None:
    """Add a loop over arrays to a graph.

    Entries that a turn does not change count as fixed, so that known values of them are also known in the loop. At
    first all entries count as fixed, unless `all_change`; entries that a turn changes are then removed, and this is
    repeated until no further entry changes.
    """
    starts = _flat(graph, carry)
    changes = np.full(len(starts), all_change)
    ends_of_arrays = np.cumsum([_size(value) for value in carry])
    attempt = 0
    while True:
        attempt += 1
        inner, used = Graph(), dict[int, None]()

        def outer(i: int, inner: Graph = inner, used: dict[int, None] = used) -> int:
            node = graph.nodes[i]
            if node.op == "constant":
                return inner.constant(node.value)  # pyright: ignore[reportArgumentType]
            used[i] = None
            return inner.input(2 * i)  # odd positions are for carried numbers; all inputs are renumbered below

        begins = [inner.input(2 * k + 1) if changes[k] else outer(i) for k, i in enumerate(starts)]
        fixed_values = _fill_values([outer(i) for i in _flat(graph, fixed)], fixed)
        carried, going = turn(inner, [*fixed_values, *_fill_values(begins, carry, changes)])
        ends = _flat(inner, carried)
        # An entry that counts as changing never becomes fixed again, so this loop ends.
        now = changes | (np.array(ends, int) != np.array(begins, int))
        if (now == changes).all():
            break
        if attempt >= SLOWLY:
            parts = np.split(now, ends_of_arrays[:-1])
            now = np.concatenate([np.full(len(part), part.any()) for part in parts])
        changes = now
    places = np.flatnonzero(changes).tolist()
    order = {position: n for n, position in enumerate([*(2 * i for i in used), *(2 * k + 1 for k in places)])}

    def cut(outputs: Sequence[int]) -> Lowered:
        small, roots = inner.pruned(outputs)
        small.nodes[:] = [n._replace(value=order[n.value]) if n.op == "input" else n for n in small.nodes]
        result = (jax.ShapeDtypeStruct((len(roots),), float),)
        return Lowered(small, ((len(order),),), tuple(roots), result, jax.tree.structure(0))

    body = cut([ends[k] for k in places])
    if operations(body.graph.nodes) < least:
        return None
    stop = None if going is None else cut(_flat(inner, [going]))
    loop = Repetition(body, stop, count, len(used))
    node_of_loop = add_loop(graph, loop, [*used, *(starts[k] for k in places)])
    parts = {k: part_of(graph, node_of_loop, n) for n, k in enumerate(places)}
    return _fill_values([parts.get(k, start) for k, start in enumerate(starts)], carry, changes)


def operations(nodes: Sequence[Node]) -> int:
    """Count the operations of a list of nodes, over all turns of their loops.

    Args:
        nodes: Nodes of a graph. A loop whose length depends on the arguments counts as one turn.
    """
    total = 0
    for node in nodes:
        if isinstance(node.value, Repetition):
            turns = 1 if node.value.turns is None else node.value.turns
            total += turns * sum(operations(each.graph.nodes) for each in node.value.graphs)
        else:
            total += node.op not in NO_OPERATIONS
    return total


def turn_operations(nodes: Sequence[Node]) -> int:
    """Count the operations of one turn of each loop whose length depends on the arguments.

    Args:
        nodes: Nodes of a graph.

    Returns:
        The count, zero if the graph has no such loop.
    """
    loops = [node.value for node in nodes if isinstance(node.value, Repetition) and node.value.turns is None]
    return sum(operations(each.graph.nodes) for loop in loops for each in loop.graphs)


def _size(value: Value) -> int:
    return int(value.ids.size if isinstance(value, Scalars) else np.size(value))


def _flat(graph: Graph, values: Sequence[Value]) -> list[int]:
    return [int(i) for value in values for i in nodes_of(graph, value).ravel()]


def _fill_values(ids: Sequence[int], like: Sequence[Value], changes: np.ndarray | None = None) -> list[Value]:
    """Arrays of the shapes of others with these nodes as entries; known numbers that do not change stay known."""
    filled, start = [], 0
    for value in like:
        known = not isinstance(value, Scalars)
        shape = value.shape if known else value.ids.shape
        size = _size(value)
        same = known and (changes is None or not changes[start : start + size].any())
        filled.append(value if same else Scalars(np.array(ids[start : start + size], int).reshape(shape)))
        start += size
    return filled
