"""Defines the checker's Taylor models: numbers on boxes as quadratic polynomials with a radius for the remainder.

The models rely on IEEE `+ − × ÷ √` and on exact operations; no elementary function of a library is trusted.

Source: Makino & Berz 2003, Taylor models and other validated functional inclusion methods, International Journal of
Pure and Applied Mathematics 4(4).
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

ROUND, TINY = 2.0**-40, 2.0**-990
"""Larger than the relative rounding error of a few hundred operations, and than all underflows in them."""
LN2 = float.fromhex("0x1.62e42fefa38p-1"), float.fromhex("0x1.ef35793c7673p-45")
QUARTER = float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a626331p-34")
"""log 2 and π/2, each in two parts: products of the first part with integers below 2000 are exact."""


class UndecidedError(ArithmeticError):
    """Raised if a branch differs between boxes, or is undecided on one of them.

    Example:
        >>> from scalargraph.proofs.checker._taylor import decided, number
        >>> decided(number(0.5, 0.5))  # a truth value in [0, 1]
        Traceback (most recent call last):
        scalargraph.proofs.checker._taylor.UndecidedError: a branch is not decided
    """


class Taylor:
    """A number on each of B boxes: within `radius` of `Σ terms[k][m] eₘ`, eₘ of degree k in variables εᵢ in [−1, 1].

    e₀ = 1, eᵢ = εᵢ, eᵢⱼ = εᵢεⱼ, eᵢᵢ = 2εᵢ² − 1, so that each eₘ but e₀ is in [−1, 1].

    Args:
        terms: Coefficients of degree 0, 1 and 2: a dictionary each, from the tuple m of variables, in ascending order,
            to an array (B,) or a number.
        radius: Bound (B,) of the deviation from the polynomial, roundings included.

    Attributes:
        middle: Constant term.
        sizes: Sums of absolute values of the coefficients of each degree.
        away: Largest distance from `middle`, rounded up.
        compared: (a, b), if the number is the truth value of `a < b` or of its negation; None otherwise.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs.checker._taylor import Taylor
        >>> x = Taylor([{(): np.array([1.0])}, {(0,): np.array([0.5])}, {}], 0.0)  # 1 + ε/2
        >>> y = x * x - x  # ε/2 + ε²/4, and ε² is ½ ± ½
        >>> y.middle.tolist(), y.away.round(6).tolist()
        ([0.125], [0.625])
    """

    compared: "tuple[Taylor, Taylor] | None" = None

    def __init__(self, terms: Sequence[dict], radius: np.ndarray | float):
        # TINY covers underflow in the operation that made this number, for which relative bounds do not hold.
        self.terms, self.middle, self.radius = terms, terms[0][()], radius + TINY
        self.sizes = [sum(map(abs, part.values()), 0.0) for part in terms]
        # Rounded up by ROUND, which exceeds the error of the sums, so that the range is not too small.
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


# Every operation is computed once for the current boxes, and cached by its arguments.


@functools.cache
def _sum(a: Taylor, b: Taylor) -> Taylor:
    if ZERO in (a, b):
        return b if a is ZERO else a
    terms = [{m: s.get(m, 0.0) + t.get(m, 0.0) for m in s | t} for s, t in zip(a.terms, b.terms, strict=True)]
    # Each sum of coefficients errs by less than ROUND times their sizes. This goes into the radius, which is rounded
    # up.
    return Taylor(terms, (a.radius + b.radius + ROUND * sum(a.sizes + b.sizes)) * (1 + ROUND))


@functools.cache
def _minus(a: Taylor) -> Taylor:
    # Negation is exact in IEEE arithmetic, so the radius stays.
    return a if a is ZERO else Taylor([{m: -t for m, t in part.items()} for part in a.terms], a.radius)


@functools.cache
def _product(a: Taylor, b: Taylor) -> Taylor:
    if ZERO in (a, b) or ONE in (a, b):
        return ZERO if ZERO in (a, b) else b if a is ONE else a
    terms, (_, linear_a, quadratic_a), (_, linear_b, quadratic_b) = [{}, {}, {}], a.sizes, b.sizes
    for i, j in ((0, 0), (0, 1), (1, 0), (0, 2), (1, 1), (2, 0)):
        into = terms[i + j]
        for (m, s), (n, t) in itertools.product(a.terms[i].items(), b.terms[j].items()):
            key, part = m + n if m < n else n + m, s * t  # sorted, as each has at most one variable
            if m == n and m:  # the square of a variable lies in ½ ± ½
                part = part / 2
                terms[0][()] = terms[0][()] + part
            into[key] = into[key] + part if key in into else part
    # On the box |a| ≤ one + a.radius, and likewise for b. The radius bounds (one + rₐ)(two + r_b) − one·two, the orders
    # above two, and the roundings of all coefficients; the sum is then rounded up.
    one, two = sum(a.sizes), sum(b.sizes)
    cut = linear_a * quadratic_b + quadratic_a * (linear_b + quadratic_b)  # terms of third and fourth order
    product = Taylor(terms, (cut + a.radius * (two + b.radius) + one * b.radius + ROUND * one * two) * (1 + ROUND))
    ranges = np.asarray((linear_a + quadratic_a + linear_b + quadratic_b == 0) & (a.radius + b.radius > 4 * TINY))
    if not ranges.any():
        return product
    # Ranges without terms, such as the hull of both sides of a kink, are multiplied as intervals.
    ends = [(a.middle + s * a.away) * (b.middle + t * b.away) for s in (-1, 1) for t in (-1, 1)]
    low, high = functools.reduce(np.minimum, ends), functools.reduce(np.maximum, ends)
    # The products at the ends and their middle are rounded, each by less than ROUND times its size.
    hull = number(low / 2 + high / 2, (high - low) / 2 + ROUND * (abs(low) + abs(high)))
    return narrower(product, hull, ranges)


def number(middle: np.ndarray | float, radius: np.ndarray | float = 0.0) -> Taylor:
    """A number between `middle − radius` and `middle + radius`, without terms."""
    return Taylor([{(): middle}, {}, {}], radius)


def narrower(a: Taylor, b: Taylor, among: np.ndarray | bool) -> Taylor:
    """The narrower of two enclosures of the same number, box by box."""
    better = among & np.asarray(b.away < a.away)
    if not better.any():
        return a
    terms = [{m: np.where(better, b.middle if m == () else 0.0, t) for m, t in part.items()} for part in a.terms]
    return Taylor(terms, np.where(better, b.radius, a.radius))


ZERO, ONE, HALF, RIGHT = number(0.0), number(1.0), number(0.5), number(math.pi / 2, ROUND)


@functools.cache
def exact(x: float | int) -> Taylor:
    """A known number; its radius covers underflow only."""
    return ZERO if x == 0 else ONE if x == 1 else number(np.float64(x))


def forget() -> None:
    """Clear the caches, which hold results for the current boxes only."""
    for known in (_sum, _minus, _product, curve):
        known.cache_clear()
    open_choices.clear()


# Elementary functions.


def points(name: str, x: np.ndarray) -> np.ndarray:
    """A function at points. Its relative error is below ROUND/2; for sine and logarithm the absolute error is."""
    if name in ("inv", "sqrt"):
        return 1 / x if name == "inv" else np.sqrt(x)
    if name.startswith("stumpff"):
        k = int(name[7:])
        # 25 terms: for |x| below 9.8 the next one is below 9.8²⁵/50! < 1e-39.
        return np.asarray(functools.reduce(lambda s, j: 1 / math.factorial(2 * j + k) - x * s, range(24, -1, -1), 0.0))
    if name in ("atan", "log"):  # the arc tangent by halving the angle; the logarithm by square roots, towards 1
        for _ in range(3 if name == "atan" else 10):
            x = x / (1 + np.sqrt(1 + x * x)) if name == "atan" else np.sqrt(x)
        x = x if name == "atan" else (x - 1) / (x + 1)
        square, scale = (-x * x, 8) if name == "atan" else (x * x, 2048)
        # The series are those of the arc tangent, times 8 for three halvings of the angle, and of the inverse
        # hyperbolic tangent: log y = 2 artanh((y − 1)/(y + 1)), times 2¹⁰ for ten square roots.
        # Terms up to x⁴⁵, for |x| ≤ tan(π/16) = 0.2 and tanh(745/2048) = 0.35, omit less than 2e-23 of the sum.
        # Ten roots leave an error of 2u, which the factor 2048/2 makes 2e-13: an absolute error below ROUND/2.
        return scale * x * functools.reduce(lambda total, k: 1 / k + square * total, range(45, 0, -2), 0.0)
    unit, turn = (QUARTER, 1j) if name == "sin" else (LN2, 1)
    n = np.rint(x / unit[0])
    # The first part of the constant ends in zero bits, so n times it is exact, and the cancellation loses nothing.
    r = ((x - n * unit[0]) - n * unit[1]) * turn
    # |r| ≤ π/4, so the first omitted term is below 0.79²³/23! = 2e-25.
    value = functools.reduce(lambda total, k: 1 + r / k * total, range(22, 0, -1), 1.0)
    if name == "exp":
        return np.ldexp(value, n.astype(int))
    # sin(nπ/2 + r) is sin r, cos r, −sin r, −cos r for n = 0, 1, 2, 3 modulo 4.
    return np.where(n % 2 == 0, value.imag, value.real) * np.where(n % 4 < 2, 1, -1)


def bounds(name: str, a: Taylor) -> Taylor:
    """A function over the range of a number, from its values at the ends; for the sine, from that at the middle."""
    if name.startswith("stumpff"):
        low, high = a.middle - a.away, a.middle + a.away
        # c_k decreases on −1 < x < 9.8 < π², so its range lies between its values at the ends.
        ends = [points(name, np.where((low > -1) & (high < 9.8), end, np.nan)) for end in (low, high)]
        half, error = abs(ends[1] - ends[0]) / 2, ROUND / math.factorial(int(name[7:]))
        return number(ends[0] / 2 + ends[1] / 2, half + error)
    # Large arguments lose digits in the reduction by multiples of π/2 or log 2, so they are refused.
    known = abs(a.middle) + a.away < (1e3 if name in ("sin", "exp") else 1e150)
    known &= (name not in ("inv", "log")) | (abs(a.middle) > a.away)
    x = np.where(known, [a.middle - a.away, a.middle, a.middle + a.away], np.nan)
    low, middle, high = points(name, x)
    # `points` errs by ROUND/2 relative to each end; for sine and logarithm by an absolute ROUND/2.
    error = ROUND * (abs(low) + abs(high) + (name in ("sin", "log")))
    # The sine is not monotonic, but its slope is at most one: it stays within `away` of its value at the middle.
    return number(middle, a.away + error) if name == "sin" else number(low / 2 + high / 2, abs(high - low) / 2 + error)


def _bell(a: Taylor) -> Taylor:
    """1/(1 + a²) over the range of a."""
    smallest, largest = np.maximum(abs(a.middle) - a.away, 0.0), abs(a.middle) + a.away
    low, high = 1 / (1 + largest * largest), 1 / (1 + smallest * smallest)
    # ROUND·high exceeds the errors of both ends, since 1/(1 + a²) is positive and high is the larger
    # end.
    return number(low / 2 + high / 2, (high - low) / 2 + ROUND * high)


CURVES: dict[str, Callable[[Taylor, Taylor], tuple[Taylor, Taylor]]] = {
    "inv": lambda x, f: (-(f * f), f * f * f),
    "sqrt": lambda x, f: (HALF * (g := bounds("inv", f)), -(HALF * HALF * HALF * g * g * g)),
    "exp": lambda x, f: (f, HALF * f),
    "log": lambda x, f: (g := bounds("inv", x), -(HALF * g * g)),
    "atan": lambda x, f: (g := _bell(x), -(x * g * g)),
    "sin": lambda x, f: (bounds("sin", x + RIGHT), -(HALF * f)),
}
"""First derivative, and half of the second, from x and the value f."""


def _stumpff(k: int) -> Callable[[Taylor, Taylor], tuple[Taylor, Taylor]]:
    """The derivatives by `c_k' = (k c_{k+2} − c_{k+1})/2`, applied twice."""

    def slopes(x: Taylor, f: Taylor) -> tuple[Taylor, Taylor]:
        one, two, three, four = (bounds(f"stumpff{k + i}", x) for i in (1, 2, 3, 4))
        bend = exact(k * (k + 2)) * four - exact(2 * k + 1) * three + two
        return HALF * (exact(k) * two - one), exact(0.125) * bend

    return slopes


@functools.cache
def curve(name: str, a: Taylor) -> Taylor:
    """A function by Taylor's formula `f(c) + f'(c) d + ½ f''(ξ) d²`, with c the middle, d = x − c, ξ in the range."""
    at, around = number(a.middle), number(a.middle, a.away)
    value, deviation = bounds(name, at), Taylor([{(): 0.0 * a.middle}, *a.terms[1:]], a.radius)
    slopes = CURVES[name] if name in CURVES else _stumpff(int(name[7:]))
    whole = bounds(name, around)
    # `slopes` gives half of the second derivative; over the whole range it is the Lagrange remainder.
    result = value + slopes(at, value)[0] * deviation + slopes(around, whole)[1] * (deviation * deviation)
    # A model with terms is kept even if the plain range is narrower: its terms show which variable to halve.
    return narrower(result, whole, np.asarray(a.sizes[1] + a.sizes[2] == 0))


# Branches. A truth value that is equal on all boxes is a `bool`, any other a number: 1, 0, or [0, 1] if undecided.

open_choices: list[tuple[Taylor, np.ndarray]] = []
"""For each choice that some current boxes leave open: the difference that was compared, and a mask of these boxes."""


def less(a: Taylor, b: Taylor) -> bool | Taylor:
    """Whether a < b. It is decided only if they are strictly apart, since at a = b there may be a kink."""
    gap = a - b
    # The test is strict and `away` is rounded up: a sign counts as known only if zero lies outside the range.
    known = abs(gap.middle) > gap.away
    value = np.where(known, 1.0 * (gap.middle < 0), 0.5)
    if np.all(known) and np.all(value == np.max(value)):
        return bool(np.max(value))
    # ½ ± ½ is the range [0, 1] of an open truth value.
    truth = number(value, np.where(known, 0.0, 0.5))
    truth.compared = a, b
    return truth


def choose(which: bool | Taylor, a: Taylor, b: Taylor) -> Taylor:
    """a if a truth value is true, b if it is false, and the hull of both if it is undecided.

    Args:
        which: The truth value.
        a: The number if it is true.
        b: The number if it is false.
    """
    if isinstance(which, bool):
        return a if which else b
    yes, no = which.middle - which.away > 0.5, which.middle + which.away < 0.5
    if which.compared is not None:
        open_choices.append((which.compared[0] - which.compared[1], ~(yes | no)))
    low = np.minimum(a.middle - a.away, b.middle - b.away)
    high = np.maximum(a.middle + a.away, b.middle + b.away)
    keys = [s | t for s, t in zip(a.terms, b.terms, strict=True)]
    terms = [
        {m: np.where(yes, s.get(m, 0.0), np.where(no, t.get(m, 0.0), 0.0)) for m in all_}
        for s, t, all_ in zip(a.terms, b.terms, keys, strict=True)
    ]
    terms[0][()] = np.where(yes | no, terms[0][()], low / 2 + high / 2)
    # The ends and the middle of the hull are rounded, by less than ROUND times the sizes of the ends.
    between = (high - low) / 2 + ROUND * (abs(low) + abs(high))
    return Taylor(terms, np.where(yes, a.radius, np.where(no, b.radius, between)))


def decided(truth: bool | Taylor) -> bool:
    """Return a truth value as a `bool`; it must be the same on all boxes."""
    if isinstance(truth, Taylor):
        raise UndecidedError("a branch is not decided")
    return truth


def floor(a: Taylor) -> Taylor:
    """The largest integer below: known on a box if it has one value there, otherwise a range of integers."""
    # Both ends are moved outward: 3 − 1e-18 rounds to 3, whose floor differs from the number's. Constants are exact.
    away = np.where(a.away > 8 * TINY, a.away + ROUND * (abs(a.middle) + a.away), 0.0)
    low, high = np.floor(a.middle - away), np.floor(a.middle + away)
    if np.all(low == high) and np.all(low == np.max(low)):
        return exact(float(np.max(low)))
    return number(low / 2 + high / 2, (high - low) / 2)


def finite(a: Taylor) -> bool | Taylor:
    """Whether a number is finite: known to be true far from overflow, and never known to be false."""
    known = abs(a.middle) + a.away < 1e150
    return True if np.all(known) else number(np.where(known, 1.0, 0.5), np.where(known, 0.0, 0.5))


def unequal(a: Taylor, b: Taylor) -> bool | Taylor:
    """Whether a ≠ b. For a and a itself, the test for a missing value (NaN), it is known to be false."""
    known = less(a, b)
    if a is b or isinstance(known, bool):
        return a is not b
    return number(np.where(known.away < 0.25, 1.0, 0.5), np.where(known.away < 0.25, 0.0, 0.5))


def opposite(truth: bool | Taylor) -> bool | Taylor:
    """The negation of a truth value, undecided on the same boxes."""
    if not isinstance(truth, Taylor):
        return not truth
    negation = ONE - truth
    negation.compared = truth.compared
    return negation


def continuous(which: bool | Taylor, a: Taylor, b: Taylor) -> bool:
    """Whether a choice between a and b is continuous: it is a minimum, a maximum or an absolute value.

    Args:
        which: The truth value that chooses.
        a: The number if it is true.
        b: The number if it is false.
    """
    if isinstance(which, bool) or which.compared is None:
        return isinstance(which, bool)
    one, other = which.compared
    return {a, b} == {one, other} or (ZERO in (one, other) and (a is -b or b is -a) and bool({a, b} & {one, other}))
