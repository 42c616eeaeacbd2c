"""Evaluates a graph in Taylor models: on a box, each number is a quadratic polynomial with a bounded remainder.

The terms of a matrix entry partly cancel. Bounds of its derivatives, computed operation by operation, miss this;
polynomials do not, as their terms cancel in the same way, and only a remainder of third order is left. For ten
variables this takes about as long as bounds of all second derivatives, and decides boxes that are many times as wide.

The variables of a box are written `c + h ε`, |ε| ≤ 1. All roundings of a step go into its remainder.
Source: Makino & Berz 2003, Taylor models and other validated functional inclusion methods, International Journal of
Pure and Applied Mathematics 4(4).
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scalargraph import Graph, Interval, Lowered
from scalargraph.graph import Derivative, Node, pairs
from scalargraph.intervals import INTERVALS, Truth
from scalargraph.proofs._definite import ROUND, TINY, sum_over
from scalargraph.proofs._tree import middle_of

Support = tuple[int, ...]
"""The variables that a number depends on, in ascending order."""


class TaylorModel:
    """A number on each of B boxes as a Taylor model: within `rest` of `at + Σ line ε + Σ bend εε`, |ε| ≤ 1.

    Attributes:
        on: The s variables that it depends on, in ascending order.
        at: Constant terms (B,). An array whose last axis is 1 holds for all boxes.
        line: Linear terms (s, B).
        bend: Quadratic terms (p, B), for the pairs `pairs(s)`.
        rest: Remainders (B,), which bound all roundings too.
        shares: How much of `rest` each variable causes (s, B). Proofs do not use them; they guide the search.
        sloped: Sum (B,) of absolute values of `line`.
        bent: Sum (B,) of absolute values of `bend`.
        away: The largest distance (B,) from `at`.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs._models import TaylorModel
        >>> zero = np.zeros((1, 1))
        >>> x = TaylorModel((0,), np.array([1.0]), np.array([[0.5]]), zero, np.zeros(1), zero)  # 1 + ε/2
        >>> y = x * x + -x  # ε/2 + ε²/4
        >>> y.at.tolist(), y.line.tolist(), y.bend.tolist(), bool(y.rest[0] < 1e-10)
        ([0.0], [[0.5]], [[0.25]], True)
    """

    __slots__ = ("at", "away", "bend", "bent", "line", "on", "rest", "shares", "sloped")

    def __init__(
        self, on: Support, at: np.ndarray, line: np.ndarray, bend: np.ndarray, rest: np.ndarray, shares: np.ndarray
    ):
        # TINY covers underflow in the operation that made this number, for which relative bounds do not hold.
        self.on, self.at, self.line, self.bend, self.rest, self.shares = on, at, line, bend, rest + TINY, shares
        self.sloped, self.bent = np.abs(line).sum(0), np.abs(bend).sum(0)
        self.away = (self.sloped + self.bent + self.rest) * (1 + ROUND)

    @classmethod
    def number(cls, at: np.ndarray | float, rest: np.ndarray | float = 0.0) -> "TaylorModel":
        """A number about which only one thing is known: it is within `rest` of `at`."""
        at = np.atleast_1d(np.asarray(at, float))
        none = np.empty((0, 1))
        return cls((), at, none, none, np.broadcast_to(rest, at.shape), none)

    @classmethod
    def within(cls, found: Interval) -> "TaylorModel":
        """A number between two bounds."""
        low, high = (np.atleast_1d(np.asarray(end, float)) for end in found)
        at = middle_of(low, high)
        return cls.number(at, np.maximum(high - at, at - low) * (1 + ROUND) + TINY)

    @property
    def bounds(self) -> Interval:
        """An interval (B,) around `at` that contains the number, rounded outward."""
        # This step exceeds the rounding errors of the two sums below, so the interval is rounded outward.
        step = ROUND * (np.abs(self.at) + self.away) + TINY
        return Interval(self.at - self.away - step, self.at + self.away + step)

    @property
    def size(self) -> np.ndarray:
        """A bound (B,) of the magnitude of the polynomial, without its remainder."""
        return np.abs(self.at) + self.sloped + self.bent

    @property
    def dues(self) -> np.ndarray:
        """How much of the distance from `at` each variable causes (s, B); it guides the search."""
        return np.abs(self.line) + _each(self.bend, len(self.on)) + self.shares

    def over(self, on: Support) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`line`, `bend` and `shares` extended to more variables, with zeros for the new ones."""
        if on == self.on:
            return self.line, self.bend, self.shares
        places, paired = _places(self.on, on)
        blocks = (self.line, len(on), places), (self.bend, _count(on), paired), (self.shares, len(on), places)
        found = []
        for part, count, put in blocks:
            wide = np.zeros((count, part.shape[1]))
            wide[put] = part
            found.append(wide)
        return tuple(found)

    def times(self, k: np.ndarray) -> "TaylorModel":
        """The product with a known number; its roundings go into the remainder."""
        size = np.abs(k)
        rest = (size * (self.rest + ROUND * self.size)) * (1 + ROUND)
        return TaylorModel(self.on, self.at * k, self.line * k, self.bend * k, rest, self.shares * size)

    def __neg__(self) -> "TaylorModel":
        return TaylorModel(self.on, -self.at, -self.line, -self.bend, self.rest, self.shares)

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        on = _union(self.on, other.on)
        (line, bend, due), (more, turned, owed) = self.over(on), other.over(on)
        # The roundings of all sums of coefficients are bounded by ROUND times the sizes of both polynomials.
        rest = (self.rest + other.rest + ROUND * (self.size + other.size)) * (1 + ROUND)
        return TaylorModel(on, self.at + other.at, line + more, bend + turned, rest, due + owed)

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        on = _union(self.on, other.on)
        (line, bend, due), (slope, turn, owed) = self.over(on), other.over(on)
        # Quadratic coefficients; an entry of `bend` for i ≠ j stands for both orders of the pair.
        product = self.at * turn + other.at * bend
        if len(on):
            i, j = _pairs(len(on))
            apart = np.flatnonzero(i != j)
            product = product + line[i] * slope[j]
            product[apart] += line[j[apart]] * slope[i[apart]]
        # Terms of third and fourth order, and products with the remainders, are bounded and go into the remainder.
        one, two, all_ = self.size, other.size, other.sloped + other.bent
        cut = self.sloped * other.bent + self.bent * all_
        rest = cut + self.rest * (two + other.rest) + one * other.rest + ROUND * one * two
        shares = due * (two + other.rest) + owed * one + np.abs(line) * other.bent + np.abs(slope) * self.bent
        shares = shares + _each(bend, len(on)) * all_ + _each(turn, len(on)) * (self.sloped + self.bent)
        return TaylorModel(
            on, self.at * other.at, self.at * slope + other.at * line, product, rest * (1 + ROUND), shares
        )

    def where(self, chosen: np.ndarray, other: "TaylorModel") -> "TaylorModel":
        """This number on the chosen boxes, the other one elsewhere."""
        on = _union(self.on, other.on)
        (line, bend, due), (slope, turn, owed) = self.over(on), other.over(on)
        parts = (self.at, other.at), (line, slope), (bend, turn), (self.rest, other.rest), (due, owed)
        return TaylorModel(on, *(np.where(chosen, a, b) for a, b in parts))


