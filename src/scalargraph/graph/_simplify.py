"""Simplifies operations of a graph: sums with zero, products with one, choices between equal numbers.

All rules hold for real numbers. If a rule drops an argument, a graph of a function of real numbers notes the condition
that the argument is finite.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np


class GraphLike(Protocol):
    """The methods of `scalargraph.Graph` that the rules use; the protocol avoids a circular import."""

    nodes: list[Any]

    def constant(self, value: float | bool | int) -> int: ...
    def apply(self, op: str, *arguments: int) -> int: ...
    def is_operation(self, op: str, node: int, first: int) -> bool: ...
    def may_be_infinite(self, node: int) -> bool: ...


Rule = Callable[[GraphLike, tuple[int, ...], list], int | None]
"""`(graph, arguments, values)`: the nodes, and for each of them its value if it is a constant, else None."""


def _simpler_sum(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    (a, b), (x, y) = arguments, values
    if y == 0.0:
        return a
    if x == 0.0:
        return b
    first, second = graph.nodes[a], graph.nodes[b]
    if first.op == "sub" and first.arguments[1] == b:  # (c − b) + b
        return first.arguments[0]
    if second.op == "sub" and second.arguments[1] == a:
        return second.arguments[0]
    return None


def _simpler_difference(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    (a, b), (x, y) = arguments, values
    if y == 0.0:
        return a
    if x == 0.0:
        return graph.apply("neg", b)
    # This is exact for finite numbers only: `Graph` notes the condition "finite" for each node that cancels here.
    if a == b:
        return graph.constant(0.0)
    if graph.is_operation("sub", b, a):  # a − (a − b)
        return graph.nodes[b].arguments[1]
    if graph.is_operation("sub", a, b):  # (b − c) − b
        return graph.apply("neg", graph.nodes[a].arguments[1])
    if graph.nodes[a].op == "add" and b in graph.nodes[a].arguments:
        one, other = graph.nodes[a].arguments
        return other if one == b else one
    return None


def _simpler_product(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    """A product with zero becomes zero, which is correct for real numbers and for finite floating-point numbers."""
    for other, value in zip(arguments, reversed(values), strict=True):
        if value == 0.0:
            return graph.constant(0.0)
        if value == 1.0:
            return other
        if value == -1.0:
            return graph.apply("neg", other)
    return None


def _simpler_quotient(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    if values[1] == 1.0:
        return arguments[0]
    return graph.constant(0.0) if values[0] == 0.0 else None


def _simpler_negative(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    inner = graph.nodes[arguments[0]]
    return inner.arguments[0] if inner.op == "neg" else None


def _simpler_choice(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    (_, a, b), (p, _, _) = arguments, values
    if isinstance(p, bool):
        return a if p else b
    return a if a == b else None


def _simpler_extreme(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
    return arguments[0] if arguments[0] == arguments[1] else None


def _simpler_statement(neutral: bool) -> Rule:
    """Rule of "and", whose neutral element is true, or of "or", whose neutral element is false."""

    def rule(graph: GraphLike, arguments: tuple[int, ...], values: list) -> int | None:
        for other, value in zip(arguments, reversed(values), strict=True):
            if isinstance(value, bool):
                return other if value is neutral else graph.constant(not neutral)
        return _simpler_extreme(graph, arguments, values)

    return rule


SIMPLER: dict[str, Rule] = {
    "add": _simpler_sum,
    "sub": _simpler_difference,
    "mul": _simpler_product,
    "div": _simpler_quotient,
    "neg": _simpler_negative,
    "select": _simpler_choice,
    "min": _simpler_extreme,
    "max": _simpler_extreme,
    "and": _simpler_statement(True),
    "or": _simpler_statement(False),
}
"""Rules that return the node of a simpler form, or None if there is none; at least one argument is not a constant."""


def simpler_real(graph: GraphLike, op: str, arguments: tuple[int, ...]) -> int | None:
    """Simplify by rules for real numbers only. A choice that is |x|, min or max is replaced, as it does not jump."""
    match op, arguments:
        case "is_finite", (a,) if not graph.may_be_infinite(a):
            return graph.constant(True)
        case "eq", (a, b) if a == b and not graph.may_be_infinite(a):
            return graph.constant(True)
        case "min" | "max", (a, b):  # one argument may be an infinite bound
            none = np.inf if op == "min" else -np.inf  # the neutral element
            for one, other in ((a, b), (b, a)):
                if graph.nodes[other].op == "constant" and graph.nodes[other].value == none:
                    return one
        case "eq", (a, b):
            for one, other in ((a, b), (b, a)):  # the comparison a = max(a, c), as in the derivative of max
                node = graph.nodes[other]
                if node.op in ("min", "max") and one in node.arguments:
                    rest = node.arguments[0] if node.arguments[1] == one else node.arguments[1]
                    return graph.apply("le", *((one, rest) if node.op == "min" else (rest, one)))
        case "not", (p,) if graph.nodes[p].op == "not":
            return graph.nodes[p].arguments[0]
        case "select", (p, a, b) if graph.nodes[p].op == "not":
            return graph.apply("select", graph.nodes[p].arguments[0], b, a)
        case "select", (p, a, b) if graph.nodes[p].op in ("lt", "le"):
            less, more = graph.nodes[p].arguments
            if (a, b) in ((less, more), (more, less)):
                return graph.apply("min" if a == less else "max", a, b)
            size = _absolute_argument(graph, less, more, a, b)
            return None if size is None else graph.apply("abs", size)
    return None


def _absolute_argument(graph: GraphLike, less: int, more: int, a: int, b: int) -> int | None:
    """Return x if `less < more ? a : b` is |x|, that is x < 0 ? −x : x, or 0 < x ? x : −x; else None."""
    zero = graph.constant(0.0)
    if more == zero and graph.is_operation("neg", a, b) and less == b:
        return b
    if less == zero and graph.is_operation("neg", b, a) and more == a:
        return a
    return None
