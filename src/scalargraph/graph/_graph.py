"""Defines graphs of scalar operations: constants are folded, zero products removed, equal sub-expressions shared.

Folding loses information: `0 · √q` is 0, even where √q is undefined. Therefore a graph of a function of real numbers
notes, before it simplifies an operation, the conditions under which the operation is defined and does not jump.
"""

import contextlib
import gc
import math
import struct
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from scalargraph.graph import _stumpff
from scalargraph.graph._simplify import SIMPLER, simpler_real

Kind = Literal["true", "decided", "whole", "finite"]
LARGEST = 1e150
"""Numbers below this are finite in doubles, and so are their products."""


class Condition(NamedTuple):
    """A condition under which a function is defined and does not jump.

    Attributes:
        kind: What the condition says about the node.
            "true": the node, a statement, holds.
            "true": the node, a statement, holds.
            "decided": the node, a statement, has the same value throughout a neighbourhood of the point, so that a
            choice by it does not jump.
            "whole": the node, a number, neither equals nor crosses an integer.
            "finite": the node, a number, stays below `LARGEST`. It was an argument that a simplification dropped, as in
            0·a, which is NaN in doubles if a overflows.
        node: Index of the node in the graph.
        because: Name of the operation that needs it, and the line of the user's code that asked for the operation.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> root = scalargraph.lower(lambda x: jnp.sqrt(x), jnp.array(1.0), real=True)
        >>> [condition.kind for condition in root.conditions.conditions]  # 0 < x
        ['true']
    """

    kind: Kind
    node: int
    because: str


class Table:
    """Array of numbers that is looked up by index; tables of the same numbers are equal and have the same hash.

    Args:
        numbers: The entries (N,).
    """

    def __init__(self, numbers: np.ndarray):
        self.numbers = np.ascontiguousarray(numbers, float)
        self._bits = self.numbers.tobytes()
        self._hash = hash(self._bits)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Table) and self._bits == other._bits

    def at(self, place: np.ndarray | float) -> np.ndarray:
        """Return the number at an index."""
        with np.errstate(all="ignore"):
            # NaN becomes 0, and infinities the nearest end, so that the index is always valid, as in the C of a table.
            index = np.clip(np.nan_to_num(np.rint(place)), 0, len(self.numbers) - 1)
        return self.numbers[index.astype(int)]


class Node(NamedTuple):
    """An operation of a graph, applied to earlier nodes.

    Attributes:
        op: Name of the operation, a key of `FOLD`, or "constant", "input", "loop", "part" or "table".
        arguments: Indices of the nodes that it is applied to.
        value: Number of a "constant", position of an "input", number of a "part", or the object of a "loop" or "table".

    Example:
        >>> import scalargraph
        >>> graph = scalargraph.Graph()
        >>> node = graph.nodes[graph.apply("sin", graph.input(0))]
        >>> node.op, node.arguments
        ('sin', (0,))
    """

    op: str
    arguments: tuple[int, ...]
    value: Any = None


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
    "either": lambda a, b, x, y: np.where(np.less(a, b), x, y),
    "stumpff": _stumpff.values,
}
"""Every operation of a graph, on numbers. `select(p, a, b)` is a where p holds, else b; comparisons give truth values.

`either(a, b, x, y)` is x where a < b and y where b < a: the derivative of a function with a kink at a = b. Interval
arithmetic takes the hull of x and y if a = b is possible. `stumpff(k, x)` is Stumpff's function c_k.
"""

COMMUTATIVE = {"add", "mul", "min", "max", "eq", "and", "or"}
"""Operations whose arguments are sorted, so that a + b and b + a are one node; IEEE arithmetic gives both one value."""


TRUTHS = {"lt", "le", "eq", "and", "or", "not", "is_finite"}
"""Operations whose result is a truth value."""
ANYTHING = {*TRUTHS, "select", "min", "max"}
"""Operations that accept infinite arguments."""
CANCELS = {"add", "sub", "mul", "div", "eq", "is_finite"}
"""Operations whose simplification may drop arguments, provided that these are finite."""
CHOICES = {"select", "min", "max", "either"}
"""Operations that may return an infinite argument."""


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Context manager and decorator that switches off Python's cyclic garbage collector.

    Nodes form no reference cycles, and a search of many thousand new nodes for cycles takes a third of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class Mark(NamedTuple):
    """Sizes of a graph's lists and tables, for `Graph.rollback`."""

    nodes: int
    tables: tuple[int, ...]