def _count(on: Support) -> int:
    return len(on) * (len(on) + 1) // 2


@functools.cache
def _union(a: Support, b: Support) -> Support:
    return a if a == b else tuple(sorted({*a, *b}))


@functools.cache
def _pairs(count: int) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    i, j = np.array(pairs(count), int).reshape(-1, 2).T
    return i, j


def _each(bend: np.ndarray, count: int) -> np.ndarray:
    """How much each variable contributes to the sum of absolute values of `bend`."""
    return _incidence(count) @ np.abs(bend)


@functools.cache
def _incidence(count: int) -> Float[np.ndarray, "s p"]:
    i, j = _pairs(count)
    # Half of the term of a pair counts for each of its variables; the term of a square counts for its variable alone.
    return (np.arange(count)[:, None] == i) / 2 + (np.arange(count)[:, None] == j) / 2


@functools.cache
def _places(few: Support, many: Support) -> tuple[Int[np.ndarray, "s"], Int[np.ndarray, "p"]]:
    """Positions of variables, and of pairs of them, among more variables and their pairs."""
    at = [many.index(variable) for variable in few]
    number = {pair: k for k, pair in enumerate(pairs(len(many)))}
    return np.array(at, int), np.array([number[at[i], at[j]] for i, j in pairs(len(few))], int)


