"""Interval arithmetic for graphs: rigorous bounds on their values over whole boxes, including all rounding errors.

The bounds hold for the function of real numbers that the graph represents, with its constants exactly the doubles they
are. They rely on IEEE 754 alone: + - × ÷ and the square root of doubles, rounded to nearest. Every bound is moved
outward by at least its rounding error: by a part in 2⁵³ of itself and, where products may underflow, by the smallest
normal double (S. M. Rump, P. Zimmermann, S. Boldo, G. Melquiond, Computing predecessor and successor in rounding to
nearest, BIT 49, 2009).

A bound that is NaN gives no information. Where a function is not defined on all of a box, such as the root of a
negative number, both bounds are NaN and remain so through every operation; comparisons with them are undecided.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from covariant.lowering import _stumpff
from covariant.lowering._elementary import ELEMENTARY, TINY
from covariant.lowering._read import Domain

STEP = 3 * 2.0**-54
"""A relative step outward: c ± STEP·|c|, in doubles, is a neighbour of c or beyond it.

Half a unit in the last place of c is at most 2⁻⁵³|c|; the margin makes the sum round away from c. This also holds for
subnormal c, down to those whose unit is the smallest double, where sums are exact.
"""
SMALL = 2.0**-1000
"""Results of at least this size have not underflowed."""
BLOCK = 4096
"""Number of boxes for which an elementary function is computed at once: its working arrays then stay in the cache."""
MOST_PRODUCTS = 32
"""Largest exponent of a power that is computed as a product."""


class Interval(NamedTuple):
    """Real numbers between two bounds, for each box: arrays of shape (B,), or scalars where all boxes share them."""

    low: Any
    high: Any


class Truth(NamedTuple):
    """What is known of a statement, for each box (B,): `must` if it holds everywhere on it, `may` if it may hold."""

    must: Any
    may: Any


def constant(value: float | bool | int) -> Interval | Truth:
    if isinstance(value, bool | np.bool_):
        return Truth(np.bool_(value), np.bool_(value))
    return Interval(np.float64(value), np.float64(value))


# Outward rounding. The argument is a new array, which is changed in place.


def _down(c: Any) -> Any:
    step = np.abs(c)
    step *= STEP
    c -= step
    return c


def _up(c: Any) -> Any:
    step = np.abs(c)
    step *= STEP
    c += step
    return c


def _product_step(c: Any, inexact: Callable[[], Any]) -> Any:
    """Outward step of a bound c that is a product or a quotient.

    Where results may have underflowed, `inexact` tells which values of c differ from the exact ones because of that.
    """
    step = np.abs(c)
    underflows = not step.min() >= SMALL
    step *= STEP
    if underflows:
        step += TINY * inexact()
    return step


def _product(low: Any, high: Any, a: Interval, b: Interval) -> Interval:
    """Bounds moved outward from the extreme products, or quotients, of the bounds of a and b.

    A zero may be an underflowed product only where the signs of a and b permit a nonzero one.
    """
    below = _product_step(low, lambda: (low != 0) | (a.low < 0) & (b.high > 0) | (a.high > 0) & (b.low < 0))
    above = _product_step(high, lambda: (high != 0) | (a.low < 0) & (b.low < 0) | (a.high > 0) & (b.high > 0))
    low -= below
    high += above
    return Interval(low, high)


def _is_number(a: Interval) -> bool:
    return bool(np.ndim(a.low) == 0 and a.low == a.high)


# The operations.


def neg(a: Interval) -> Interval:
    return Interval(-a.high, -a.low)


def add(a: Interval, b: Interval) -> Interval:
    return Interval(_down(a.low + b.low), _up(a.high + b.high))


def sub(a: Interval, b: Interval) -> Interval:
    return Interval(_down(a.low - b.high), _up(a.high - b.low))


def mul(a: Interval, b: Interval) -> Interval:
    if a is b:
        return square(a)
    if _is_number(a):
        return _scaled(np.multiply, b, a.low)
    if _is_number(b):
        return _scaled(np.multiply, a, b.low)
    return _extremes(np.multiply, a, b)


def _extremes(operation: np.ufunc, a: Interval, b: Interval) -> Interval:
    """Bounds of products or quotients: their extremes are at the ends of a and b."""
    low, other = operation(a.low, b.low), operation(a.low, b.high)
    own = isinstance(low, np.ndarray)  # a new array, which may be changed in place
    high = np.maximum(low, other)
    low = np.minimum(low, other, out=low if own else None)
    for end in b:
        value = operation(a.high, end, out=other if own else None)
        low = np.minimum(low, value, out=low if own else None)
        high = np.maximum(high, value, out=high if own else None)
    return _product(low, high, a, b)


def _scaled(operation: np.ufunc, a: Interval, k: Any) -> Interval:
    """a·k or a/k for a number k."""
    first, last = a if k >= 0 else a[::-1]
    low, high = operation(first, k), operation(last, k)
    below, above = _product_step(low, lambda: first != 0), _product_step(high, lambda: last != 0)
    return Interval(low - below, high + above)


def square(a: Interval) -> Interval:
    size = absolute(a)
    low, high = size.low * size.low, size.high * size.high
    below, above = _product_step(low, lambda: size.low != 0), _product_step(high, lambda: size.high != 0)
    low = low - below
    return Interval(low if low.min() >= 0 else np.maximum(low, 0.0), high + above)


def div(a: Interval, b: Interval) -> Interval:
    if _is_number(b) and b.low != 0:
        return _scaled(np.divide, a, b.low)
    if _is_number(a):
        first, last = b[::-1] if a.low >= 0 else b
        found = _product(a.low / first, a.low / last, a, b)
    else:
        found = _extremes(np.divide, a, b)
    return where((b.low > 0) | (b.high < 0), found)


def where(defined: Any, a: Interval) -> Interval:
    """The interval where the function is defined, NaN bounds elsewhere."""
    if np.all(defined):
        return a
    return Interval(np.where(defined, a.low, np.nan), np.where(defined, a.high, np.nan))


def absolute(a: Interval) -> Interval:
    nearest = np.maximum(a.low, -a.high)
    return Interval(np.maximum(nearest, 0.0), np.maximum(-a.low, a.high))


def minimum(a: Any, b: Any) -> Any:
    if isinstance(a, Truth):
        return both(a, b)
    return Interval(np.minimum(a.low, b.low), np.minimum(a.high, b.high))


def maximum(a: Any, b: Any) -> Any:
    if isinstance(a, Truth):
        return either(a, b)
    return Interval(np.maximum(a.low, b.low), np.maximum(a.high, b.high))


def sqrt(a: Interval) -> Interval:
    return where(a.low >= 0, Interval(_down(np.sqrt(a.low)), _up(np.sqrt(a.high))))


def _elementary_of(bounds: Callable) -> Callable:
    """An operation on intervals from one on bounds, applied block by block, so that its arrays stay in the cache."""

    def apply(*arguments: Interval) -> Interval:
        ends = np.broadcast_arrays(*(end for a in arguments for end in a))
        if ends[0].size <= BLOCK:
            return Interval(*bounds(*ends))
        parts = [bounds(*(end[k : k + BLOCK] for end in ends)) for k in range(0, ends[0].size, BLOCK)]
        low, high = map(np.concatenate, zip(*parts, strict=True))
        return Interval(low, high)

    return apply


_ELEMENTARY = {op: _elementary_of(bounds) for op, bounds in ELEMENTARY.items()}


def power(a: Interval, b: Interval) -> Interval:
    """Products and roots for constant exponents that are multiples of ½; otherwise by the logarithm, for a ≥ 0."""
    if _is_number(b) and (2 * b.low).is_integer() and abs(b.low) <= MOST_PRODUCTS:
        whole = b.low.is_integer()
        found = _product_of_many(a if whole else sqrt(a), int(abs(b.low if whole else 2 * b.low)))
        return div(Interval(np.float64(1.0), np.float64(1.0)), found) if b.low < 0 else found
    return _ELEMENTARY["pow"](a, b)


def _product_of_many(a: Interval, count: int) -> Interval:
    """aᶜᵒᵘⁿᵗ, by repeated squaring."""
    result = Interval(1.0 + 0.0 * a.low, 1.0 + 0.0 * a.high)
    while count:
        result = mul(result, a) if count % 2 else result
        count //= 2
        a = square(a) if count else a
    return result


def _stepwise(function: Callable) -> Callable:
    """A non-decreasing function that is constant between its jumps."""
    return lambda a: Interval(function(a.low), function(a.high))


# Statements, and choices by them.


def as_number(a: Interval | Truth) -> Interval:
    """A truth value as a number, 0 or 1."""
    return Interval(np.float64(a.must), np.float64(a.may)) if isinstance(a, Truth) else a


def lt(a: Interval | Truth, b: Interval | Truth) -> Truth:
    a, b = as_number(a), as_number(b)
    return Truth(a.high < b.low, ~(a.low >= b.high))


def le(a: Interval | Truth, b: Interval | Truth) -> Truth:
    a, b = as_number(a), as_number(b)
    return Truth(a.high <= b.low, ~(a.low > b.high))


def eq(a: Interval | Truth, b: Interval | Truth) -> Truth:
    a, b = as_number(a), as_number(b)
    if a is b:  # the usual test for a missing (NaN) measurement: a number equals itself where it is defined
        defined = ~(np.isnan(a.low) & np.isnan(a.high))
        return Truth(defined, np.ones_like(defined))
    return Truth((a.high <= b.low) & (b.high <= a.low), ~((a.high < b.low) | (b.high < a.low)))


def both(a: Truth, b: Truth) -> Truth:
    return Truth(a.must & b.must, a.may & b.may)


def either(a: Truth, b: Truth) -> Truth:
    return Truth(a.must | b.must, a.may | b.may)


def opposite(a: Truth) -> Truth:
    return Truth(~a.may, ~a.must)


def is_finite(a: Interval) -> Truth:
    known = np.isfinite(a.low) & np.isfinite(a.high)
    return Truth(known, np.ones_like(known))


def select(p: Truth, a: Any, b: Any) -> Any:
    """Values of a where p must hold, of b where it cannot, and the hull of both where it is undecided."""
    if isinstance(a, Truth):
        return either(both(a, b), either(both(p, a), both(opposite(p), b)))
    chosen = Interval(np.where(p.must, a.low, b.low), np.where(p.must, a.high, b.high))
    undecided = p.may & ~p.must
    if not np.any(undecided):
        return chosen
    low, high = np.minimum(a.low, b.low), np.maximum(a.high, b.high)
    return Interval(np.where(undecided, low, chosen.low), np.where(undecided, high, chosen.high))


def kinked(a: Interval, b: Interval, x: Interval, y: Interval) -> Interval:
    """A derivative at a kink: x where a < b, y where b < a, and the hull of both where a and b may be equal."""
    return select(Truth(a.high < b.low, ~(a.low > b.high)), x, y)


def stumpff(k: Interval, x: Interval) -> Interval:
    return Interval(*_stumpff.bounds(int(k.low), np.asarray(x.low), np.asarray(x.high)))


INTERVALS: Domain = {
    "constant": constant,
    "add": add,
    "sub": sub,
    "mul": mul,
    "div": div,
    "neg": neg,
    "abs": absolute,
    "sign": _stepwise(np.sign),
    "floor": _stepwise(np.floor),
    "ceil": _stepwise(np.ceil),
    "round": _stepwise(np.rint),
    "min": minimum,
    "max": maximum,
    "sqrt": sqrt,
    "lt": lt,
    "le": le,
    "eq": eq,
    "and": both,
    "or": either,
    "not": opposite,
    "is_finite": is_finite,
    "select": select,
    "either": kinked,
    "stumpff": stumpff,
    **_ELEMENTARY,
    "pow": power,
}
"""Each operation on intervals, for whole batches of boxes; statements are of the type `Truth`."""
