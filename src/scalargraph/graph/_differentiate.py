"""Differentiates a graph and returns a graph: forward mode, one input at a time, with shared and folded nodes.

It does not use JAX's derivatives. A function is traced only once, and derivatives share the nodes of the function and
of each other.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp

from scalargraph.graph._graph import TRUTHS, Graph, no_collection
from scalargraph.graph._lowered import Lowered

Rule = Callable[[Graph, int, tuple[int, ...], tuple[int, ...]], int]
"""`(graph, node, its arguments, their derivatives) -> derivative`."""


@no_collection()
def expand(lowered: Lowered, inputs: Sequence[int], order: int) -> Lowered:
    """Return the function of the values and derivatives of a lowered function.

    At a kink the derivative is the set of all values between the one-sided derivatives (`either`); an evaluation in
    numbers gives one of the two. At a jump the derivative is wrong: `Lowered.conditions` exclude such places.

    Args:
        lowered: The function, with K scalar outputs.
        inputs: Positions of the F scalar inputs to differentiate by.
        order: 1 for first derivatives, or 2 for first and second derivatives.

    Returns:
        The function whose result is the tuple of the values (K,), the first derivatives (F, K) and, for order 2, the
        second derivatives (P, K), one row for each of the P pairs of inputs in `pairs(F)`.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda x: x[0] * x[0] * x[1], jnp.zeros(2))
        >>> values, slopes = scalargraph.numbers(scalargraph.expand(lowered, [0, 1], 1), np.array([3.0, 2.0]))
        >>> values.tolist(), slopes.tolist()
        ([18.0], [[12.0], [9.0]])
    """
    graph = Graph.of(lowered.graph.nodes)
    slopes = [Derivative(graph, {i: graph.constant(1.0)}) for i in inputs]
    values = list(lowered.outputs)
    first = [[slope(node) for node in values] for slope in slopes]
    parts = [values, *first]
    shapes = [(len(values),), (len(inputs), len(values))]
    if order == 2:
        chosen = pairs(len(inputs))
        parts += [[slopes[j](node) for node in first[i]] for i, j in chosen]
        shapes.append((len(chosen), len(values)))
    small, outputs = graph.pruned(list(itertools.chain(*parts)))
    results = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes)
    return Lowered(small, lowered.arguments, tuple(outputs), results, jax.tree.structure(results))


def pairs(count: int) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i ≤ j, of some inputs, in the order of the second derivatives.

    Args:
        count: Number of inputs.

    Example:
        >>> from scalargraph.graph import pairs
        >>> pairs(2)
        [(0, 0), (0, 1), (1, 1)]
    """
    return list(itertools.combinations_with_replacement(range(count), 2))


class Derivative:
    """Derivatives of the nodes of a graph along a direction; each is added to the graph once.

    Calling it with a node returns the node of its derivative.

    Args:
        graph: The graph.
        direction: For the position of each input that changes, the node of its rate of change.

    Example:
        >>> import scalargraph
        >>> from scalargraph.graph import Derivative
        >>> graph = scalargraph.Graph()
        >>> slope = Derivative(graph, {0: graph.constant(1.0)})
        >>> graph.nodes[slope(graph.apply("sin", graph.input(0)))].op
        'cos'
    """

    def __init__(self, graph: Graph, direction: Mapping[int, int]):
        self.graph = graph
        self._known = {graph.input(position): node for position, node in direction.items()}

    def __call__(self, node: int) -> int:
        """The derivative of a node."""
        known, stack = self._known, [node]
        while stack:
            current = stack[-1]
            op, arguments, _ = self.graph.nodes[current]
            # A stack replaces recursion, since chains of nodes are longer than Python's recursion limit.
            missing = [a for a in arguments if a not in known]
            if current in known:
                stack.pop()
            elif missing:
                stack.extend(missing)
            else:
                stack.pop()
                changes = tuple(known[a] for a in arguments)
                still = all(self.graph.is_zero(c) for c in changes)  # a constant, or an input that does not change
                known[current] = (
                    self.graph.constant(0.0) if still else RULES[op](self.graph, current, arguments, changes)
                )
        return known[node]


def _chain(slope: Callable[[Graph, int, int], int]) -> Rule:
    """Rule of a function of one argument with derivative `slope(graph, node, argument)`."""
    return lambda graph, node, arguments, changes: graph.apply("mul", slope(graph, node, arguments[0]), changes[0])


def _over(divisor: Callable[[Graph, int, int], int]) -> Rule:
    """Rule of a function of one argument with derivative `1 / divisor(graph, node, argument)`."""
    return lambda graph, node, arguments, changes: graph.apply("div", changes[0], divisor(graph, node, arguments[0]))


