"""Enclosures of JAX functions over boxes by Taylor models: a polynomial of second order, and a radius for all the rest.

Made for checking what another arithmetic has proved, and shares nothing with it: reads jaxprs itself, entry by entry,
on NumPy arrays of boxes. Trusted are IEEE `+ − × ÷ √` and operations that are exact; no library's elementary functions.

Source: Makino & Berz 2003, Taylor models and other validated functional inclusion methods, International Journal of
Pure and Applied Mathematics 4(4).
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from covariant.lowering import STUMPFF

ROUND, TINY = 2.0**-40, 2.0**-990
"""More than the relative rounding of a few hundred operations, and than what may underflow in them."""
CHUNK, MOST = 1024, 20_000
"""Boxes at once, and boxes that may be left over when many were halved."""
LN2 = float.fromhex("0x1.62e42fefa38p-1"), float.fromhex("0x1.ef35793c7673p-45")
QUARTER = float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a626331p-34")
"""log 2 and π/2, each in two parts: products of the first one with whole numbers below 2000 are exact."""


class UndecidedError(ArithmeticError):
    """A branch that is not the same everywhere in the boxes."""


class Taylor:
    """A number on each of B boxes: within `radius` of `Σ terms[k][m] eₘ`, eₘ of degree k in variables εᵢ in [−1, 1].

    e₀ = 1, eᵢ = εᵢ, eᵢⱼ = εᵢεⱼ, eᵢᵢ = 2εᵢ² − 1. The number is no farther than `away` from its constant term, `middle`.
    """

    def __init__(self, terms: Sequence[dict], radius: Any):
        self.terms, self.middle, self.radius = terms, terms[0][()], radius + TINY
        self.sizes = [sum(map(abs, part.values()), 0.0) for part in terms]
        self.away = (self.sizes[1] + self.sizes[2] + self.radius) * (1 + ROUND)

    def __add__(self, other: "Taylor") -> "Taylor":
        return _sum(self, other)

    def __sub__(self, other: "Taylor") -> "Taylor":
        return _sum(self, _minus(other))

    def __neg__(self) -> "Taylor":
        return _minus(self)

    def __mul__(self, other: "Taylor") -> "Taylor":
        return _product(self, other)

    def __truediv__(self, other: "Taylor") -> "Taylor":
        return _product(self, curve("inv", other))


# Every operation is done once for the boxes at hand: its result is kept, and found by the numbers that went into it.


@functools.cache
def _sum(a: Taylor, b: Taylor) -> Taylor:
    if ZERO in (a, b):
        return b if a is ZERO else a
    terms = [{m: s.get(m, 0.0) + t.get(m, 0.0) for m in s | t} for s, t in zip(a.terms, b.terms, strict=True)]
    return Taylor(terms, (a.radius + b.radius + ROUND * sum(a.sizes + b.sizes)) * (1 + ROUND))


@functools.cache
def _minus(a: Taylor) -> Taylor:
    return a if a is ZERO else Taylor([{m: -t for m, t in part.items()} for part in a.terms], a.radius)


@functools.cache
def _product(a: Taylor, b: Taylor) -> Taylor:
    if ZERO in (a, b) or ONE in (a, b):
        return ZERO if ZERO in (a, b) else b if a is ONE else a
    terms, (_, line, bend), (_, slope, curved) = [{}, {}, {}], a.sizes, b.sizes
    for i, j in ((0, 0), (0, 1), (1, 0), (0, 2), (1, 1), (2, 0)):
        for (m, s), (n, t) in itertools.product(a.terms[i].items(), b.terms[j].items()):
            key, part = tuple(sorted(m + n)), s * t
            if m == n and m:  # the square of a variable is ½, up or down by ½
                part = part / 2
                terms[0][()] = terms[0][()] + part
            terms[i + j][key] = terms[i + j].get(key, 0.0) + part
    one, two = sum(a.sizes), sum(b.sizes)
    cut = line * curved + bend * (slope + curved)  # of third and fourth order
    return Taylor(terms, (cut + a.radius * (two + b.radius) + one * b.radius + ROUND * one * two) * (1 + ROUND))


def number(middle: Any, radius: Any = 0.0) -> Taylor:
    """Anything between `middle − radius` and `middle + radius`."""
    return Taylor([{(): middle}, {}, {}], radius)


ZERO, ONE, HALF, RIGHT = number(0.0), number(1.0), number(0.5), number(math.pi / 2, ROUND)


@functools.cache
def exact(x: float | int) -> Taylor:
    """A known number."""
    return ZERO if x == 0 else ONE if x == 1 else number(np.float64(x))


# Elementary functions.


def points(name: str, x: np.ndarray) -> np.ndarray:
    """A function at points. Its error is below ROUND/2, relative, or absolute for a sine and a logarithm."""
    if name in ("inv", "sqrt"):
        return 1 / x if name == "inv" else np.sqrt(x)
    if name.startswith("stumpff"):
        k = int(name[7:])
        return np.asarray(functools.reduce(lambda s, j: 1 / math.factorial(2 * j + k) - x * s, range(24, -1, -1), 0.0))
    if name in ("atan", "log"):  # twice the inverse tangent of half the angle; of a root near one
        for _ in range(3 if name == "atan" else 10):
            x = x / (1 + np.sqrt(1 + x * x)) if name == "atan" else np.sqrt(x)
        x = x if name == "atan" else (x - 1) / (x + 1)
        square, scale = (-x * x, 8) if name == "atan" else (x * x, 2048)
        return scale * x * functools.reduce(lambda total, k: 1 / k + square * total, range(45, 0, -2), 0.0)
    unit, turn = (QUARTER, 1j) if name == "sin" else (LN2, 1)
    n = np.rint(x / unit[0])
    r = ((x - n * unit[0]) - n * unit[1]) * turn
    value = functools.reduce(lambda total, k: 1 + r / k * total, range(22, 0, -1), 1.0)
    if name == "exp":
        return np.ldexp(value, n.astype(int))
    return np.where(n % 2 == 0, value.imag, value.real) * np.where(n % 4 < 2, 1, -1)


def bounds(name: str, a: Taylor) -> Taylor:
    """A function over the range of a number, from its values at the ends; a sine from that in the middle.

    NaN where it is not defined on all of the range, or not known here. Stumpff's functions fall up to π².
    """
    if name.startswith("stumpff"):
        low, high = a.middle - a.away, a.middle + a.away
        ends = [points(name, np.where((low > -1) & (high < 9.8), end, np.nan)) for end in (low, high)]
        half, error = abs(ends[1] - ends[0]) / 2, ROUND / math.factorial(int(name[7:]))
        return number(ends[0] / 2 + ends[1] / 2, half + error)
    known = abs(a.middle) + a.away < (1e3 if name in ("sin", "exp") else 1e150)
    known &= (name not in ("inv", "log")) | (abs(a.middle) > a.away)
    x = np.where(known, [a.middle - a.away, a.middle, a.middle + a.away], np.nan)
    low, middle, high = points(name, x)
    error = ROUND * (abs(low) + abs(high) + (name in ("sin", "log")))
    return number(middle, a.away + error) if name == "sin" else number(low / 2 + high / 2, abs(high - low) / 2 + error)


def _bell(a: Taylor) -> Taylor:
    """1/(1 + a²) over the range of a."""
    near, far = np.maximum(abs(a.middle) - a.away, 0.0), abs(a.middle) + a.away
    low, high = 1 / (1 + far * far), 1 / (1 + near * near)
    return number(low / 2 + high / 2, (high - low) / 2 + ROUND * high)


CURVES: dict[str, Callable[[Taylor, Taylor], tuple[Taylor, Taylor]]] = {
    "inv": lambda x, f: (-(f * f), f * f * f),
    "sqrt": lambda x, f: (HALF * (g := bounds("inv", f)), -(HALF * HALF * HALF * g * g * g)),
    "exp": lambda x, f: (f, HALF * f),
    "log": lambda x, f: (g := bounds("inv", x), -(HALF * g * g)),
    "atan": lambda x, f: (g := _bell(x), -(x * g * g)),
    "sin": lambda x, f: (bounds("sin", x + RIGHT), -(HALF * f)),
}
"""The derivative, and half the second one, from x and the value."""


def _stumpff(k: int) -> Callable[[Taylor, Taylor], tuple[Taylor, Taylor]]:
    """From `c_k' = (k c_{k+2} − c_{k+1})/2`, twice."""

    def slopes(x: Taylor, f: Taylor) -> tuple[Taylor, Taylor]:
        one, two, three, four = (bounds(f"stumpff{k + i}", x) for i in (1, 2, 3, 4))
        bend = exact(k * (k + 2)) * four - exact(2 * k + 1) * three + two
        return HALF * (exact(k) * two - one), exact(0.125) * bend

    return slopes


@functools.cache
def curve(name: str, a: Taylor) -> Taylor:
    """A function by Taylor's formula `f(c) + f'(c) d + ½ f''(ξ) d²`: c the middle, d what is left, ξ in the range."""
    at, around = number(a.middle), number(a.middle, a.away)
    value, left = bounds(name, at), Taylor([{(): 0.0 * a.middle}, *a.terms[1:]], a.radius)
    slopes = CURVES[name] if name in CURVES else _stumpff(int(name[7:]))
    return value + slopes(at, value)[0] * left + slopes(around, bounds(name, around))[1] * (left * left)


# Branches. A truth that is the same on all boxes is a `bool`, any other a number: 1, 0, or all between where undecided.


def less(a: Taylor, b: Taylor) -> bool | Taylor:
    """Whether a < b, known where one is below the other by anything at all: where both may meet there may be a kink."""
    gap = a - b
    known = abs(gap.middle) > gap.away
    found = np.where(known, 1.0 * (gap.middle < 0), 0.5)
    same = np.all(known) and np.all(found == np.max(found))
    return bool(np.max(found)) if same else number(found, np.where(known, 0.0, 0.5))


def choose(which: bool | Taylor, a: Taylor, b: Taylor) -> Taylor:
    """a where that is true, b where it is not, and anything between them where it is undecided."""
    if isinstance(which, bool):
        return a if which else b
    yes, no = which.middle - which.away > 0.5, which.middle + which.away < 0.5
    low = np.minimum(a.middle - a.away, b.middle - b.away)
    high = np.maximum(a.middle + a.away, b.middle + b.away)
    keys = [s | t for s, t in zip(a.terms, b.terms, strict=True)]
    terms = [
        {m: np.where(yes, s.get(m, 0.0), np.where(no, t.get(m, 0.0), 0.0)) for m in all_}
        for s, t, all_ in zip(a.terms, b.terms, keys, strict=True)
    ]
    terms[0][()] = np.where(yes | no, terms[0][()], low / 2 + high / 2)
    between = (high - low) / 2 + ROUND * (abs(low) + abs(high))
    return Taylor(terms, np.where(yes, a.radius, np.where(no, b.radius, between)))


def decided(truth: bool | Taylor) -> bool:
    """A truth that must be known. Raises `UndecidedError`."""
    if isinstance(truth, Taylor):
        raise UndecidedError("a branch is not decided")
    return truth


def floor(a: Taylor) -> Taylor:
    """The whole number below, or one of those. Where it is always the same it is known."""
    low, high = np.floor(a.middle - a.away), np.floor(a.middle + a.away)
    if np.all(low == high) and np.all(low == np.max(low)):
        return exact(float(np.max(low)))
    return number(low / 2 + high / 2, (high - low) / 2)


def unequal(a: Taylor, b: Taylor) -> bool | Taylor:
    """Whether a ≠ b. A comparison with itself, by which a missing value is told, is known: a number is itself."""
    known = less(a, b)
    if a is b or isinstance(known, bool):
        return a is not b
    return number(np.where(known.away < 0.25, 1.0, 0.5), np.where(known.away < 0.25, 0.0, 0.5))


def opposite(truth: bool | Taylor) -> bool | Taylor:
    return ONE - truth if isinstance(truth, Taylor) else not truth


# JAX's primitives.

ENTRIES: dict[str, Callable] = {
    **{name: functools.partial(curve, name) for name in CURVES},
    "add": lambda a, b: a + b,
    "add_any": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "neg": lambda a: -a,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "square": lambda a: a * a,
    "rsqrt": lambda a: curve("inv", curve("sqrt", a)),
    "cos": lambda a: curve("sin", a + RIGHT),
    "tan": lambda a: curve("sin", a) / curve("sin", a + RIGHT),
    "tanh": lambda a: ONE - ONE / (HALF * (curve("exp", a + a) + ONE)),
    "logistic": lambda a: ONE / (ONE + curve("exp", -a)),
    "atan2": lambda y, x: (half := curve("atan", y / (x + curve("sqrt", x * x + y * y)))) + half,
    "expm1": lambda a: curve("exp", a) - ONE,
    "log1p": lambda a: curve("log", a + ONE),
    "sinh": lambda a: HALF * (curve("exp", a) - curve("exp", -a)),
    "cosh": lambda a: HALF * (curve("exp", a) + curve("exp", -a)),
    "pow": lambda a, b: curve("exp", b * curve("log", a)),
    "lt": less,
    "gt": lambda a, b: less(b, a),
    "le": lambda a, b: opposite(less(b, a)),
    "ge": lambda a, b: opposite(less(a, b)),
    "ne": unequal,
    "eq": lambda a, b: opposite(unequal(a, b)),
    "and": lambda a, b: a * b,
    "or": lambda a, b: a + b - a * b,
    "not": opposite,
    "select_n": lambda which, no, yes: choose(which, yes, no),
    "max": lambda a, b: choose(less(a, b), b, a),
    "min": lambda a, b: choose(less(a, b), a, b),
    "clamp": lambda low, a, high: ENTRIES["min"](ENTRIES["max"](a, low), high),
    "abs": lambda a: choose(less(a, ZERO), -a, a),
    "sign": lambda a: choose(less(a, ZERO), -ONE, ONE),
    "round": lambda a: floor(a + HALF),
    "floor": floor,
    "is_finite": lambda a: less(a * a, number(1e300)),
}


# Where a primitive is defined, and does not jump.


def _apart(a: Taylor) -> Any:
    return abs(a.middle) > a.away


def _positive(a: Taylor) -> Any:
    return a.middle > a.away


def _between(a: Taylor) -> Any:
    """Whether there is no whole number in the range, nor at its ends."""
    below = np.floor(a.middle - a.away)
    return (below < a.middle - a.away) & (np.floor(a.middle + a.away) == below)


def _settled_choice(which: Any, *cases: Taylor) -> Any:
    return True if isinstance(which, bool | np.bool_) else abs(which.middle - 0.5) > which.away


NEEDS: dict[str, Callable] = {
    "div": lambda a, b: _apart(b),
    "inv": _apart,
    **dict.fromkeys(("sqrt", "rsqrt", "log"), _positive),
    "log1p": lambda a: _positive(a + ONE),
    "pow": lambda a, b: _positive(a),
    "tan": lambda a: _apart(curve("sin", a + RIGHT)),
    "atan2": lambda y, x: _positive(x) | _apart(y),
}
STAYS: dict[str, Callable] = {
    "sign": _apart,
    **dict.fromkeys(("floor", "ceil"), _between),
    "round": lambda a: _between(a + HALF),
    "select_n": _settled_choice,
}
"""Conditions under which each primitive is defined, and under which it does not jump; those not named always are."""


def each(function: Callable, *x: Any) -> np.ndarray:
    """A function of entries, entry by entry."""
    return np.asarray(np.frompyfunc(function, len(x), 1)(*x), object)


def _total(x: np.ndarray, axes: Any) -> Any:
    return np.sum(x, axis=axes, initial=ZERO)  # pyright: ignore[reportCallIssue, reportArgumentType]


def _dot(p: dict, a: np.ndarray, b: np.ndarray) -> Any:
    (over, other), (batch, second) = p["dimension_numbers"]
    free, rest = ([k for k in range(x.ndim) if k not in axes] for x, axes in ((a, over + batch), (b, other + second)))
    start, end = len(batch), len(batch) + len(free)
    a = np.expand_dims(a.transpose(*batch, *free, *over), tuple(range(end, end + len(rest))))
    b = np.expand_dims(b.transpose(*second, *rest, *other), tuple(range(start, end)))
    return _total(a * b, tuple(range(-len(over), 0)))


def _power(p: dict, x: np.ndarray) -> Any:
    base = x if p["y"] > 0 else each(ENTRIES["inv"], x)
    return functools.reduce(np.multiply, [base] * abs(p["y"]), each(lambda _: ONE, x))


def _fold(name: str) -> Callable:
    """An operation over some axes, one entry after the other."""

    def fold(p: dict, x: np.ndarray) -> Any:
        axes = tuple(p["axes"])
        rows = np.moveaxis(x, axes, range(len(axes)))
        rows = rows.reshape(math.prod(rows.shape[: len(axes)]), *rows.shape[len(axes) :])
        return functools.reduce(functools.partial(each, ENTRIES[name]), rows)

    return fold


def _broadcast(p: dict, x: np.ndarray) -> np.ndarray:
    sides = dict(zip(p["broadcast_dimensions"], x.shape, strict=True))
    return np.broadcast_to(x.reshape([sides.get(k, 1) for k in range(len(p["shape"]))]), p["shape"])


ARRAYS: dict[str, Callable] = {
    "dot_general": _dot,
    "integer_pow": _power,
    "reduce_sum": lambda p, x: _total(x, tuple(p["axes"])),
    **{f"reduce_{name}": _fold(name) for name in ("max", "min", "and", "or")},
    "argmax": lambda p, x: max(range(len(x)), key=functools.cmp_to_key(lambda i, j: 1 - 2 * decided(less(x[i], x[j])))),
    "broadcast_in_dim": _broadcast,
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "transpose": lambda p, x: x.transpose(p["permutation"]),
    "concatenate": lambda p, *x: np.concatenate(x, p["dimension"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "slice": lambda p, x: x[
        tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or (None,) * x.ndim))
    ],
}
MOVES = {
    *("split", "pad", "gather", "scatter", "dynamic_slice", "dynamic_update_slice", "expand_dims"),
    *("copy", "copy_p", "convert_element_type", "stop_gradient"),
}
"""Primitives that only move entries; they do it themselves, with the numbers of the places."""
CALLS = {"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"}
LEAVES = {*CALLS, "cond", "scan"}
"""Primitives that are looked into."""


def _refuse_shortened(eqn: Any) -> None:
    """A number made shorter is no function of real numbers."""
    if eqn.primitive.name == "reduce_precision":
        raise ValueError("the model makes numbers shorter, by 'reduce_precision'")
    if eqn.primitive.name != "convert_element_type" or not (_real(eqn.invars[0]) and _real(eqn.outvars[0])):
        return
    old, new = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if jnp.finfo(new).nmant < jnp.finfo(old).nmant:
        raise ValueError(f"the model makes numbers shorter, {old} to {new}")


# A function without what JAX is told about its derivative.


def plain(function: Callable) -> Callable:
    """The same function, for JAX to differentiate: no rule that somebody declared for a derivative, nothing hidden from
    one, and |x|, min and max as choices, whose derivatives are those of both sides where these meet.
    """

    def inlined(*x: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*x)
        found = _inlined(closed.jaxpr, closed.consts, jax.tree.leaves(x))
        return jax.tree.unflatten(jax.tree.structure(shape), found)

    return inlined


CHOICES: dict[str, Callable] = {
    "abs": lambda a: jnp.where(a < 0, -a, a),
    "max": lambda a, b: jnp.where(a < b, b, a),
    "min": lambda a, b: jnp.where(a < b, a, b),
    "clamp": lambda low, a, high: CHOICES["min"](CHOICES["max"](a, low), high),
    "stop_gradient": lambda a: a,
}


def _inlined(jaxpr: Any, consts: Sequence, x: Sequence) -> list:
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *x], strict=True))

    def read(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known[atom]

    for eqn in jaxpr.eqns:
        name, p, x = eqn.primitive.name, eqn.params, list(map(read, eqn.invars))
        if name in CALLS:
            inner = p.get("jaxpr", p.get("call_jaxpr"))
            out = _inlined(inner.jaxpr, inner.consts, x)
        elif name == "scan":
            out = _unrolled(p, x)
        elif name in ("cond", "while"):
            raise ValueError(f"the operation '{name}' is not known to the check")
        elif name in CHOICES and _real(eqn.invars[0]):
            out = [CHOICES[name](*x)]
        else:
            out = eqn.primitive.bind(*x, **p)
            out = out if eqn.primitive.multiple_results else [out]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _unrolled(p: dict, x: list) -> list:
    first, last = p["num_consts"], p["num_consts"] + p["num_carry"]
    carry, rows = x[first:last], []
    for i in range(p["length"])[:: -1 if p["reverse"] else 1]:
        found = _inlined(p["jaxpr"].jaxpr, p["jaxpr"].consts, [*x[:first], *carry, *(a[i] for a in x[last:])])
        carry, rows = found[: last - first], [*rows, found[last - first :]]
    return [*carry, *(jnp.stack(column) for column in zip(*rows[:: -1 if p["reverse"] else 1], strict=True))]


def _real(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.floating)


def _whole(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.integer)


def _settled(value: Any, atom: Any) -> np.ndarray:
    """A result as an array: of numbers, or of known truths or whole numbers."""
    value = np.asarray(value, getattr(value, "dtype", object))
    if _real(atom) or value.dtype != object:
        return value
    if not any(isinstance(entry, Taylor) for entry in value.flat):
        return value.astype(atom.aval.dtype)
    if _whole(atom):
        raise UndecidedError("a place is not decided")
    return each(lambda truth: truth if isinstance(truth, Taylor) else exact(float(truth)), value)


class Enclosure:
    """A function of z (d,) over boxes, as an array of `Taylor`.

    - `low`, `high` (d,): a box in which all others lie; variables without width are fixed.
    - `room` (d,): how much farther out than its box z may be.
    - `watch`: instead of the function, the number 1 on boxes where all that it computes is "defined", or "smooth": is
      defined and does not jump; and −1 on others.
    """

    def __init__(
        self,
        function: Callable,
        low: np.ndarray,
        high: np.ndarray,
        room: np.ndarray,
        watch: Literal["", "defined", "smooth"] = "",
    ):
        closed = jax.make_jaxpr(function)(jnp.asarray(low))
        needed = partial_eval.dce_jaxpr(closed.jaxpr, [True], instantiate=True)[0]
        self.jaxpr, self.consts = closed.jaxpr if watch else needed, closed.consts
        self.needs = {"": {}, "defined": NEEDS, "smooth": NEEDS | STAYS}[watch] if watch else None
        self.free, self.room, self._places = high > low, room, {}

    def __call__(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The function over boxes with corners (B, d).

        Raises `UndecidedError` where boxes take different branches, `ValueError` naming an operation not known here.
        """
        for known in (_sum, _minus, _product, curve):
            known.cache_clear()
        middle = low / 2 + high / 2
        half = np.maximum(high - middle, middle - low) * (1 + ROUND)
        z = np.array([Taylor([{(): c}, {}, {}], room) for c, room in zip(middle.T, self.room, strict=True)], object)
        for k in np.flatnonzero(self.free):
            z[k] = Taylor([z[k].terms[0], {(int(k),): half[:, k]}, {}], self.room[k])
        self._good = np.ones(len(low), bool)
        with np.errstate(all="ignore"):
            found = self._run(self.jaxpr, self.consts, [z])[0]
        return found if self.needs is None else np.array([[number(np.where(self._good, 1.0, -1.0))]], object)

    def _run(self, jaxpr: Any, consts: Sequence, args: Sequence) -> list:
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

        def read(atom) -> np.ndarray:
            x = np.asarray(atom.val if hasattr(atom, "val") else known[atom])
            return each(exact, x.astype(float)) if _real(atom) and x.dtype != object else x

        for eqn in jaxpr.eqns:
            name, p, x = eqn.primitive.name, eqn.params, list(map(read, eqn.invars))
            _refuse_shortened(eqn)
            if self.needs is not None and any(a.dtype == object for a in x):
                self._look(eqn, x)
            if name in CALLS:
                inner = p.get("jaxpr", p.get("call_jaxpr"))
                out = self._run(inner.jaxpr, inner.consts, x)
            elif name == "cond":
                inner = p["branches"][int(x[0])]
                out = self._run(inner.jaxpr, inner.consts, x[1:])
            elif name == "scan":
                out = self._scan(p, x)
            elif not any(a.dtype == object for a in x):
                out = self._move(eqn, x)
            else:
                out = self._work(eqn, x)
            known |= {v: _settled(value, v) for v, value in zip(eqn.outvars, out, strict=True)}
        return [read(atom) for atom in jaxpr.outvars]

    def _look(self, eqn: Any, x: list) -> None:
        """Note the boxes on which a primitive is not defined, or meets what is no number, or jumps."""
        name = eqn.primitive.name
        need = (self.needs or {}).get(name)
        if name == "integer_pow" and eqn.params["y"] < 0:
            need = _apart
        if name in LEAVES:
            return
        for a, atom in zip(x, eqn.invars, strict=True):
            if _real(atom) and name != "select_n" and name not in MOVES:
                for entry in set((a if a.dtype == object else each(exact, a)).flat):
                    self._good &= np.isfinite(entry.middle) & np.isfinite(entry.away)
        if need is not None:
            pairs = (a if a.dtype == object or a.dtype == bool else each(exact, a.astype(float)) for a in x)
            for entries in zip(*(a.flat for a in np.broadcast_arrays(*pairs)), strict=True):
                self._good &= need(*entries)

    def _work(self, eqn: Any, x: list) -> list:
        """A primitive of numbers; `x` may have known places, and known truths, beside them."""
        name, p, atoms = eqn.primitive.name, eqn.params, eqn.invars
        chosen = name == "select_n" and x[0].dtype != object
        x = [
            a if a.dtype == object or _whole(v) or (chosen and v is atoms[0]) else each(exact, a.astype(float))
            for a, v in zip(x, atoms, strict=True)
        ]
        if name in ARRAYS:
            return [ARRAYS[name](p, *x)]
        if chosen or (name in MOVES and _real(atoms[0]) <= _real(eqn.outvars[0])):
            return self._move(eqn, x)
        if eqn.primitive is STUMPFF:
            return [each(functools.partial(curve, f"stumpff{p['k']}"), *x)]
        if name in ENTRIES:
            return [each(ENTRIES[name], *(a if a.dtype == object else each(exact, a.astype(float)) for a in x))]
        raise ValueError(f"the operation '{name}' is not known to the check")

    def _scan(self, p: dict, x: list) -> list:
        first, last = p["num_consts"], p["num_consts"] + p["num_carry"]
        carry, rows = x[first:last], []
        for i in range(p["length"]):
            k = p["length"] - 1 - i if p["reverse"] else i
            found = self._run(p["jaxpr"].jaxpr, p["jaxpr"].consts, [*x[:first], *carry, *(a[k] for a in x[last:])])
            carry, rows = found[: last - first], [*rows, found[last - first :]]
        return [*carry, *(np.stack(column) for column in zip(*rows[:: -1 if p["reverse"] else 1], strict=True))]

    def _move(self, eqn: Any, x: list) -> list:
        """What a primitive makes of known numbers, or where it moves entries."""
        pairs = [(a, a.dtype == object) for a in x]
        key = (id(eqn), *(a.tobytes() for a, real in pairs if not real))
        if key not in self._places:
            starts = itertools.accumulate((a.size * real for a, real in pairs), initial=0)
            places = [np.arange(k, k + a.size).reshape(a.shape) for k, a in zip(starts, x, strict=False)]
            given = [jnp.asarray(k if real else a) for k, (a, real) in zip(places, pairs, strict=True)]
            with jax.ensure_compile_time_eval():
                out = eqn.primitive.bind(*given, **eqn.params)
            self._places[key] = [np.asarray(o) for o in (out if eqn.primitive.multiple_results else [out])]
        entries = [a.ravel() for a, real in pairs if real]
        return [np.concatenate(entries)[o.astype(int)] for o in self._places[key]] if entries else self._places[key]


def definite(matrix: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """On which boxes, of a width (B, d), a symmetric matrix (n, n) is positive definite; what variable widens it most.

    A matrix `Σ Sₘeₘ` with e₀ = 1 and all other |eₘ| ≤ 1 is, if for some C the spectral radius of
    `E = |CᵀS₀C − I| + Σ|CᵀSₘC|` is below one: if some positive x has Ex < x.
    """
    keys = sorted({m for entry in matrix.flat for part in entry.terms for m in part})
    s, radius = np.zeros((len(keys), len(width), *matrix.shape)), np.zeros((len(width), *matrix.shape))
    for (i, j), entry in np.ndenumerate(matrix):
        radius[:, i, j] = entry.radius
        for m, t in itertools.chain(*(part.items() for part in entry.terms)):
            s[keys.index(m), :, i, j] = t
    with np.errstate(all="ignore"):
        unit = 1 / np.sqrt(np.diagonal(s[0], axis1=1, axis2=2))[:, :, None]
        scaled = unit * s[0] * unit.swapaxes(1, 2)
        values, vectors = np.linalg.eigh(np.where(np.isfinite(scaled), scaled, -np.eye(len(matrix))))
        c = unit * vectors / np.sqrt(np.maximum(values, TINY))[:, None]
        ct = c.swapaxes(1, 2)
        turned = ct @ s @ c
        turned[0] -= np.eye(len(matrix))
        e = abs(turned).sum(0) + abs(ct) @ (radius + ROUND * abs(s).sum(0)) @ abs(c) + ROUND
        x = np.ones((*e.shape[:2], 1))
        for _ in range(5):
            x = e @ x
            x = x / x.max(1, keepdims=True) + ROUND
        good = (e @ x * (1 + ROUND) < x).all((1, 2))
    shares = [
        sum((abs(t).sum((1, 2)) for t, m in zip(turned, keys, strict=True) if k in m), 0 * good)
        for k in range(width.shape[1])
    ]
    weight = np.stack(shares, 1)
    known = np.isfinite(weight).all(1, keepdims=True) & (weight > 0).any(1, keepdims=True)
    return good, np.where(known, weight, width).argmax(1)


def halves(low: np.ndarray, high: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes (B, d), lower before upper, along one axis each. Both hold the middle."""
    rows = np.arange(len(low))
    middle = low[rows, axes] / 2 + high[rows, axes] / 2
    low, high = np.repeat(low, 2, 0), np.repeat(high, 2, 0)
    high[2 * rows, axes] = low[2 * rows + 1, axes] = middle
    return low, high


def show_definite(matrix: Enclosure, low: np.ndarray, high: np.ndarray, depth: int, what: str) -> None:
    """Raises `ValueError` unless `matrix + matrixᵀ` is positive definite on all boxes, halved up to `depth` times."""
    left, most, size = np.full(len(low), depth), len(low) + MOST, CHUNK
    while len(low):
        # The last ones first, halves among them: an operation costs little more for many boxes than for one.
        (low, a), (high, b), (left, deep) = ((x[:-size], x[-size:]) for x in (low, high, left))
        if len(low) > most or (deep < 0).any():
            k = deep.argmin()
            box = ", ".join(f"{c:.6g} to {d:.6g}" for c, d in zip(a[k], b[k], strict=True))
            raise ValueError(f"{what} is not shown to hold where the variables are {box}")
        try:
            found = matrix(a, b)
            good, axes = definite(found + found.T, b - a)
        except UndecidedError:
            good, axes = np.zeros(len(a), bool), (b - a).argmax(1)
            if len(a) > 1:
                size = len(a) // 2
                low, high, left = (np.concatenate(x) for x in ((low, a), (high, b), (left, deep)))
                continue
        size = min(2 * size, CHUNK)
        lower, upper = halves(a[~good], b[~good], axes[~good])
        low, high = np.concatenate([low, lower]), np.concatenate([high, upper])
        left = np.concatenate([left, np.repeat(deep[~good] - 1, 2)])