# Functions of one number, by Taylor's formula of second order around the middle; the third derivative is bounded.


@functools.cache
def _with_derivatives(op: str, constants: tuple[float, ...]) -> tuple[Graph, tuple[int, ...]]:
    """A function of one input and its first three derivatives; constants are its further arguments."""
    graph = Graph()
    x = graph.input(0)
    numbers = [graph.constant(number) for number in constants]
    first = [*numbers, x] if op in ("stumpff", "div") else [x, *numbers]
    derivatives, slope = [graph.apply(op, *first)], Derivative(graph, {0: graph.constant(1.0)})
    for _ in range(3):
        derivatives.append(slope(derivatives[-1]))
    small, outputs = graph.pruned(derivatives)
    return small, tuple(outputs)


def _enclose_outputs(graph: Graph, outputs: Sequence[int], x: Interval) -> list[Interval]:
    values: list[Any] = []
    for node in graph.nodes:
        if node.op == "input":
            values.append(x)
        elif node.op == "constant":
            values.append(INTERVALS["constant"](node.value))
        else:
            values.append(INTERVALS[node.op](*(values[a] for a in node.arguments)))
    return [Interval(*np.broadcast_arrays(*values[i], x.low)[:2]) for i in outputs]


def curve(op: str, x: TaylorModel, *given: float) -> TaylorModel:
    """A function of one number: `f(c) + f'(c) d + ½ f''(c) d² + ⅙ f'''(ξ) d³`, with d the distance from c.

    If the bounds of f over the range are narrower, or derivatives do not exist, the result is those bounds.
    """
    graph, outputs = _with_derivatives(op, given)
    whole = TaylorModel.within(_enclose_outputs(graph, outputs[:1], x.bounds)[0])
    if not x.on:
        return whole
    value, slope, bend = map(TaylorModel.within, _enclose_outputs(graph, outputs[:3], Interval(x.at, x.at)))
    third = TaylorModel.within(_enclose_outputs(graph, outputs[3:], x.bounds)[0])
    deviation = TaylorModel(x.on, np.zeros_like(x.at), x.line, x.bend, x.rest, x.shares)
    # Only the middle of the second derivative is halved. Its remainder `bend.rest` may be too large, not too small.
    result = value + deviation * slope + deviation * deviation * TaylorModel.number(bend.at / 2, bend.rest)
    # The remainder of third order, rounded up: ξ is anywhere in the range of x.
    most = (np.abs(third.at) + third.rest) * deviation.away**3 / 6 * (1 + ROUND)
    # The remainder is attributed to the variables in proportion to their contributions to |d|.
    part = x.dues / np.where(x.away > 0, x.away, 1.0)
    result = TaylorModel(x.on, result.at, result.line, result.bend, result.rest + most, result.shares + most * part)
    hull = TaylorModel(x.on, whole.at, 0 * x.line, 0 * x.bend, whole.rest, whole.rest * part)
    # The bounds over the range are used if they are narrower, or if the remainder is NaN.
    return result.where(result.rest <= whole.rest, hull)


def _divide_models(a: TaylorModel, b: TaylorModel) -> TaylorModel:
    # A quotient is a product with 1/b, a function of one number; it has no bound if b may be zero.
    return a * curve("div", b, 1.0)


def _size(a: TaylorModel) -> TaylorModel:
    ends = a.bounds
    hull = TaylorModel.within(INTERVALS["abs"](ends))
    return a.where(ends.low >= 0, (-a).where(ends.high <= 0, hull))


def _smaller(a: TaylorModel, b: TaylorModel) -> TaylorModel:
    gap = (a + -b).bounds
    hull = TaylorModel.within(INTERVALS["min"](a.bounds, b.bounds))
    # If the difference has one sign, the smaller number keeps its polynomial; otherwise the hull of both is used.
    return a.where(gap.high <= 0, b.where(gap.low >= 0, hull))


