"""Derivatives of a graph, as a graph: forward, one input at a time, with the same folding and sharing.

A second route beside JAX's own derivatives, and a short one: a function is traced once, and its derivatives cost as
many nodes as they have, without tracing anything again.
"""

import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from covariant.lowering._graph import Graph
from covariant.lowering._trace import Lowered

Rule = Callable[[Graph, int, tuple[int, ...], tuple[int, ...]], int]
"""`(graph, node, its arguments, their derivatives) -> derivative`."""


def expand(lowered: Lowered, inputs: Sequence[int], order: int) -> Lowered:
    """The graph of the values (K,) of all outputs and of their derivatives in the given inputs (F,).

    `order` 1: values (K,) and first derivatives (F, K). `order` 2: also second derivatives (P, K), of the pairs
    `pairs(F)`. Where a function jumps or has a kink its derivative is that of one side.
    """
    graph = Graph.of(lowered.graph.nodes)
    derivative = Derivative(graph)
    values = list(lowered.outputs)
    first = [[derivative(node, i) for node in values] for i in inputs]
    parts = [values, *first]
    shapes = [(len(values),), (len(inputs), len(values))]
    if order == 2:
        chosen = pairs(len(inputs))
        parts += [[derivative(node, inputs[j]) for node in first[i]] for i, j in chosen]
        shapes.append((len(chosen), len(values)))
    small, outputs = graph.pruned(list(itertools.chain(*parts)))
    results = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes)
    return Lowered(small, lowered.arguments, tuple(outputs), results, jax.tree.structure(results))


def pairs(count: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i ≤ j, of that many inputs, in the order of the second derivatives."""
    return list(itertools.combinations_with_replacement(range(count), 2))


class Derivative:
    """Derivatives of the nodes of a graph, which grows by them; each is found once."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self._known: dict[int, dict[int, int]] = {}

    def __call__(self, node: int, position: int) -> int:
        """The derivative of a node in the input at a position."""
        known = self._known.setdefault(position, {})
        stack = [node]
        while stack:
            at = stack[-1]
            op, arguments, value = self.graph.nodes[at]
            missing = [a for a in arguments if a not in known]
            if at in known:
                stack.pop()
            elif missing:
                stack.extend(missing)
            else:
                stack.pop()
                changes = tuple(known[a] for a in arguments)
                if op in ("constant", "input"):
                    known[at] = self.graph.constant(1.0 if op == "input" and value == position else 0.0)
                elif all(self._zero(c) for c in changes):
                    known[at] = self.graph.constant(0.0)
                else:
                    known[at] = RULES[op](self.graph, at, arguments, changes)
        return known[node]

    def _zero(self, node: int) -> bool:
        return self.graph.nodes[node].op == "constant" and self.graph.nodes[node].value == 0.0


def _chain(slope: Callable[[Graph, int, int], int]) -> Rule:
    """A function of one argument with derivative `slope(graph, node, argument)`."""
    return lambda graph, node, arguments, changes: graph.apply("mul", slope(graph, node, arguments[0]), changes[0])


def _over(divisor: Callable[[Graph, int, int], int]) -> Rule:
    """A function of one argument with derivative `1 / divisor(graph, node, argument)`."""
    return lambda graph, node, arguments, changes: graph.apply("div", changes[0], divisor(graph, node, arguments[0]))


def _square(graph: Graph, node: int) -> int:
    return graph.apply("mul", node, node)


def _plus(graph: Graph, number: float, node: int) -> int:
    return graph.apply("add", graph.constant(number), node)


def _minus(graph: Graph, number: float, node: int) -> int:
    return graph.apply("sub", graph.constant(number), node)


def _product(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (a, b), (da, db) = arguments, changes
    if a == b:
        return graph.apply("mul", graph.constant(2.0), graph.apply("mul", a, da))
    return graph.apply("add", graph.apply("mul", da, b), graph.apply("mul", a, db))


def _quotient(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (_, b), (da, db) = arguments, changes
    return graph.apply("div", graph.apply("sub", da, graph.apply("mul", node, db)), b)


def _power(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (a, b), (da, db) = arguments, changes
    lowered = graph.apply("pow", a, graph.apply("sub", b, graph.constant(1.0)))
    base = graph.apply("mul", graph.apply("mul", b, lowered), da)
    exponent = graph.apply("mul", graph.apply("mul", node, graph.apply("log", a)), db)
    steady = graph.nodes[db].op == "constant" and graph.nodes[db].value == 0.0
    return base if steady else graph.apply("add", base, exponent)  # log a may not exist where b is constant


def _angle(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (y, x), (dy, dx) = arguments, changes
    turn = graph.apply("sub", graph.apply("mul", x, dy), graph.apply("mul", y, dx))
    return graph.apply("div", turn, graph.apply("add", _square(graph, x), _square(graph, y)))


def _extreme(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    smaller = graph.apply("lt", *arguments)
    which = changes if graph.nodes[node].op == "min" else changes[::-1]
    return graph.apply("select", smaller, *which)


def _root(graph: Graph, inside: int) -> int:
    return graph.apply("sqrt", inside)


RULES: dict[str, Rule] = {
    "add": lambda g, node, x, d: g.apply("add", *d),
    "sub": lambda g, node, x, d: g.apply("sub", *d),
    "neg": lambda g, node, x, d: g.apply("neg", *d),
    "mul": _product,
    "div": _quotient,
    "pow": _power,
    "atan2": _angle,
    "min": _extreme,
    "max": _extreme,
    "select": lambda g, node, x, d: g.apply("select", x[0], d[1], d[2]),
    "abs": _chain(lambda g, f, x: g.apply("sign", x)),
    "sqrt": _over(lambda g, f, x: g.apply("mul", g.constant(2.0), f)),
    "cbrt": _over(lambda g, f, x: g.apply("mul", g.constant(3.0), _square(g, f))),
    "exp": _chain(lambda g, f, x: f),
    "expm1": _chain(lambda g, f, x: g.apply("exp", x)),
    "log": _over(lambda g, f, x: x),
    "log1p": _over(lambda g, f, x: _plus(g, 1.0, x)),
    "sin": _chain(lambda g, f, x: g.apply("cos", x)),
    "cos": _chain(lambda g, f, x: g.apply("neg", g.apply("sin", x))),
    "tan": _chain(lambda g, f, x: _plus(g, 1.0, _square(g, f))),
    "asin": _over(lambda g, f, x: _root(g, _minus(g, 1.0, _square(g, x)))),
    "acos": _over(lambda g, f, x: g.apply("neg", _root(g, _minus(g, 1.0, _square(g, x))))),
    "atan": _over(lambda g, f, x: _plus(g, 1.0, _square(g, x))),
    "sinh": _chain(lambda g, f, x: g.apply("cosh", x)),
    "cosh": _chain(lambda g, f, x: g.apply("sinh", x)),
    "tanh": _chain(lambda g, f, x: _minus(g, 1.0, _square(g, f))),
    "asinh": _over(lambda g, f, x: _root(g, _plus(g, 1.0, _square(g, x)))),
    "acosh": _over(lambda g, f, x: _root(g, _plus(g, -1.0, _square(g, x)))),
    "atanh": _over(lambda g, f, x: _minus(g, 1.0, _square(g, x))),
    **{op: lambda g, node, x, d: g.constant(0.0) for op in ("sign", "floor", "ceil", "round")},
    # Truth values do not change by degrees.
    **{op: lambda g, node, x, d: g.constant(0.0) for op in ("lt", "le", "eq", "and", "or", "not", "is_finite")},
}
"""The derivative of each operation."""