class Graph:
    """Nodes in an order in which each follows its arguments; they are added by `constant`, `input` and `apply`.

    Args:
        real: Whether all inputs are real numbers and none is missing (NaN), so that a number equals itself and is
            finite. Only then does the graph note `conditions`.

    Attributes:
        nodes: The nodes; methods return and take their indices in this list.
        conditions: The conditions noted so far, by kind and node.
        line: Function without arguments that returns the line of the user's code that asked for the next operation.

    Example:
        >>> import scalargraph
        >>> graph = scalargraph.Graph()
        >>> x = graph.input(0)
        >>> graph.apply("add", x, graph.constant(0.0)) == x  # simplified
        True
        >>> graph.apply("mul", x, x) == graph.apply("mul", x, x)  # shared
        True
    """

    def __init__(self, real: bool = False) -> None:
        self.nodes: list[Node] = []
        self.real = real
        self.conditions: dict[tuple[Kind, int], Condition] = {}
        self.line: Callable[[], str] = str
        # All of these keep the order of insertion, so that `rollback` can remove the latest entries from the end.
        self._infinite: dict[int, None] = {}  # nodes that may be infinite or NaN, such as a choice of such a value
        self._known: dict[tuple, int] = {}  # the node of each operation on arguments
        self._results: dict[tuple, int] = {}  # results of `apply`, by its arguments

    @classmethod
    def of(cls, nodes: Sequence[Node]) -> "Graph":
        """Create a graph of existing nodes, to which more can be added.

        Args:
            nodes: The nodes, each after its arguments. Their indices stay the same.
        """
        graph = cls()
        for node in nodes:
            if node.op == "constant":
                graph.constant(node.value)  # pyright: ignore[reportArgumentType]
            else:
                extra = (node.value,) if node.op == "table" or not node.arguments else ()
                graph._add((node.op, *extra, *node.arguments), *node)
        return graph

    def constant(self, value: float | bool | int) -> int:
        """Return the node of a number or truth value.

        Args:
            value: The value; an `int` is stored as `float`. 0.0 and −0.0 are two nodes, as their bits differ.
        """
        kind = bool if isinstance(value, (bool, np.bool_)) else float
        value = kind(value)
        # Zero has two signs, and NaN does not equal itself, so these values are distinguished by their bits.
        by_bits = kind is float and (value == 0 or value != value)
        return self._add(("constant", kind, struct.pack("d", value) if by_bits else value), "constant", (), value)

    def input(self, position: int) -> int:
        """Return the node of an input of the function.

        Args:
            position: Number of the input, from 0 on, in the order of the entries of the arguments.
        """
        return self._add(("input", position), "input", (), position)

    def block(self, op: str, key: Hashable, arguments: tuple[int, ...], value: object) -> int:
        """Return the node of an operation that is not in `FOLD`, such as a loop.

        Args:
            op: Name of the operation.
            key: Hashable description; equal keys on equal arguments share one node.
            arguments: Indices of the nodes that it is applied to.
            value: Object stored in the node.
        """
        return self._add((op, key, *arguments), op, arguments, value)

    def look_up(self, table: Table, place: int) -> int:
        """Return the node of an entry of a table; a known index gives a constant.

        A table is for generated code and not for proofs, since its values jump from entry to entry.

        Args:
            table: The numbers.
            place: Node of the index, rounded and clipped as by `Table.at`.
        """
        if self.nodes[place].op == "constant":
            return self.constant(table.at(self.nodes[place].value).item())
        return self.block("table", table, (place,), table)

    def find(self, op: str, *arguments: int) -> int | None:
        """Return the node of an operation if the graph already contains it, else None.

        Args:
            op: Name of the operation.
            arguments: Nodes of its arguments, in exactly this order.
        """
        return self._known.get((op, *arguments))

    def apply(self, op: str, *arguments: int) -> int:
        """Return the node of an operation on nodes, adding it to the graph where needed.

        Operations on constants are folded; others are simplified by rules for real numbers, and equal ones share a
        node. A graph with `real` first notes the conditions of the operation.

        Args:
            op: Name of the operation, a key of `FOLD`.
            arguments: Nodes of its arguments.
        """
        if self.real:  # conditions depend on nodes added before, so results of earlier calls are not reused
            return self._apply_noting(op, arguments)
        key = (op, *arguments)
        result = self._results.get(key)
        if result is None:
            result = self._results[key] = self._apply_simplifying(op, arguments)
        return result

    def _apply_noting(self, op: str, arguments: tuple[int, ...]) -> int:
        self._note(op, arguments, [self.nodes[a] for a in arguments])
        result = self._apply_simplifying(op, arguments)
        if op in CHOICES and any(self.may_be_infinite(a) for a in arguments):
            self._infinite[result] = None
        return result

    def _apply_simplifying(self, op: str, arguments: tuple[int, ...]) -> int:
        if op == "either":
            return self._either(*arguments)
        nodes = [self.nodes[a] for a in arguments]
        values = [node.value if node.op == "constant" else None for node in nodes]
        if None not in values:
            with np.errstate(all="ignore"):
                return self.constant(np.asarray(FOLD[op](*values)).item())
        simpler = SIMPLER[op](self, arguments, values) if op in SIMPLER else None
        if simpler is None and self.real:
            simpler = simpler_real(self, op, arguments)
        if simpler is not None:
            if self.real and op in CANCELS:
                for a in {*arguments} - {simpler, *self.nodes[simpler].arguments}:
                    self._condition("finite", a, op)
            return simpler
        if self.real and op == "select":  # if it is not simplified to an operation without a jump
            self._condition("decided", arguments[0], op)
        if op in COMMUTATIVE:
            arguments = tuple(sorted(arguments))
        return self._add((op, *arguments), op, arguments)

    def _either(self, a: int, b: int, x: int, y: int) -> int:
        """The derivative at a kink. If a = b is possible, both sides are kept, even if a and b are known numbers."""
        first, second = self.nodes[a], self.nodes[b]
        if x == y:
            return x
        if first.op == second.op == "constant" and first.value != second.value:
            return x if first.value < second.value else y  # pyright: ignore[reportOptionalOperand, reportOperatorIssue]
        # Arguments are neither sorted nor folded, since the order of x and y says which of them belongs to a < b.
        return self._add(("either", a, b, x, y), "either", (a, b, x, y))

    def _note(self, op: str, arguments: tuple[int, ...], nodes: list[Node]) -> None:
        """Note those conditions of an operation that are not known to hold already."""
        for kind, node in _needs(self, op, arguments, nodes):
            self._condition(kind, node, op)
        if op not in ANYTHING:
            for a in arguments:
                if a in self._infinite:
                    self._condition("true", self._add(("is_finite", a), "is_finite", (a,)), op)

    def may_be_infinite(self, node: int) -> bool:
        """Whether the value of a node, a constant or a choice, may be infinite; only for graphs with `real`."""
        value = self.nodes[node].value if self.nodes[node].op == "constant" else 0.0
        return node in self._infinite or (value is not None and not math.isfinite(value))

    def need_between(self, low: float, node: int, high: float) -> None:
        """Note the condition low < node < high.

        Args:
            low: Lower bound, exclusive.
            node: Node of a number.
            high: Upper bound, exclusive.
        """
        for pair in ((self.constant(low), node), (node, self.constant(high))):
            self._condition("true", self.apply("lt", *pair), "whole number")

    def _condition(self, kind: Kind, node: int, op: str) -> None:
        target = self.nodes[node]
        # A constant neither crosses an integer nor jumps, and an input is bounded by its box.
        constant = target.op == "constant" and (kind != "true" or target.value)
        settled = constant or (kind == "finite" and target.op == "input")
        if not settled and (kind, node) not in self.conditions:
            self.conditions[kind, node] = Condition(kind, node, f"{op} {self.line()}".strip())

    def _add(self, key: tuple, op: str, arguments: tuple[int, ...], value: object = None) -> int:
        """Return the node with a key, adding it if there is none; only this method adds nodes to a graph."""
        place = self._known.get(key)
        if place is None:
            place = self._known[key] = len(self.nodes)
            self.nodes.append(Node(op, arguments, value))
        return place

    def _tables(self) -> tuple[dict, ...]:
        return self._known, self._results, self.conditions, self._infinite

    def mark(self) -> Mark:
        """Return the current size, to which `rollback` can shrink the graph."""
        return Mark(len(self.nodes), tuple(map(len, self._tables())))

    def rollback(self, mark: Mark) -> None:
        """Remove everything that was added since a mark.

        Args:
            mark: Result of `mark` of this graph. Nodes that were added after it must no longer be used.
        """
        del self.nodes[mark.nodes :]
        for table, size in zip(self._tables(), mark.tables, strict=True):
            while len(table) > size:
                table.popitem()

    def is_operation(self, op: str, node: int, first: int) -> bool:
        """Return whether a node is an operation on a first argument.

        Args:
            op: Name of the operation.
            node: The node.
            first: Node of the first argument.
        """
        return self.nodes[node].op == op and self.nodes[node].arguments[0] == first

    def is_zero(self, node: int) -> bool:
        """Whether a node is the constant 0, of either sign."""
        return self.nodes[node].op == "constant" and self.nodes[node].value == 0

    def pruned(self, outputs: Sequence[int]) -> tuple["Graph", list[int]]:
        """Return the subgraph that some nodes need.

        Args:
            outputs: Nodes to keep, with everything that they depend on.

        Returns:
            The smaller graph, without conditions, and the outputs as nodes of it.
        """
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