def _choose_model(which: Truth, a: TaylorModel, b: TaylorModel) -> TaylorModel:
    """a if a statement holds, b if it does not, and the hull of both if it is undecided."""
    hull = TaylorModel.within(INTERVALS["select"](which, a.bounds, b.bounds))
    return a.where(np.atleast_1d(which.must), b.where(np.atleast_1d(~which.may), hull))


def _kink_derivative(a: TaylorModel, b: TaylorModel, x: TaylorModel, y: TaylorModel) -> TaylorModel:
    """The derivative at a kink: x where a < b, y where b < a, and the hull of both if a = b is possible."""
    gap = (a + -b).bounds
    return _choose_model(Truth(gap.high < 0, ~(gap.low > 0)), x, y)


OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a + -b,
    "neg": lambda a: -a,
    "mul": lambda a, b: a * b,
    "div": _divide_models,
    "abs": _size,
    "min": _smaller,
    "max": lambda a, b: -_smaller(-a, -b),
    "select": _choose_model,
    "either": _kink_derivative,
    **{
        op: functools.partial(curve, op)
        for op in (
            *("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh"),
            *("tanh", "asinh", "acosh", "atanh"),
        )
    },
}
"""Operations with a rule for polynomials; for all others, the bounds of the arguments give bounds of the result."""


def _apply(node: Node, nodes: Sequence[Node], x: Sequence[Any]) -> Any:
    """The result of an operation on models and truth values."""
    numbers = [nodes[a].value if nodes[a].op == "constant" else None for a in node.arguments]
    if node.op in OPERATIONS and all(isinstance(a, TaylorModel) for a in x[node.op == "select" :]):
        return OPERATIONS[node.op](*x)
    if node.op == "pow" and numbers[1] is not None:
        return curve("pow", x[0], float(numbers[1]))
    if node.op == "stumpff":
        return curve("stumpff", x[1], float(numbers[0] or 0.0))
    result = INTERVALS[node.op](*(a.bounds if isinstance(a, TaylorModel) else a for a in x))
    return result if isinstance(result, Truth) else TaylorModel.within(result)


class Polynomials(NamedTuple):
    """Numbers on B boxes as polynomials: each is within `rest` of `centre + Σ wₘ terms[m]`, |wₘ| ≤ 1.

    Attributes:
        centre: Constant terms (K, B) of the K numbers.
        terms: A term for each of s symbols and, after these, one for each pair of them, `pairs(s)`: (s + p, K, B). The
            first symbols are the f free variables.
        rest: Remainders (K, B); NaN or infinite if nothing is known.
        owners: The variable (s,) to which each symbol belongs.
        shares: How much of `rest` each variable causes (f, K, B); it guides the search.
        blame: How much each variable widens the first numbers without a bound (f, B); it guides the search too.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from scalargraph import lower
        >>> from scalargraph.proofs._models import polynomials
        >>> square = lower(lambda z: z**2, jnp.zeros(1))
        >>> result = polynomials(square, np.array([[-1.0]]), np.array([[1.0]]), np.array([0]))
        >>> result.centre.round(6).tolist(), result.terms[:, 0, 0].round(6).tolist()  # ε² is ½ ± ½
        ([[0.5]], [0.0, 0.5])
    """

    centre: Float[np.ndarray, "K B"]
    terms: Float[np.ndarray, "m K B"]
    rest: Float[np.ndarray, "K B"]
    owners: Int[np.ndarray, "s"]
    shares: Float[np.ndarray, "f K B"]
    blame: Float[np.ndarray, "f B"]


