"""Simplifies a graph before code is generated from it: fewer operations, with the same meaning.

`simplified` moves changes of sign outward, where pairs of them cancel, uses the symmetry of sine and cosine, and
replaces several quotients with the same divisor by products with its reciprocal. All rules but the last are exact in
floating-point arithmetic, except for the sign of a zero; the last one rounds a quotient twice. They are applied to
graphs for generated code, not to graphs for proofs, which keep the operations as written.
"""

from collections import Counter
from collections.abc import Callable

from scalargraph.graph import Graph, Lowered, Node, add_loop, part_of

ODD = {"sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "cbrt", "sign"}
EVEN = {"cos", "cosh", "abs"}
FEWEST_QUOTIENTS = 2
"""Smallest number of quotients with one divisor for which the reciprocal is computed."""


def simplified(lowered: Lowered) -> Lowered:
    """Return the same function with fewer operations, within its loops too; its conditions are dropped.

    Args:
        lowered: The function.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> from scalargraph.c import simplified
        >>> lowered = scalargraph.lower(lambda x: jnp.cos(-x), jnp.array(0.0))
        >>> [node.op for node in simplified(lowered).graph.nodes]
        ['input', 'cos']
    """
    outward = _rewrite(lowered, lambda graph, node, x: _outward(graph, node.op, x))
    nodes = outward.graph.nodes
    divisors = Counter(node.arguments[1] for node in nodes if node.op == "div")
    # A division by a constant stays as it is: a/b has one rounding, a · (1/b) has two.
    shared = {a for a, count in divisors.items() if count >= FEWEST_QUOTIENTS and nodes[a].op != "constant"}

    def divide_once(graph: Graph, node: Node, x: tuple[int, ...]) -> int:
        if node.op == "div" and node.arguments[1] in shared:
            return graph.apply("mul", x[0], graph.apply("div", graph.constant(1.0), x[1]))
        return graph.apply(node.op, *x)

    return _rewrite(outward, divide_once)


def _rewrite(lowered: Lowered, rule: Callable[[Graph, Node, tuple[int, ...]], int]) -> Lowered:
    """The function with each operation added anew by a rule, from the old node and its arguments in the new graph."""
    graph, place = Graph(), []
    for node in lowered.graph.nodes:
        if node.op == "input":
            place.append(graph.input(node.value))
        elif node.op == "constant":
            place.append(graph.constant(node.value))
        elif node.op == "loop":
            place.append(add_loop(graph, node.value.over(simplified), [place[a] for a in node.arguments]))
        elif node.op == "part":
            place.append(part_of(graph, place[node.arguments[0]], node.value))
        elif node.op == "table":
            place.append(graph.look_up(node.value, place[node.arguments[0]]))
        else:
            place.append(rule(graph, node, tuple(place[a] for a in node.arguments)))
    small, outputs = graph.pruned([place[i] for i in lowered.outputs])
    return lowered._replace(graph=small, outputs=tuple(outputs), conditions=None)


def _outward(graph: Graph, op: str, x: tuple[int, ...]) -> int:
    """An operation with the changes of sign of its arguments moved to its result, or dropped where they cancel."""
    positive = tuple(_opposite(graph, a) for a in x)

    def neg(node: int) -> int:
        return _outward(graph, "neg", (node,))

    match op, x, positive:
        # −(a − b) = b − a exactly, up to the sign of a zero.
        case "neg", (a,), _ if graph.nodes[a].op == "sub":
            return graph.apply("sub", *graph.nodes[a].arguments[::-1])
        case _, _, (int(a),) if op in ODD:
            return neg(_outward(graph, op, (a,)))
        case _, _, (int(a),) if op in EVEN:
            return _outward(graph, op, (a,))
        case _, (a,), _ if op in ODD | EVEN and (swapped := _find_mirror(graph, a)) is not None:
            # If the graph has a − b already, b − a is written as its negative, so that one sine serves both.
            return neg(graph.apply(op, swapped)) if op in ODD else graph.apply(op, swapped)
        case "mul" | "div", _, (int(a), int(b)):
            return graph.apply(op, a, b)
        case "mul" | "div", (_, b), (int(a), None):
            return neg(graph.apply(op, a, b))
        case "mul" | "div", (a, _), (None, int(b)):
            return neg(graph.apply(op, a, b))
        case "add", _, (int(a), int(b)):
            return neg(graph.apply("add", a, b))
        case "add", (_, b), (int(a), None):
            return _outward(graph, "sub", (b, a))
        case "add", (a, _), (None, int(b)):
            return _outward(graph, "sub", (a, b))
        case "sub", _, (int(a), int(b)):
            return graph.apply("sub", b, a)
        case "sub", (_, b), (int(a), None):
            return neg(graph.apply("add", a, b))
        case "sub", (a, _), (None, int(b)):
            return graph.apply("add", a, b)
        case "min" | "max", _, (int(a), int(b)):
            # min(−a, −b) = −max(a, b).
            return neg(graph.apply("max" if op == "min" else "min", a, b))
        # −a < −b is b < a.
        case "lt" | "le", _, (int(a), int(b)):
            return graph.apply(op, b, a)
        case "select", (p, _, _), (_, int(a), int(b)):
            return neg(graph.apply("select", p, a, b))
        case "atan2", (_, b), (int(a), _):
            return neg(graph.apply("atan2", a, b))
    return graph.apply(op, *x)


def _opposite(graph: Graph, node: int) -> int | None:
    """The node of which this node is the negative; None if this node is not a negative."""
    return graph.nodes[node].arguments[0] if graph.nodes[node].op == "neg" else None


def _find_mirror(graph: Graph, node: int) -> int | None:
    """The earlier node b − a for a node a − b; None if the graph has none."""
    op, arguments, _ = graph.nodes[node]
    mirror = graph.find("sub", *arguments[::-1]) if op == "sub" else None
    return mirror if mirror is not None and mirror < node else None
