"""Separates the computations that depend on some inputs alone, so that many calls share one evaluation of them.

A model's parameters stay the same from step to step, and so does everything that is computed from them alone: `split`
moves it out of the step. Within a loop, values that do not change from turn to turn are moved in front of the loop.
"""

import itertools
from collections.abc import Mapping, Sequence

import jax

from scalargraph.c._c_writer import truths
from scalargraph.graph import Graph, Lowered, Repetition, add_loop, part_of


def split(lowered: Lowered, count: int) -> tuple[Lowered, Lowered]:
    """Split a function into a part that only its first inputs determine, and the rest.

    Args:
        lowered: The function; its conditions are dropped.
        count: Number k of inputs that stay the same over many calls.

    Returns:
        A function of the first k inputs, whose results d are the intermediate values that the rest needs, and a
        function from d and the other inputs to the results. The argument of the latter is one array of both.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> first, rest = scalargraph.split(scalargraph.lower(lambda a, x: jnp.sqrt(a) * x, 1.0, 1.0), 1)
        >>> [node.op for node in first.graph.nodes], [node.op for node in rest.graph.nodes]
        (['input', 'sqrt'], ['input', 'input', 'mul'])
    """
    lowered = _hoist_invariants(lowered)
    graph = lowered.graph
    taken = _invariant_nodes(graph, count, lowered.outputs)
    rest = Graph()
    values = [rest.input(k) for k in range(len(taken) + lowered.inputs - count)]
    known = dict(zip(taken, _as_kinds(graph, taken, rest, values), strict=False))
    outputs = _copy_nodes(graph, lowered.outputs, rest, dict(enumerate(values[len(taken) :], start=count)), known)
    first, results = graph.pruned(taken)
    numbers = (jax.ShapeDtypeStruct((len(taken),), float),)
    return (
        Lowered(first, ((count,),), tuple(results), numbers, jax.tree.structure(0)),
        _prune_graph(lowered, rest, outputs, len(values)),
    )


def _invariant_nodes(graph: Graph, count: int, outputs: Sequence[int]) -> list[int]:
    """Nodes that the first inputs determine and that the rest or a result uses; constants are left out."""
    decided: list[bool] = []
    used = set(outputs)
    for node in graph.nodes:
        alone = node.value < count if node.op == "input" else all(decided[a] for a in node.arguments)  # pyright: ignore[reportOptionalOperand]
        decided.append(alone)
        if not alone:
            used.update(node.arguments)
    # The results of a loop are its `part` nodes, not the loop itself.
    return [i for i in sorted(used) if decided[i] and graph.nodes[i].op not in ("constant", "loop")]


def _hoist_invariants(lowered: Lowered) -> Lowered:
    """The same function, in which values that no turn of a loop changes are computed before the loop."""
    if not any(node.op == "loop" for node in lowered.graph.nodes):
        return lowered
    graph = Graph()
    outputs = _copy_nodes(lowered.graph, lowered.outputs, graph, {k: graph.input(k) for k in range(lowered.inputs)}, {})
    return _prune_graph(lowered, graph, outputs, lowered.inputs)


def _copy_nodes(
    graph: Graph, nodes: Sequence[int], into: Graph, inputs: Mapping[int, int], known: Mapping[int, int]
) -> list[int]:
    """Copies of nodes in another graph, with nodes there for inputs and known nodes; loops are hoisted."""
    place = dict(known)
    for i in _required_nodes(graph, nodes, place):
        op, arguments, value = graph.nodes[i]
        if op == "input":
            place[i] = inputs[value]  # pyright: ignore[reportArgumentType]
        elif op == "constant":
            place[i] = into.constant(value)  # pyright: ignore[reportArgumentType]
        elif op == "loop":
            place[i] = _add_hoisted_loop(into, value.over(_hoist_invariants), [place[a] for a in arguments])
        elif op == "part":
            place[i] = part_of(into, place[arguments[0]], value)  # pyright: ignore[reportArgumentType]
        elif op == "table":
            place[i] = into.look_up(value, place[arguments[0]])  # pyright: ignore[reportArgumentType]
        else:
            place[i] = into.apply(op, *(place[a] for a in arguments))
    return [place[i] for i in nodes]


def _required_nodes(graph: Graph, nodes: Sequence[int], known: Mapping[int, int]) -> list[int]:
    """The nodes that others need, each after its arguments, without the known ones and those that only these need."""
    needed, stack = set(), list(nodes)
    while stack:
        i = stack.pop()
        if i not in needed and i not in known:
            needed.add(i)
            stack.extend(graph.nodes[i].arguments)
    return sorted(needed)


def _add_hoisted_loop(graph: Graph, loop: Repetition, arguments: Sequence[int]) -> int:
    """Add a loop whose turns receive the values that its fixed numbers determine as further fixed numbers."""
    fixed = dict(enumerate(arguments[: loop.fixed]))
    taken = [
        [i for i in _invariant_nodes(g.graph, loop.fixed, g.outputs) if g.graph.nodes[i].op != "input"]
        for g in loop.graphs
    ]
    outside = [_copy_nodes(each.graph, some, graph, fixed, {}) for each, some in zip(loop.graphs, taken, strict=True)]
    # A truth value enters the loop as the number 0 or 1, because all numbers of a loop are one array.
    one, zero = graph.constant(1.0), graph.constant(0.0)
    passed = [
        [graph.apply("select", o, one, zero) if kinds[i] else o for i, o in zip(some, nodes, strict=True)]
        for some, nodes, kinds in zip(taken, outside, (truths(each.graph) for each in loop.graphs), strict=True)
    ]
    order = {node: k for k, node in enumerate(dict.fromkeys(itertools.chain(fixed.values(), *passed)))}
    carried = [*arguments[loop.fixed :]]

    def turn(each: Lowered, some: Sequence[int], nodes: Sequence[int]) -> Lowered:
        inner = Graph()
        values = [inner.input(k) for k in range(len(order) + len(carried))]
        inputs = {p: values[order[node]] for p, node in fixed.items()}
        inputs |= dict(enumerate(values[len(order) :], start=loop.fixed))
        known = dict(zip(some, _as_kinds(each.graph, some, inner, [values[order[n]] for n in nodes]), strict=True))
        return _prune_graph(each, inner, _copy_nodes(each.graph, each.outputs, inner, inputs, known), len(values))

    graphs = [turn(*each) for each in zip(loop.graphs, taken, passed, strict=True)]
    hoisted = loop._replace(body=graphs[0], going=graphs[1] if loop.going is not None else None, fixed=len(order))
    return add_loop(graph, hoisted, [*order, *carried])


def _as_kinds(graph: Graph, nodes: Sequence[int], into: Graph, values: Sequence[int]) -> list[int]:
    """Numbers of a graph in place of nodes of another one, as truth values if those nodes are truth values."""
    kinds = truths(graph)
    return [into.apply("lt", into.constant(0.0), v) if kinds[i] else v for i, v in zip(nodes, values, strict=False)]


def _prune_graph(lowered: Lowered, graph: Graph, outputs: Sequence[int], inputs: int) -> Lowered:
    """A function with another graph, of one array of inputs."""
    small, places = graph.pruned(outputs)
    return Lowered(small, ((inputs,),), tuple(places), lowered.results, lowered.tree)