def _needs(graph: Graph, op: str, x: tuple[int, ...], nodes: list[Node]) -> Iterator[tuple[Kind, int]]:
    """Kinds and nodes of the conditions under which an operation and its first derivative are defined without a jump.

    A root or an inverse function counts as undefined at the end of its domain, where it has no derivative.
    """

    def number(value: float) -> int:
        return graph.constant(value)

    def less(a: int, b: int) -> tuple[Kind, int]:
        return "true", graph.apply("lt", a, b)

    def apart(a: int, b: int) -> tuple[Kind, int]:
        return "true", graph.apply("or", graph.apply("lt", a, b), graph.apply("lt", b, a))

    invalid = any(n.op == "constant" and _is_invalid(n.value, op in ANYTHING) for n in nodes)
    if invalid and op not in ("select", "either"):
        yield "true", graph.constant(False)
    match op:
        case "div":
            yield apart(x[1], number(0.0))
        # Strict inequalities: at the ends of their domains sqrt, asin, acos and acosh have no derivative.
        case "sqrt" | "log":
            yield less(number(0.0), x[0])
        case "log1p":
            yield less(number(-1.0), x[0])
        case "acosh":
            yield less(number(1.0), x[0])
        case "asin" | "acos" | "atanh":
            yield less(number(-1.0), x[0])
            yield less(x[0], number(1.0))
        case "cbrt" | "sign":
            # At 0, cbrt has no derivative and sign jumps; away from 0 both are smooth.
            yield "decided", graph.apply("lt", x[0], number(0.0))
        case "tan":
            yield apart(graph.apply("cos", x[0]), number(0.0))
        case "atan2":  # smooth away from its cut, the negative half-axis with the origin
            yield "true", graph.apply("or", graph.apply("lt", number(0.0), x[1]), apart(x[0], number(0.0))[1])
        case "pow":
            exponent = nodes[1].value if nodes[1].op == "constant" else None
            # With such an exponent the power is exp(y log x), which needs x > 0; whole powers are products.
            if exponent is None or not float(exponent).is_integer():
                yield less(number(0.0), x[0])
            elif exponent < 0:
                yield apart(x[0], number(0.0))
        case "floor" | "ceil":
            yield "whole", x[0]
        case "round":
            # Rounding to nearest jumps half-way between integers.
            yield "whole", graph.apply("add", x[0], number(0.5))


def _is_invalid(value: float | bool | int | None, infinite: bool) -> bool:
    """Whether a known value must not be an argument of an operation: NaN, or infinity if that is not allowed."""
    return value is not None and not (math.isfinite(value) or (infinite and not math.isnan(value)))
