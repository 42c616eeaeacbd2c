"""Loops of a graph: what is done again and again is a graph of its own.

A node `loop` holds a `Repetition` and gets the numbers that stay fixed, then those that are carried; nodes `part` are
what each carried number is in the end. Loops are for code, and not for proofs: neither derivatives nor intervals know
them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from covariant.lowering._arrays import Scalars, Value, nodes_of
from covariant.lowering._graph import Graph, Node
from covariant.lowering._lowered import Lowered

Turn = Callable[[Graph, list[Value]], tuple[list[Value], Value | None]]


class Repetition(NamedTuple):
    """Numbers carried on by `body` as long as `going` holds, or so many times as `turns` says.

    - `body`: `(fixed, carried) -> carried`; `going`: `(fixed, carried) -> [truth]`, or None where that number is known.
    - `fixed`: how many of the inputs of both are fixed.
    """

    body: Lowered
    going: Lowered | None
    turns: int | None
    fixed: int

    @property
    def carried(self) -> int:
        """How many numbers are carried."""
        return len(self.body.outputs)

    @property
    def graphs(self) -> tuple[Lowered, ...]:
        """The graphs of a turn."""
        return (self.body,) if self.going is None else (self.body, self.going)

    def over(self, change: Callable[[Lowered], Lowered]) -> "Repetition":
        """The loop with its graphs changed."""
        return self._replace(body=change(self.body), going=None if self.going is None else change(self.going))

    def key(self) -> tuple:
        """What two loops that do the same have in common."""
        graphs = ((tuple(map(_keyed, each.graph.nodes)), each.outputs) for each in self.graphs)
        return self.turns, self.fixed, *graphs


def _keyed(node: Node) -> tuple:
    return node.op, node.arguments, node.value.key() if isinstance(node.value, Repetition) else node.value


def add_loop(graph: Graph, loop: Repetition, arguments: Sequence[int]) -> int:
    """The node of a loop added to a graph, or of one that is there and does the same."""
    return graph.block("loop", loop.key(), tuple(arguments), loop)


def part_of(graph: Graph, loop: int, k: int) -> int:
    """The node of what the k-th carried number is in the end."""
    return graph.block("part", k, (loop,), k)


def loop_of(
    graph: Graph,
    turn: Turn,
    fixed: Sequence[Value],
    carry: Sequence[Value],
    count: int | None = None,
    least: int = 0,
) -> list[Value] | None:
    """What is carried in the end of a loop, as values in a graph; None where a turn is less than `least` operations.

    - `turn`: `(graph, [*fixed, *carry]) -> (carry, going)`, which adds one turn to another graph; `going` is a
      statement on what the turn starts with, or None with a `count` of turns.

    Entries that a turn leaves as they are, are fixed too, and so keep what is known of them. At first all count as
    such; those that a turn changes no longer do, until there are no more.
    """
    starts = _flat(graph, carry)
    changes = np.zeros(len(starts), bool)
    while True:
        inner, used = Graph(), dict[int, None]()

        def outer(i: int, inner: Graph = inner, used: dict[int, None] = used) -> int:
            node = graph.nodes[i]
            if node.op == "constant":
                return inner.constant(node.value)  # pyright: ignore[reportArgumentType]
            used[i] = None
            return inner.input(2 * i)  # odd positions are those of what is carried; numbered anew below

        begins = [inner.input(2 * k + 1) if changes[k] else outer(i) for k, i in enumerate(starts)]
        held = _filled([outer(i) for i in _flat(graph, fixed)], fixed)
        found, going = turn(inner, [*held, *_filled(begins, carry, changes)])
        ends = _flat(inner, found)
        now = changes | (np.array(ends, int) != np.array(begins, int))
        if (now == changes).all():
            break
        changes = now
    places = np.flatnonzero(changes).tolist()
    order = {position: n for n, position in enumerate([*(2 * i for i in used), *(2 * k + 1 for k in places)])}

    def cut(outputs: Sequence[int]) -> Lowered:
        small, kept = inner.pruned(outputs)
        small.nodes[:] = [n._replace(value=order[n.value]) if n.op == "input" else n for n in small.nodes]
        result = (jax.ShapeDtypeStruct((len(kept),), float),)
        return Lowered(small, ((len(order),),), tuple(kept), result, jax.tree.structure(0))

    body = cut([ends[k] for k in places])
    if len(body.graph.nodes) < least:
        return None
    stop = None if going is None else cut(_flat(inner, [going]))
    loop = Repetition(body, stop, count, len(used))
    at = add_loop(graph, loop, [*used, *(starts[k] for k in places)])
    parts = {k: part_of(graph, at, n) for n, k in enumerate(places)}
    return _filled([parts.get(k, start) for k, start in enumerate(starts)], carry, changes)


def _flat(graph: Graph, values: Sequence[Value]) -> list[int]:
    return [int(i) for value in values for i in nodes_of(graph, value).ravel()]


def _filled(ids: Sequence[int], like: Sequence[Value], changes: np.ndarray | None = None) -> list[Value]:
    """Values of the shapes of others with these nodes; known numbers that do not change stay known numbers."""
    found, at = [], 0
    for value in like:
        known = not isinstance(value, Scalars)
        shape = value.shape if known else value.ids.shape
        size = int(np.prod(shape, dtype=int))
        same = known and (changes is None or not changes[at : at + size].any())
        found.append(value if same else Scalars(np.array(ids[at : at + size], int).reshape(shape)))
        at += size
    return found
