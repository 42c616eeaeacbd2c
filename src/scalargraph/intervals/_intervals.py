"""Interval arithmetic for graphs: rigorous bounds of values over whole boxes, including all rounding errors.

The bounds hold for the function of real numbers that the graph represents; its constants are exactly the given doubles.
They rely on IEEE 754 alone: + - × ÷ and the square root of doubles, rounded to nearest. Every bound is moved outward by
at least its rounding error: by a part in 2⁵³ of itself and, if a product may underflow, by the smallest normal double
(S. M. Rump, P. Zimmermann, S. Boldo, G. Melquiond, Computing predecessor and successor in rounding to nearest, BIT 49,
2009).

A bound that is NaN gives no information. If a function is undefined somewhere in a box, such as the root of a negative
number, both bounds are NaN and remain so through every operation; comparisons with them are undecided.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from scalargraph.graph import Domain, stumpff_bounds, stumpff_coefficients
from scalargraph.intervals._elementary import ELEMENTARY, TINY
from scalargraph.intervals._types import Interval, Truth

STEP = 3 * 2.0**-54
"""A relative step outward: c ± STEP·|c|, computed in doubles, is a neighbour of c or lies beyond it.

Half a unit in the last place of c is at most 2⁻⁵³|c|; the margin makes the sum round away from c. This also holds for
subnormal c, down to those whose unit is the smallest double, where sums are exact.
"""
SMALL = 2.0**-1000
"""Results of at least this size cannot have underflowed."""
BLOCK = 4096
"""Number of boxes for which an elementary function is computed at once; its working arrays then fit in the cache."""
MOST_PRODUCTS = 32
"""Largest exponent for which a power is computed as a product."""


def constant(value: float | bool | int) -> Interval | Truth:
    """Interval, or statement, of a known value; all boxes share it."""
    if isinstance(value, bool | np.bool_):
        return Truth(np.bool_(value), np.bool_(value))
    return Interval(np.float64(value), np.float64(value))


# Outward rounding. The argument must be a new array, as it is changed in place.


def _down(c: np.ndarray) -> np.ndarray:
    step = np.abs(c)
    step *= STEP
    c -= step
    return c


def _up(c: np.ndarray) -> np.ndarray:
    step = np.abs(c)
    step *= STEP
    c += step
    return c


def _product_step(c: np.ndarray, inexact: Callable[[], np.ndarray]) -> np.ndarray:
    """Outward step of a bound c that is a product or a quotient.

    If a result may have underflowed, `inexact()` says whether it differs from the exact result because of that.
    """
    step = np.abs(c)
    underflows = step < SMALL
    step *= STEP
    if underflows.any():
        step += TINY * (underflows & inexact())
    return step


def _product(low: np.ndarray, high: np.ndarray, a: Interval, b: Interval) -> Interval:
    """Bounds moved outward from the extreme products, or quotients, of the bounds of a and b.

    A zero counts as a possible underflow only if the signs of a and b permit a product that is not zero.
    """
    below = _product_step(low, lambda: (low != 0) | (a.low < 0) & (b.high > 0) | (a.high > 0) & (b.low < 0))
    above = _product_step(high, lambda: (high != 0) | (a.low < 0) & (b.low < 0) | (a.high > 0) & (b.high > 0))
    low -= below
    high += above
    return Interval(low, high)


def _is_number(a: Interval) -> bool:
    # NaN is unequal to itself, so it does not count as a number here.
    return bool(np.ndim(a.low) == 0 and a.low == a.high)


# The operations.


def neg(a: Interval) -> Interval:
    """Interval of −a; a change of sign is exact."""
    return Interval(-a.high, -a.low)


def add(a: Interval, b: Interval) -> Interval:
    """Interval of a + b; each bound is moved outward by the rounding error of its sum."""
    # A sum in the range of subnormal numbers is exact in IEEE arithmetic, so a relative step is enough.
    return Interval(_down(a.low + b.low), _up(a.high + b.high))


def sub(a: Interval, b: Interval) -> Interval:
    """Interval of a − b; each bound is moved outward by the rounding error of its difference."""
    return Interval(_down(a.low - b.high), _up(a.high - b.low))


def mul(a: Interval, b: Interval) -> Interval:
    """Interval of a·b, with the tightest rule that applies.

    If both factors are the same node, it is a square; if one factor is a number, each end needs one product.
    """
    if a is b:
        return square(a)
    if _is_number(a):
        return times_number(_turned(b, a.low), a)
    if _is_number(b):
        return times_number(_turned(a, b.low), b)
    return products(a, b)


def _extremes(operation: np.ufunc, a: Interval, b: Interval) -> Interval:
    """Bounds of products or quotients: their extremes are at the ends of a and b."""
    # A product is linear in each factor, so its extremes over a rectangle are at corners.
    low, other = operation(a.low, b.low), operation(a.low, b.high)
    is_array = isinstance(low, np.ndarray)  # new, so that it may be changed in place
    high = np.maximum(low, other)
    low = np.minimum(low, other, out=low if is_array else None)
    for end in b:
        value = operation(a.high, end, out=other if is_array else None)
        low = np.minimum(low, value, out=low if is_array else None)
        high = np.maximum(high, value, out=high if is_array else None)
    return _product(low, high, a, b)


def _turned(a: Interval, k: float) -> Interval:
    """The ends of a, ordered such that the first one gives the smallest a·k and a/k."""
    return a if k >= 0 else Interval(a.high, a.low)


def times_number(ends: Interval, k: Interval) -> Interval:
    """Interval of a·k."""
    return _scale_ends(np.multiply, ends, k.low)


def over_number(ends: Interval, k: Interval) -> Interval:
    """Interval of a/k."""
    return _scale_ends(np.divide, ends, k.low)


def _scale_ends(operation: np.ufunc, ends: Interval, k: float | np.ndarray) -> Interval:
    """a·k or a/k for a number k, from the ends of a in the order of `_turned`."""
    first, last = ends
    low, high = operation(first, k), operation(last, k)
    below, above = _product_step(low, lambda: first != 0), _product_step(high, lambda: last != 0)
    return Interval(low - below, high + above)


def square(a: Interval) -> Interval:
    """Interval of a². It is never negative, unlike the product of two independent numbers in the same interval."""
    size = absolute(a)
    # The ends of |a| are in order, so that each bound is the square of one end.
    low, high = size.low * size.low, size.high * size.high
    below, above = _product_step(low, lambda: size.low != 0), _product_step(high, lambda: size.high != 0)
    # The lower bound is not moved below 0, since no square is negative.
    return Interval(np.maximum(low - below, 0.0), high + above)


def div(a: Interval, b: Interval) -> Interval:
    """Interval of a/b, NaN if b may be zero; if one of them is a number, each end needs one quotient."""
    if _is_number(b) and b.low != 0:
        return over_number(_turned(a, b.low), b)
    if _is_number(a):
        return number_over(a, b, _turned(b, -1.0 if a.low >= 0 else 1.0))
    return quotients(a, b)


def products(a: Interval, b: Interval) -> Interval:
    """Interval of a·b for any a and b."""
    return _extremes(np.multiply, a, b)


def quotients(a: Interval, b: Interval) -> Interval:
    """Interval of a/b, NaN if b may be zero."""
    return where((b.low > 0) | (b.high < 0), _extremes(np.divide, a, b))


def number_over(k: Interval, b: Interval, ends: Interval) -> Interval:
    """Interval of k/b, NaN if b may be zero."""
    quotient = _product(k.low / ends.low, k.low / ends.high, k, b)
    return where((b.low > 0) | (b.high < 0), quotient)


def where(defined: np.ndarray, a: Interval) -> Interval:
    """The interval where the function is defined, and NaN bounds elsewhere."""
    if defined.all():
        return a
    return Interval(np.where(defined, a.low, np.nan), np.where(defined, a.high, np.nan))


def absolute(a: Interval) -> Interval:
    """Interval of |a|, exact; its lower bound is 0 if a contains 0."""
    nearest = np.maximum(a.low, -a.high)
    return Interval(np.maximum(nearest, 0.0), np.maximum(-a.low, a.high))


def minimum(a: Interval | Truth, b: Any) -> Any:
    """Interval of min(a, b), or the statement "a and b"."""
    return both(a, b) if isinstance(a, Truth) else smaller(a, b)


def smaller(a: Interval, b: Interval) -> Interval:
    """Interval of min(a, b), exact."""
    return Interval(np.minimum(a.low, b.low), np.minimum(a.high, b.high))


def maximum(a: Interval | Truth, b: Any) -> Any:
    """Interval of max(a, b), or the statement "a or b"."""
    return either(a, b) if isinstance(a, Truth) else larger(a, b)


def larger(a: Interval, b: Interval) -> Interval:
    """Interval of max(a, b), exact."""
    return Interval(np.maximum(a.low, b.low), np.maximum(a.high, b.high))


def sqrt(a: Interval) -> Interval:
    """Interval of √a, NaN if a may be negative; a correctly rounded root errs by half a unit in the last place."""
    return where(a.low >= 0, Interval(_down(np.sqrt(a.low)), _up(np.sqrt(a.high))))


def _elementary_of(bounds: Callable) -> Callable:
    """An operation on intervals from one on bounds; it works block by block, so that its arrays fit in the cache."""

    def compute(*arguments: Interval) -> Interval:
        ends = np.broadcast_arrays(*(end for a in arguments for end in a))
        if ends[0].size <= BLOCK:
            return Interval(*bounds(*ends))
        parts = [bounds(*(end[k : k + BLOCK] for end in ends)) for k in range(0, ends[0].size, BLOCK)]
        low, high = map(np.concatenate, zip(*parts, strict=True))
        return Interval(low, high)

    return compute


_ELEMENTARY = {op: _elementary_of(bounds) for op, bounds in ELEMENTARY.items()}


def power(a: Interval, b: Interval) -> Interval:
    """Interval of aᵇ.

    Constant exponents that are multiples of ½ give products and roots, up to `MOST_PRODUCTS`; for other exponents, and
    a ≥ 0, the logarithm is used.
    """
    if _is_number(b) and (2 * b.low).is_integer() and abs(b.low) <= MOST_PRODUCTS:
        whole = b.low.is_integer()
        # a^{m/2} = (√a)ᵐ: products have tighter bounds than the logarithm, and allow the base 0.
        result = _product_of_many(a if whole else sqrt(a), int(abs(b.low if whole else 2 * b.low)))
        return div(Interval(np.float64(1.0), np.float64(1.0)), result) if b.low < 0 else result
    return _ELEMENTARY["pow"](a, b)


def _product_of_many(a: Interval, count: int) -> Interval:
    """aᶜᵒᵘⁿᵗ, by repeated squaring."""
    result = one(a)
    while count:
        result = mul(result, a) if count % 2 else result
        count //= 2
        a = square(a) if count else a
    return result


def one(a: Interval) -> Interval:
    """The number 1 if a is known, else NaN."""
    # 0·NaN and 0·∞ are NaN, so an unknown base stays unknown.
    return Interval(1.0 + 0.0 * a.low, 1.0 + 0.0 * a.high)


# Non-decreasing functions that are constant between their jumps.


def sign(a: Interval) -> Interval:
    """Interval of the sign of a, −1, 0 or 1 at each end."""
    return Interval(np.sign(a.low), np.sign(a.high))


def floor(a: Interval) -> Interval:
    """Interval of the largest integer ≤ a."""
    return Interval(np.floor(a.low), np.floor(a.high))


def ceil(a: Interval) -> Interval:
    """Interval of the smallest integer ≥ a."""
    return Interval(np.ceil(a.low), np.ceil(a.high))


def nearest(a: Interval) -> Interval:
    """Interval of the nearest integer; ties go to the even one, as in `numpy.rint`."""
    return Interval(np.rint(a.low), np.rint(a.high))


# Statements, and choices between numbers by a statement.


def as_number(a: Interval | Truth) -> Interval:
    """A truth value as the number 0 or 1; an interval is returned unchanged."""
    return number_of(a) if isinstance(a, Truth) else a


def number_of(a: Truth) -> Interval:
    """A statement as a number: 1 if it holds, 0 if it does not, and 0 … 1 if it is undecided."""
    return Interval(np.where(a.must, 1.0, 0.0), np.where(a.may, 1.0, 0.0))


def lt(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """Statement a < b."""
    return less(as_number(a), as_number(b))


def less(a: Interval, b: Interval) -> Truth:
    """Statement a < b; bounds that are NaN leave it undecided."""
    return Truth(a.high < b.low, ~(a.low >= b.high))


def le(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """Statement a ≤ b."""
    return at_most(as_number(a), as_number(b))


def at_most(a: Interval, b: Interval) -> Truth:
    """Statement a ≤ b; bounds that are NaN leave it undecided."""
    return Truth(a.high <= b.low, ~(a.low > b.high))


def eq(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """Statement a = b; a node equals itself wherever it is defined."""
    a, b = as_number(a), as_number(b)
    return equal_to_itself(a) if a is b else equal(a, b)


def equal_to_itself(a: Interval) -> Truth:
    """Statement a = a, the usual test for a missing (NaN) measurement: true wherever a is defined."""
    defined = ~(np.isnan(a.low) & np.isnan(a.high))
    return Truth(defined, np.ones_like(defined))


def equal(a: Interval, b: Interval) -> Truth:
    """Statement a = b: proved if both are the same single number, refuted if their intervals are disjoint."""
    return Truth((a.high <= b.low) & (b.high <= a.low), ~((a.high < b.low) | (b.high < a.low)))


def both(a: Truth, b: Truth) -> Truth:
    """The statement "a and b"."""
    return Truth(a.must & b.must, a.may & b.may)


def either(a: Truth, b: Truth) -> Truth:
    """The statement "a or b"."""
    return Truth(a.must | b.must, a.may | b.may)


def opposite(a: Truth) -> Truth:
    # "Not a" is proved where a is refuted, and possible where a is not proved.
    """The statement "not a"."""
    return Truth(~a.may, ~a.must)


def is_finite(a: Interval) -> Truth:
    """Statement that a number is finite: proved if its bounds are finite, never refuted."""
    known = np.isfinite(a.low) & np.isfinite(a.high)
    return Truth(known, np.ones_like(known))


def select(p: Truth, a: Interval | Truth, b: Any) -> Any:
    """Values of a if p holds, of b if it does not, and the hull of both if p is undecided."""
    if isinstance(a, Truth):
        # If p is undecided, "a and b" still implies the result; the other two terms do not cover this.
        return either(both(a, b), either(both(p, a), both(opposite(p), b)))
    return chosen(p, a, b)


def chosen(p: Truth, a: Interval, b: Interval) -> Interval:
    """Interval of `p ? a : b`, the hull of a and b if p is undecided."""
    result = Interval(np.where(p.must, a.low, b.low), np.where(p.must, a.high, b.high))
    undecided = p.may & ~p.must
    if not undecided.any():
        return result
    low, high = np.minimum(a.low, b.low), np.maximum(a.high, b.high)
    return Interval(np.where(undecided, low, result.low), np.where(undecided, high, result.high))


def kinked(a: Interval, b: Interval, x: Interval, y: Interval) -> Interval:
    """Interval of a derivative at a kink: x where a < b, y where b < a, and the hull of both if a = b is
    possible.
    """
    return chosen(Truth(a.high < b.low, ~(a.low > b.high)), x, y)


def stumpff(k: Interval, x: Interval) -> Interval:
    """Interval of Stumpff's function c_k(x), NaN if x may be below −1.

    Args:
        k: Order, a number as an interval.
        x: Interval of the argument.
    """
    return Interval(*stumpff_bounds(stumpff_coefficients(int(k.low)), x.low, x.high))


INTERVALS: Domain = {
    "constant": constant,
    "add": add,
    "sub": sub,
    "mul": mul,
    "div": div,
    "neg": neg,
    "abs": absolute,
    "sign": sign,
    "floor": floor,
    "ceil": ceil,
    "round": nearest,
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