def _square(graph: Graph, node: int) -> int:
    return graph.apply("mul", node, node)


def _plus(graph: Graph, number: float, node: int) -> int:
    return graph.apply("add", graph.constant(number), node)


def _minus(graph: Graph, number: float, node: int) -> int:
    return graph.apply("sub", graph.constant(number), node)


def _product(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (a, b), (da, db) = arguments, changes
    # (a²)′ = 2aa′: one product in place of two.
    if a == b:
        return graph.apply("mul", graph.constant(2.0), graph.apply("mul", a, da))
    return graph.apply("add", graph.apply("mul", da, b), graph.apply("mul", a, db))


def _quotient(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (_, b), (da, db) = arguments, changes
    # (a/b)′ = (a′ − (a/b) b′)/b uses the existing node of the quotient and needs no b².
    return graph.apply("div", graph.apply("sub", da, graph.apply("mul", node, db)), b)


def _power(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (a, b), (da, db) = arguments, changes
    lowered = graph.apply("pow", a, graph.apply("sub", b, graph.constant(1.0)))
    base = graph.apply("mul", graph.apply("mul", b, lowered), da)
    exponent = graph.apply("mul", graph.apply("mul", node, graph.apply("log", a)), db)
    return base if graph.is_zero(db) else graph.apply("add", base, exponent)  # if b is constant, log a may not exist


def _arctangent(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    (y, x), (dy, dx) = arguments, changes
    turn = graph.apply("sub", graph.apply("mul", x, dy), graph.apply("mul", y, dx))
    return graph.apply("div", turn, graph.apply("add", _square(graph, x), _square(graph, y)))


def _minimum_or_maximum(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    # Where a < b, min has the derivative of a, and max the derivative of b.
    which = changes if graph.nodes[node].op == "min" else changes[::-1]
    return graph.apply("either", *arguments, *which)


def _absolute(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    # |a| has the derivative −a′ for a < 0 and a′ for a > 0; at 0, interval bounds take the hull of both.
    return graph.apply("either", arguments[0], graph.constant(0.0), graph.apply("neg", changes[0]), changes[0])


def _stumpff(graph: Graph, node: int, arguments: tuple[int, ...], changes: tuple[int, ...]) -> int:
    """The derivative c_k' = (k c_{k+2} − c_{k+1})/2."""
    k, x = arguments
    order = float(graph.nodes[k].value or 0)
    one, two = (graph.apply("stumpff", graph.constant(order + i), x) for i in (1, 2))
    slope = graph.apply("sub", graph.apply("mul", k, two), one)
    return graph.apply("mul", graph.apply("mul", graph.constant(0.5), slope), changes[1])


def _root(graph: Graph, inside: int) -> int:
    return graph.apply("sqrt", inside)


RULES: dict[str, Rule] = {
    "add": lambda g, node, x, d: g.apply("add", *d),
    "sub": lambda g, node, x, d: g.apply("sub", *d),
    "neg": lambda g, node, x, d: g.apply("neg", *d),
    "mul": _product,
    "div": _quotient,
    "pow": _power,
    "atan2": _arctangent,
    "min": _minimum_or_maximum,
    "max": _minimum_or_maximum,
    "select": lambda g, node, x, d: g.apply("select", x[0], d[1], d[2]),
    "either": lambda g, node, x, d: g.apply("either", x[0], x[1], d[2], d[3]),
    "abs": _absolute,
    "stumpff": _stumpff,
    "sqrt": _over(lambda g, f, x: g.apply("mul", g.constant(2.0), f)),
    "cbrt": _over(lambda g, f, x: g.apply("mul", g.constant(3.0), _square(g, f))),
    "exp": _chain(lambda g, f, x: f),
    "expm1": _chain(lambda g, f, x: g.apply("exp", x)),
    "log": _over(lambda g, f, x: x),
    "log1p": _over(lambda g, f, x: _plus(g, 1.0, x)),
    "sin": _chain(lambda g, f, x: g.apply("cos", x)),
    "cos": _chain(lambda g, f, x: g.apply("neg", g.apply("sin", x))),
    # tan′ = 1 + tan²; tanh, sqrt, cbrt and exp likewise express the derivative by their value, which is a node already.
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
    # These are constant between their jumps, which the conditions of a proof exclude.
    **{op: lambda g, node, x, d: g.constant(0.0) for op in ("sign", "floor", "ceil", "round")},
    # A truth value is constant except where it switches, so its derivative is zero.
    **{op: lambda g, node, x, d: g.constant(0.0) for op in TRUTHS},
}
"""The derivative of each operation."""
