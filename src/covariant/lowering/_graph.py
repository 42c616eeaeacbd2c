"""A function of real numbers as a graph of scalar operations: constants folded, zeros pruned, equal parts shared."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np


class Node(NamedTuple):
    """An operation and the indices of its arguments; the value of a `constant`, the position of an `input`."""

    op: str
    arguments: tuple[int, ...]
    value: float | bool | int | None = None


FOLD: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,
    "min": np.minimum,
    "max": np.maximum,
    "pow": np.power,
    "sqrt": np.sqrt,
    "cbrt": np.cbrt,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "is_finite": np.isfinite,
    "select": np.where,
}
"""Every operation of a graph, on numbers. `select(p, a, b)` is a where p holds, else b; comparisons give truths."""

COMMUTATIVE = {"add", "mul", "min", "max", "eq", "and", "or"}
"""Their arguments are put in order, so that a + b and b + a are one node; IEEE arithmetic does not tell them apart."""


class Graph:
    """Nodes in an order in which each follows its arguments. Nodes are added by `constant`, `input` and `apply`."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[tuple, int] = {}

    @classmethod
    def of(cls, nodes: Sequence[Node]) -> "Graph":
        """A graph of these nodes, to which more can be added."""
        graph = cls()
        for node in nodes:
            if node.op == "constant":
                graph.constant(node.value)  # pyright: ignore[reportArgumentType]
            else:
                graph._add((node.op, *(node.arguments or (node.value,))), node)
        return graph

    def constant(self, value: float | bool | int) -> int:
        """The node of a number or truth value."""
        kind = bool if isinstance(value, bool | np.bool_) else float
        value = kind(value)
        # Zero has two signs and NaN equals nothing: told apart by their bits.
        key = ("constant", kind, value if kind is bool else np.float64(value).tobytes())
        return self._add(key, Node("constant", (), value))

    def input(self, position: int) -> int:
        """The node of an argument of the function."""
        return self._add(("input", position), Node("input", (), position))

    def apply(self, op: str, *arguments: int) -> int:
        """The node of an operation, folded where its arguments are constants, simplified as real numbers allow."""
        nodes = [self.nodes[a] for a in arguments]
        if all(node.op == "constant" for node in nodes):
            with np.errstate(all="ignore"):
                return self.constant(np.asarray(FOLD[op](*(node.value for node in nodes))).item())
        simpler = self._simplify(op, arguments, [n.value if n.op == "constant" else None for n in nodes])
        if simpler is not None:
            return simpler
        if op in COMMUTATIVE:
            arguments = tuple(sorted(arguments))
        return self._add((op, *arguments), Node(op, arguments))

    def _add(self, key: tuple, node: Node) -> int:
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(node)
        return self._known[key]

    def _is(self, op: str, node: int, first: int) -> bool:
        """Whether a node is that operation on that first argument."""
        return self.nodes[node].op == op and self.nodes[node].arguments[0] == first

    def _simplify(self, op: str, arguments: tuple[int, ...], values: list) -> int | None:
        """The node that an operation with some constant arguments comes down to, or None.

        A product with zero is zero: right for real numbers, and for floating-point ones that are finite.
        """
        match op, arguments, values:
            case ("add", (a, _), (_, 0.0)) | ("add", (_, a), (0.0, _)):
                return a
            case ("sub", (a, _), (_, 0.0)):
                return a
            case ("sub", (_, b), (0.0, _)):
                return self.apply("neg", b)
            case ("sub", (a, b), _) if a == b:
                return self.constant(0.0)
            case ("sub", (a, b), _) if self._is("sub", b, a):  # a − (a − b)
                return self.nodes[b].arguments[1]
            case ("sub", (a, b), _) if self._is("sub", a, b):  # (b − c) − b
                return self.apply("neg", self.nodes[a].arguments[1])
            case ("sub", (a, b), _) if self.nodes[a].op == "add" and b in self.nodes[a].arguments:
                one, other = self.nodes[a].arguments
                return other if one == b else one
            case ("add", (a, b), _) if self.nodes[a].op == "sub" and self.nodes[a].arguments[1] == b:
                return self.nodes[a].arguments[0]
            case ("add", (a, b), _) if self.nodes[b].op == "sub" and self.nodes[b].arguments[1] == a:
                return self.nodes[b].arguments[0]
            case ("mul", _, (_, 0.0) | (0.0, _)):
                return self.constant(0.0)
            case ("mul", (a, _), (_, 1.0)) | ("mul", (_, a), (1.0, _)) | ("div", (a, _), (_, 1.0)):
                return a
            case ("mul", (a, _), (_, -1.0)) | ("mul", (_, a), (-1.0, _)):
                return self.apply("neg", a)
            case ("div", _, (0.0, _)):
                return self.constant(0.0)
            case ("neg", (a,), _) if self.nodes[a].op == "neg":
                return self.nodes[a].arguments[0]
            case ("select", (_, a, b), (bool(p), _, _)):
                return a if p else b
            case ("select", (_, a, b), _) if a == b:
                return a
            case ("and", (a, _), (_, True)) | ("and", (_, a), (True, _)):
                return a
            case ("and", _, (_, False) | (False, _)):
                return self.constant(False)
            case ("or", (a, _), (_, False)) | ("or", (_, a), (False, _)):
                return a
            case ("or", _, (_, True) | (True, _)):
                return self.constant(True)
            case ("min" | "max" | "and" | "or", (a, b), _) if a == b:
                return a
        return None

    def pruned(self, outputs: Sequence[int]) -> tuple["Graph", list[int]]:
        """The graph of the nodes that the outputs need, and where the outputs are in it."""
        needed, stack = set(), list(outputs)
        while stack:
            index = stack.pop()
            if index not in needed:
                needed.add(index)
                stack.extend(self.nodes[index].arguments)
        place, small = {}, Graph()
        for index in sorted(needed):
            node = self.nodes[index]
            place[index] = len(small.nodes)
            small.nodes.append(node._replace(arguments=tuple(place[a] for a in node.arguments)))
        return small, [place[index] for index in outputs]