def polynomials(
    lowered: Lowered, low: Float[np.ndarray, "B d"], high: Float[np.ndarray, "B d"], free: Int[np.ndarray, "f"]
) -> Polynomials:
    """The values of a graph on boxes, as polynomials in the free variables."""
    nodes, uses = lowered.graph.nodes, Counter(lowered.outputs)
    uses.update(a for node in lowered.graph.nodes for a in node.arguments)
    variable = {int(i): k for k, i in enumerate(free)}
    values: dict[int, Any] = {}
    owners, blame = list(range(len(free))), np.zeros((len(free), len(low)))
    with np.errstate(all="ignore"):
        for number, node in enumerate(nodes):
            if node.op == "input":
                i = int(node.value or 0)
                values[number] = _variable(low[:, i], high[:, i], variable.get(i))
            elif node.op == "constant":
                truth = isinstance(node.value, bool)
                values[number] = INTERVALS["constant"](node.value) if truth else TaylorModel.number(node.value)
            else:
                arguments = [values[a] for a in node.arguments]
                result = _apply(node, nodes, arguments)
                _blame(blame, owners, result, arguments)
                values[number] = _with_symbol(result, owners) if _steep(result) else result
            # Values that no later operation reads are freed, so that the others stay in the cache.
            for a in node.arguments:
                uses[a] -= 1
                if not uses[a]:
                    del values[a]
        return _gather_polynomials([values[i] for i in lowered.outputs], owners, blame)


def _blame(blame: np.ndarray, owners: Sequence[int], result: object, arguments: Sequence[object]) -> None:
    """Add how much each variable widens the last argument, on boxes where the result is the first without a bound."""
    if isinstance(result, TaylorModel) and not np.isfinite(result.rest).all():
        lost, last = ~np.isfinite(result.rest), arguments[-1]
        for x in arguments:
            lost = lost & (np.isfinite(x.rest) if isinstance(x, TaylorModel) else True)
        if isinstance(last, TaylorModel) and lost.any():
            for symbol, due in zip(last.on, last.dues / last.away, strict=True):
                blame[owners[symbol]] += np.where(lost, due, 0.0)


def _steep(model: object) -> bool:
    """Whether a number depends on one variable only, and its remainder exceeds its other terms on some box."""
    if not (isinstance(model, TaylorModel) and len(model.on) == 1):
        return False
    return bool((np.isfinite(model.rest) & (model.rest > model.sloped + model.bent)).any())


def _with_symbol(model: TaylorModel, owners: list[int]) -> TaylorModel:
    """A number of one variable with its remainder written as a further symbol, |η| ≤ 1, so that it can cancel too.

    All occurrences of a steep function, such as dry friction, in the matrix then share one symbol. The test of
    definiteness sees one slope between two values instead of many independent errors.
    """
    finite = np.isfinite(model.rest)
    owners.append(owners[model.on[0]])
    line = np.concatenate(np.broadcast_arrays(model.line, np.where(finite, model.rest, 0.0)[None]))
    on = (*model.on, len(owners) - 1)
    _, bend, shares = TaylorModel(model.on, model.at, model.line, model.bend, model.rest, model.shares).over(on)
    return TaylorModel(on, model.at, line, bend, np.where(finite, 0.0, model.rest), np.where(finite, 0.0, shares))


def _variable(low: np.ndarray, high: np.ndarray, number: int | None) -> TaylorModel:
    """A variable on boxes; `number` is None for a fixed variable."""
    centre = middle_of(low, high)
    # Rounded up, so that |ε| ≤ 1 covers the whole box although its middle is rounded.
    half = np.maximum(high - centre, centre - low) * (1 + ROUND)
    if number is None:
        return TaylorModel.number(centre, half)
    return TaylorModel((number,), centre, half[None], np.zeros((1, 1)), np.zeros(1), np.zeros((1, 1)))


def _gather_polynomials(models: Sequence[TaylorModel], owners: Sequence[int], blame: np.ndarray) -> Polynomials:
    s, (f, boxes), count = len(owners), blame.shape, len(models)
    square = np.array([i == j for i, j in pairs(s)], bool)
    centre, rest = np.empty((2, count, boxes))
    terms, shares = np.empty((s + len(square), count, boxes)), np.zeros((f, count, boxes))
    for k, value in enumerate(models):
        terms[:s, k], terms[s:, k], _ = value.over(tuple(range(s)))
        terms[s:, k][square] /= 2
        # The square of a symbol lies in [0, 1] = ½ ± ½.
        centre[k] = value.at + sum_over(terms[s:, k][square])
        rest[k] = (value.rest + ROUND * (np.abs(value.at) + value.bent)) * (1 + ROUND)
        for symbol, due in zip(value.on, value.shares, strict=True):
            shares[owners[symbol], k] += due
    return Polynomials(centre, terms, rest, np.array(owners, int), shares, blame)
