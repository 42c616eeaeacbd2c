"""Taylor models on boxes: each number of a graph as a polynomial of second order in the variables, with a remainder.

An entry of a matrix is computed from numbers that cancel in part. Bounds of its derivatives, one operation after the
other, do not see that; polynomials do, since their terms cancel as those of the entry do. What is left is of third
order. It takes about as long as bounds of all second derivatives, where there are ten variables, and the boxes that it
decides are many times as wide.

Variables of a box are `c + h ε`, |ε| ≤ 1. All roundings of a step go into its remainder.
Source: Makino & Berz 2003, Taylor models and other validated functional inclusion methods, International Journal of
Pure and Applied Mathematics 4(4).
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from covariant.lowering import INTERVALS, Derivative, Graph, Interval, Lowered, Node, Truth, pairs
from covariant.proofs._definite import ROUND, TINY, sum_over
from covariant.proofs._tree import middle_of

Support = tuple[int, ...]
"""The variables that a number depends on, in ascending order."""


class Model:
    """A number on each of B boxes: within `rest` of `at + Σ line ε + Σ bend εε`, |ε| ≤ 1.

    - `on`: the s variables that it depends on.
    - `at`, `rest` (B,); `line` (s, B); `bend` (p, B), for the pairs `pairs(s)`. Where B is 1 all boxes share it.

    The sums of absolute values are kept too: those of `line`, of `bend`, and the largest distance from `at`, `away`.
    """

    __slots__ = ("at", "away", "bend", "bent", "line", "on", "rest", "sloped")

    def __init__(self, on: Support, at: np.ndarray, line: np.ndarray, bend: np.ndarray, rest: np.ndarray):
        self.on, self.at, self.line, self.bend, self.rest = on, at, line, bend, rest + TINY
        self.sloped, self.bent = np.abs(line).sum(0), np.abs(bend).sum(0)
        self.away = (self.sloped + self.bent + self.rest) * (1 + ROUND)

    @classmethod
    def number(cls, at: Any, rest: Any = 0.0) -> "Model":
        """A number within `rest` of `at`, of which no more is known."""
        at = np.atleast_1d(np.asarray(at, float))
        return cls((), at, np.empty((0, 1)), np.empty((0, 1)), np.broadcast_to(rest, at.shape))

    @classmethod
    def within(cls, found: Interval) -> "Model":
        """A number between two bounds."""
        low, high = (np.atleast_1d(np.asarray(end, float)) for end in found)
        at = middle_of(low, high)
        return cls.number(at, np.maximum(high - at, at - low) * (1 + ROUND) + TINY)

    @property
    def bounds(self) -> Interval:
        """The least interval around `at` that holds the number, rounded outward."""
        step = ROUND * (np.abs(self.at) + self.away) + TINY
        return Interval(self.at - self.away - step, self.at + self.away + step)

    def over(self, on: Support) -> tuple[np.ndarray, np.ndarray]:
        """`line` and `bend` over more variables."""
        if on == self.on:
            return self.line, self.bend
        places, paired = _places(self.on, on)
        line, bend = (np.zeros((n, part.shape[1])) for n, part in ((len(on), self.line), (_count(on), self.bend)))
        line[places], bend[paired] = self.line, self.bend
        return line, bend

    def times(self, k: np.ndarray) -> "Model":
        """The number times one that is known, (B,) or (1,)."""
        size = np.abs(k)
        lost = ROUND * size * (np.abs(self.at) + self.sloped + self.bent)
        return Model(self.on, self.at * k, self.line * k, self.bend * k, (size * self.rest + lost) * (1 + ROUND))

    def __neg__(self) -> "Model":
        return Model(self.on, -self.at, -self.line, -self.bend, self.rest)

    def __add__(self, other: "Model") -> "Model":
        on = _union(self.on, other.on)
        (line, bend), (more, turned) = self.over(on), other.over(on)
        lost = ROUND * sum(np.abs(x.at) + x.sloped + x.bent for x in (self, other))
        rest = (self.rest + other.rest + lost) * (1 + ROUND)
        return Model(on, self.at + other.at, line + more, bend + turned, rest)

    def __mul__(self, other: "Model") -> "Model":
        for known, number in ((self, other), (other, self)):
            if not known.on and not known.rest.max() > 2 * TINY:
                return number.times(known.at)
        on = _union(self.on, other.on)
        (line, bend), (slope, turn) = self.over(on), other.over(on)
        product = self.at * turn + other.at * bend
        if len(on):
            i, j = _pairs(len(on))
            product = product + line[i] * slope[j]
            apart = i != j
            product[apart] += line[j[apart]] * slope[i[apart]]
        # What the polynomials make of third and fourth order, and what the remainders add.
        one, two = (np.abs(x.at) + x.sloped + x.bent for x in (self, other))
        cut = self.sloped * other.bent + self.bent * (other.sloped + other.bent)
        rest = cut + self.rest * (two + other.rest) + one * other.rest + ROUND * one * two
        return Model(on, self.at * other.at, self.at * slope + other.at * line, product, rest * (1 + ROUND))

    def where(self, chosen: np.ndarray, other: "Model") -> "Model":
        """The number on the chosen boxes (B,), another one on the others."""
        on = _union(self.on, other.on)
        parts = zip((self.at, *self.over(on), self.rest), (other.at, *other.over(on), other.rest), strict=True)
        return Model(on, *(np.where(chosen, a, b) for a, b in parts))


def _count(on: Support) -> int:
    return len(on) * (len(on) + 1) // 2


@functools.cache
def _union(a: Support, b: Support) -> Support:
    return a if a == b else tuple(sorted({*a, *b}))


@functools.cache
def _pairs(count: int) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    i, j = np.array(pairs(count), int).reshape(-1, 2).T
    return i, j


@functools.cache
def _places(few: Support, many: Support) -> tuple[Int[np.ndarray, "s"], Int[np.ndarray, "p"]]:
    """Where variables, and pairs of them, are among more variables, and pairs of those."""
    at = [many.index(variable) for variable in few]
    number = {pair: k for k, pair in enumerate(pairs(len(many)))}
    return np.array(at, int), np.array([number[at[i], at[j]] for i, j in pairs(len(few))], int)


# Functions of one number: Taylor's formula of second order around the middle, with the third derivative on its range.


@functools.cache
def _with_derivatives(op: str, given: tuple[float, ...]) -> tuple[Graph, tuple[int, ...]]:
    """A function of one input, after or before given numbers, and its first three derivatives."""
    graph = Graph()
    x = graph.input(0)
    numbers = [graph.constant(number) for number in given]
    first = [*numbers, x] if op in ("stumpff", "div") else [x, *numbers]
    found, slope = [graph.apply(op, *first)], Derivative(graph, {0: graph.constant(1.0)})
    for _ in range(3):
        found.append(slope(found[-1]))
    small, outputs = graph.pruned(found)
    return small, tuple(outputs)


def _enclosed(graph: Graph, outputs: Sequence[int], x: Interval) -> list[Interval]:
    values: list[Any] = []
    for node in graph.nodes:
        if node.op == "input":
            values.append(x)
        elif node.op == "constant":
            values.append(INTERVALS["constant"](node.value))
        else:
            values.append(INTERVALS[node.op](*(values[a] for a in node.arguments)))
    return [Interval(*np.broadcast_arrays(*values[i], x.low)[:2]) for i in outputs]


def curve(op: str, x: Model, *given: float) -> Model:
    """A function of one number: `f(c) + f'(c) d + ½ f''(c) d² + ⅙ f'''(ξ) d³`, with d the distance from c.

    Where that tells less than the bounds of f over the range, or derivatives do not exist, it is these bounds.
    """
    graph, outputs = _with_derivatives(op, given)
    whole = Model.within(_enclosed(graph, outputs[:1], x.bounds)[0])
    if not x.on:
        return whole
    value, slope, bend = (Model.within(found) for found in _enclosed(graph, outputs[:3], Interval(x.at, x.at)))
    third = Model.within(_enclosed(graph, outputs[3:], x.bounds)[0])
    left = Model(x.on, np.zeros_like(x.at), x.line, x.bend, x.rest)
    half = Model.number(bend.at / 2, bend.rest)
    found = value + slope * left + half * (left * left)
    most = (np.abs(third.at) + third.rest) * left.away**3 / 6 * (1 + ROUND)
    found = Model(found.on, found.at, found.line, found.bend, found.rest + most)
    return found.where(found.rest <= whole.rest, whole)


def _divided(a: Model, b: Model) -> Model:
    return a * curve("div", b, 1.0)


def _size(a: Model) -> Model:
    ends = a.bounds
    hull = Model.within(INTERVALS["abs"](ends))
    return a.where(ends.low >= 0, (-a).where(ends.high <= 0, hull))


def _smaller(a: Model, b: Model) -> Model:
    gap = (a + -b).bounds
    hull = Model.within(INTERVALS["min"](a.bounds, b.bounds))
    return a.where(gap.high <= 0, b.where(gap.low >= 0, hull))


def _chosen(which: Truth, a: Model, b: Model) -> Model:
    """a where a statement must hold, b where it cannot, and the hull of both where it is undecided."""
    hull = Model.within(INTERVALS["select"](which, a.bounds, b.bounds))
    return a.where(np.atleast_1d(which.must), b.where(np.atleast_1d(~which.may), hull))


def _kinked(a: Model, b: Model, x: Model, y: Model) -> Model:
    """The derivative at a kink: x where a < b, y where b < a, and the hull of both where they may be equal."""
    gap = (a + -b).bounds
    return _chosen(Truth(gap.high < 0, ~(gap.low > 0)), x, y)


OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a + -b,
    "neg": lambda a: -a,
    "mul": lambda a, b: a * b,
    "div": _divided,
    "abs": _size,
    "min": _smaller,
    "max": lambda a, b: -_smaller(-a, -b),
    "select": _chosen,
    "either": _kinked,
    **{
        op: functools.partial(curve, op)
        for op in (
            *("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh"),
            *("tanh", "asinh", "acosh", "atanh"),
        )
    },
}
"""Operations that keep the polynomials; of all others the bounds of the arguments give bounds of the result."""


def _apply(node: Node, nodes: Sequence[Node], x: Sequence[Any]) -> Any:
    """The result of an operation on models and truth values."""
    numbers = [nodes[a].value if nodes[a].op == "constant" else None for a in node.arguments]
    if node.op in OPERATIONS and all(isinstance(a, Model) for a in x[node.op == "select" :]):
        return OPERATIONS[node.op](*x)
    if node.op == "pow" and numbers[1] is not None:
        return curve("pow", x[0], float(numbers[1]))
    if node.op == "stumpff":
        return curve("stumpff", x[1], float(numbers[0] or 0.0))
    found = INTERVALS[node.op](*(a.bounds if isinstance(a, Model) else a for a in x))
    return found if isinstance(found, Truth) else Model.within(found)


class Polynomials(NamedTuple):
    """Numbers on boxes: `centre + Σ wₘ terms[m]` within `rest` (K, B), |wₘ| ≤ 1, terms (f + p, K, B).

    There is a term for each variable and, after these, one for each pair of them, `pairs(f)`.
    """

    centre: Float[np.ndarray, "K B"]
    terms: Float[np.ndarray, "m K B"]
    rest: Float[np.ndarray, "K B"]


def polynomials(
    lowered: Lowered, low: Float[np.ndarray, "B d"], high: Float[np.ndarray, "B d"], free: Int[np.ndarray, "f"]
) -> Polynomials:
    """The values of a graph on boxes, as polynomials in the variables `free`; all others are held fixed.

    Where nothing is known of a value its `rest` is NaN or infinite.
    """
    boxes, f = len(low), len(free)
    nodes, uses = lowered.graph.nodes, Counter(lowered.outputs)
    uses.update(a for node in lowered.graph.nodes for a in node.arguments)
    variable = {int(i): k for k, i in enumerate(free)}
    values: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for number, node in enumerate(nodes):
            if node.op == "input":
                i = int(node.value or 0)
                centre = middle_of(low[:, i], high[:, i])
                half = np.maximum(high[:, i] - centre, centre - low[:, i]) * (1 + ROUND)
                on = (variable[i],) if i in variable else ()
                line = half[None] if on else np.empty((0, 1))
                values[number] = Model(on, centre, line, np.zeros((_count(on), 1)), np.zeros(1) if on else half)
            elif node.op == "constant":
                truth = isinstance(node.value, bool)
                values[number] = INTERVALS["constant"](node.value) if truth else Model.number(node.value)
            else:
                values[number] = _apply(node, nodes, [values[a] for a in node.arguments])
            for a in node.arguments:  # what no later operation reads is given up, so that the rest stays in the cache
                uses[a] -= 1
                if not uses[a]:
                    del values[a]
        found = [values[i] for i in lowered.outputs]
        count = len(found)
        centre, rest, terms = (
            np.empty((count, boxes)),
            np.empty((count, boxes)),
            np.empty((f + f * (f + 1) // 2, count, boxes)),
        )
        square = np.array([i == j for i, j in pairs(f)], bool)
        for k, value in enumerate(found):
            line, bend = value.over(tuple(range(f)))
            terms[:f, k], terms[f:, k] = line, bend
            terms[f:, k][square] /= 2
            shift = sum_over(np.broadcast_to(bend[square] / 2, (f, boxes)))
            centre[k] = value.at + shift  # the square of a variable is ½ ± ½
            rest[k] = (value.rest + ROUND * (np.abs(value.at) + value.bent)) * (1 + ROUND)
    return Polynomials(centre, terms, rest)
