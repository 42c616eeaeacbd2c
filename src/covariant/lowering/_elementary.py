"""Elementary functions of intervals, from sums, products, quotients and roots alone: no library's values are trusted.

Each function is computed at the ends of the interval, in doubles, with a bound on the relative error which is proved
beforehand: the argument is reduced without error, or with its error carried along, the Taylor polynomial of the
reduced function has a remainder known in closed form, and Horner's scheme rounds by known amounts (N. J. Higham,
Accuracy and Stability of Numerical Algorithms, 2002, section 5.1). The reductions are those of J.-M. Muller,
Elementary Functions, 2016. The bounds are in units of u = 2⁻⁵³; where a result may underflow, the smallest double is
added to them.

Trusted besides IEEE arithmetic is what is exact: comparisons, rounding to whole numbers, moving bits.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

U = 2.0**-53
"""The largest relative error of one rounding."""
TINY = 5e-324
"""The smallest double: no rounding that underflows errs by more."""
LARGEST = np.finfo(float).max
HUGE = LARGEST * (1 - 2.0**-40)
"""A bound of what overflows, for all errors here."""
MAGIC = 1.5 * 2.0**52
"""Added to a number well below 2⁵¹, leaves the nearest whole number in its last bits."""

# Words of a few bits each, so that their products with whole numbers of 11 or 20 bits are exact; the last has 53.
LN2_HIGH, LN2_LOW = float.fromhex("0x1.62e42fefa38p-1"), float.fromhex("0x1.ef35793c7673p-45")
HALF_PI = tuple(
    float.fromhex(word) for word in ("0x1.921fb544p+0", "0x1.0b4611a6p-34", "0x1.3198a2ep-69", "0x1.b839a252049c1p-104")
)
HALF_PI_HIGH, HALF_PI_LOW = float.fromhex("0x1.921fb54442d18p+0"), float.fromhex("0x1.1a62633145c07p-54")
ATAN_HIGH = np.array(
    [float.fromhex(f"0x{word}") for word in ("0p+0", "1.f5b75f92c80ddp-3", "1.dac670561bb4fp-2")]
    + [float.fromhex(f"0x{word}") for word in ("1.4978fa3269ee1p-1", "1.921fb54442d18p+0")]
    + [math.nan] * 3
)
"""Arc tangents of 0, ¼, ½, ¾ and 1, to the nearest double; then what NaN is looked up as."""
ATAN_LOW = np.array(
    [float.fromhex(f"0x{word}") for word in ("0p+0", "1.8ab6e3cf7afbdp-57", "1.a2b7f222f65e2p-56")]
    + [float.fromhex(f"0x{word}") for word in ("1.2419a87f2a458p-56", "1.1a62633145c07p-55")]
    + [math.nan] * 3
)
"""What is left of them."""
ATAN_HIGH[4] = HALF_PI_HIGH / 2

# Taylor coefficients, highest power first.
EXP = [1 / math.factorial(n) for n in range(13, 1, -1)]
"""(exp r - 1 - r)/r², up to r¹¹."""
LOG = [2 / (2 * i + 1) for i in range(10, 0, -1)]
"""(2 artanh s - 2s)/(s z) in z = s², up to z⁹."""
SIN = [(-1) ** i / math.factorial(2 * i + 3) for i in range(7, -1, -1)]
"""(r - sin r)/r³ in r², up to r¹⁴."""
COS = [(-1) ** i / math.factorial(2 * i + 4) for i in range(6, -1, -1)]
"""(cos r - 1 + r²/2)/r⁴ in r², up to r¹²."""
ATAN = [(-1) ** i / (2 * i + 3) for i in range(9, -1, -1)]
"""(z - atan z)/z³ in z², up to z¹⁸."""


def horner(coefficients: Sequence[float], x: Any) -> Any:
    """A polynomial from its coefficients, highest power first."""
    total = x * coefficients[0]
    total += coefficients[1]
    for coefficient in coefficients[2:]:
        total *= x
        total += coefficient
    return total


def _whole(x: Any) -> tuple[Any, Any]:
    """The nearest whole number, as a double and in the last bits of an integer."""
    shifted = x + MAGIC
    return shifted - MAGIC, shifted.view(np.int64)


def _scaled(x: Any, k: Any) -> Any:
    """x·2ᵏ for whole |k| ≤ 2000, in two products of which one may round, by less than the smallest double."""
    half, bits = _whole(0.5 * k)
    x = x * ((bits + 1023) << 52).view(float)
    x *= ((_whole(k - half)[1] + 1023) << 52).view(float)
    return x


# Exponential functions. x = k ln 2 + r with |r| ≤ 0.34658; the difference x - k·LN2_HIGH is exact.


def exp_reduced(r: Any) -> Any:
    """exp r - 1 for |r| ≤ 0.34658. The remainder is below r¹⁴/14!·1.03, that is 0.12 u |r|."""
    return r + r * r * horner(EXP, r)


def _exp_parts(x: Any) -> tuple[Any, Any]:
    k, _ = _whole(x * (1 / math.log(2)))
    return k, exp_reduced((x - k * LN2_HIGH) - k * LN2_LOW)


def exp(x: Any, shift: float = 0.0) -> Any:
    """exp x · 2ˢʰⁱᶠᵗ within 3 u: infinite where it overflows."""
    k, q = _exp_parts(np.minimum(np.maximum(x, -746.0), 712.0))
    return _scaled(1.0 + q, k + shift)


def expm1(x: Any) -> Any:
    """exp x - 1 within 6 u for x ≥ -40, where it is -1 to the nearest double; infinite where it overflows."""
    k, q = _exp_parts(np.minimum(np.maximum(x, -40.0), 712.0))
    return _scaled((1.0 - _scaled(1.0, -k)) + q, k)


def sinh(x: Any) -> Any:
    """Within 9 u: (q + q/(q + 1))/2 for q = exp |x| - 1, or half of the exponential function, for |x| > 20."""
    size = np.abs(x)
    q = expm1(np.minimum(size, 20.0))
    return np.copysign(np.where(size > 20.0, exp(size, -1.0), 0.5 * (q + q / (q + 1.0))), x)


def cosh(x: Any) -> Any:
    """Within 5 u."""
    half = exp(np.abs(x), -1.0)
    return half + 0.25 / half


def tanh(x: Any) -> Any:
    """q/(q + 2) for q = exp 2|x| - 1, within 9 u. From 22 on it is 1 within that."""
    q = expm1(2.0 * np.minimum(np.abs(x), 22.0))
    return np.copysign(q / (q + 2.0), x)


# Logarithms. x = 2ᵏ m with √½ ≤ m < √2, and log m = 2 artanh s for s = f/(2 + f), f = m - 1.


def log_reduced(f: Any, rest: Any) -> Any:
    """log(1 + f) - rest for -0.2929 ≤ f ≤ 0.4143. The remainder is below s²¹/21·1.04, below 0.01 u of the logarithm.

    It is f - s (f - R), since s (2 + f) = f.
    """
    s = f / (2.0 + f)
    z = s * s
    return f - (s * (f - z * horner(LOG, z)) + rest)


def _mantissa(x: Any) -> tuple[Any, Any]:
    """k and m - 1 of a positive number, both exact."""
    low = x < 2.0**-1022
    bits = np.where(low, x * 2.0**54, x).view(np.int64) + (0x3FF0000000000000 - 0x3FE6A09E00000000)
    k = (bits >> 52) - 0x3FF - 54 * low
    m = ((bits & 0x000FFFFFFFFFFFFF) + 0x3FE6A09E00000000).view(float)
    return k.astype(float), m - 1.0


def log(x: Any, shift: float = 0.0) -> Any:
    """log x + shift·log 2 within 4 u, for x ≥ 0."""
    k, f = _mantissa(x)
    k += shift
    return _at_ends(x, log_reduced(f, -k * LN2_LOW) + k * LN2_HIGH)


def log1p(x: Any) -> Any:
    """log(1 + x) within 4 u, for x ≥ -1. What 1 + x rounds off is exact, and added as d/(1 + x)."""
    total = 1.0 + x
    part = total - x
    off = (1.0 - part) + (x - (total - part))
    k, f = _mantissa(total)
    near = (x > -0.2928) & (x < 0.4142)
    k, f = np.where(near, 0.0, k), np.where(near, x, f)
    rest = np.where(near, 0.0, off / total + k * LN2_LOW)
    return _at_ends(total, log_reduced(f, -rest) + k * LN2_HIGH)


def _at_ends(x: Any, value: Any) -> Any:
    """The logarithm, also of 0 and of infinity; NaN below."""
    usual = (x > 0) & (x < np.inf)
    return value if usual.all() else np.where(usual, value, np.where(x == 0, -np.inf, np.where(x > 0, x, np.nan)))


def asinh(x: Any) -> Any:
    """log1p(a + a²/(1 + √(1 + a²))) for a = |x|, or log 2a where a > 2²⁸; within 9 u."""
    a = np.abs(x)
    b = np.minimum(a, 2.0**28)
    return np.copysign(np.where(a > b, log(a, 1.0), log1p(b + b * b / (1.0 + np.sqrt(1.0 + b * b)))), x)


def acosh(x: Any) -> Any:
    """log1p(t + √(t (t + 2))) for t = x - 1, or log 2x where x > 2²⁸; within 9 u."""
    t = np.minimum(x, 2.0**28) - 1.0
    return np.where(x > 2.0**28, log(x, 1.0), log1p(t + np.sqrt(t * (t + 2.0))))


def atanh(x: Any) -> Any:
    """½ log1p(2a/(1 - a)) for a = |x|, within 7 u."""
    a = np.abs(x)
    return np.copysign(0.5 * log1p(2.0 * a / (1.0 - a)), x)


# Inverse trigonometric functions.


def atan_reduced(t: Any) -> Any:
    """atan t for 0 ≤ t ≤ 1, within 4 u: atan c + atan((t - c)/(1 + c t)) for a near c among 0, ¼, ½, ¾ and 1.

    The difference t - c is exact; the remainder is below z²³/23 for |z| ≤ 0.1875, that is 0.05 u of the result.
    """
    j, bits = _whole(4.0 * t - 0.25)
    index, c = bits & 7, 0.25 * j
    z = (t - c) / (1.0 + c * t)
    w = z * z
    return ATAN_HIGH[index] + (ATAN_LOW[index] + (z - z * w * horner(ATAN, w)))


def angle(y: Any, x: Any) -> Any:
    """The angle of (x, y) for y ≥ 0, within 8 u; 0 at the origin. Within 6 u where x ≥ 0 and the quotient is exact."""
    size = np.abs(x)
    t = np.minimum(y, size) / np.maximum(y, size)
    theta = atan_reduced(np.where((y == 0) & (size == 0), 0.0, t))
    theta = np.where(y > size, HALF_PI_HIGH - (theta - HALF_PI_LOW), theta)
    return np.where(x < 0, 2 * HALF_PI_HIGH - (theta - 2 * HALF_PI_LOW), theta)


def atan(x: Any) -> Any:
    """Within 7 u."""
    return np.copysign(angle(np.abs(x), np.ones_like(x)), x)


def asin(x: Any) -> Any:
    """The angle of (√((1 - x)(1 + x)), x), within 10 u."""
    return np.copysign(angle(np.abs(x), np.sqrt((1.0 - x) * (1.0 + x))), x)


def acos(x: Any) -> Any:
    """Twice the angle whose tangent is √((1 - x)/(1 + x)), within 10 u."""
    return 2.0 * angle(np.sqrt(1.0 - x), np.sqrt(1.0 + x))


def atan2(y: Any, x: Any) -> Any:
    """Within 10 u; π where y is 0 and x negative."""
    return np.copysign(angle(np.abs(y), x), y + 0.0)


# Trigonometric functions. x = k π/2 + r with |r| ≤ 0.7854, r in two doubles.

MOST_QUARTERS = 2.0**20
"""Quarter turns an argument may have; then the words of π/2 are used up."""


def reduced(x: Any) -> tuple[Any, Any, Any, Any]:
    """k, its bits, and r as the sum of two doubles, within |k| 2⁻¹⁴⁸ and a part in 2¹⁰³ of r, for |k| ≤ 2²⁰."""
    k, bits = _whole(x * (2 / math.pi))
    first = x - k * HALF_PI[0]
    second, lost = _difference(first, k * HALF_PI[1])
    third, more = _difference(second, k * HALF_PI[2])
    rest = (lost + more) - k * HALF_PI[3]
    r = third + rest
    return k, bits, r, rest - (r - third)


def _difference(a: Any, b: Any) -> tuple[Any, Any]:
    """a - b rounded, and what that lost, exactly (D. E. Knuth, The Art of Computer Programming 2, 4.2.2)."""
    c = a - b
    part = c - a
    return c, (a - (c - part)) - (b + part)


def sin_cos_reduced(r: Any, rest: Any) -> tuple[Any, Any]:
    """sin and cos of r + rest, |r| ≤ 0.7854, each within 3 u. Remainders: r¹⁹/19! and r¹⁸/18!, below 0.03 u."""
    z = r * r
    half = 0.5 * z
    sine = r - (z * r * horner(SIN, z) - rest * (1.0 - half))
    cosine = 1.0 - (half - (z * z * horner(COS, z) - r * rest))
    return sine, cosine


def _wave(quarter: int) -> Callable:
    """Bounds of sin(x + quarter·π/2)."""

    def bounds(low: Any, high: Any) -> tuple[Any, Any]:
        x = np.stack([low, high])
        k, bits, r, rest = reduced(x)
        sine, cosine = sin_cos_reduced(r, rest)
        bits = bits + quarter
        value = np.where((bits & 1).astype(bool), cosine, sine)
        value = (value.view(np.int64) ^ ((bits & 2) << 62)).view(float)
        error = 2.0**-148 * np.abs(k)
        step = np.abs(value) * (5 * U) + np.minimum(np.abs(value), TINY) + error
        # Multiples k π/2 of a quarter turn within the interval, or so near to it that this is not known.
        first = np.where(r[0] > error[0], k[0] + 1, k[0]) + quarter
        last = np.where(r[1] < -error[1], k[1] - 1, k[1]) + quarter
        lowest, highest = np.minimum(*(value - step)), np.maximum(*(value + step))
        lowest = np.where(_within(first, last, 3, 4), -1.0, np.maximum(lowest, -1.0))
        highest = np.where(_within(first, last, 1, 4), 1.0, np.minimum(highest, 1.0))
        far = np.abs(x).max(axis=0) > 1.5 * MOST_QUARTERS
        if far.any():
            lowest, highest = np.where(far, -1.0, lowest), np.where(far, 1.0, highest)
        return lowest, highest

    return bounds


def _within(first: Any, last: Any, rest: int, period: int) -> Any:
    """Whether there is a whole number between two that leaves this rest."""
    return np.floor((last - rest) / period) * period + rest >= first


def _tan(low: Any, high: Any) -> tuple[Any, Any]:
    x = np.stack([low, high])
    k, bits, r, rest = reduced(x)
    sine, cosine = sin_cos_reduced(r, rest)
    odd = (bits & 1).astype(bool)
    value = np.where(odd, -cosine, sine) / np.where(odd, sine, cosine)
    error = 2.0**-148 * np.abs(k)
    small = np.minimum(np.abs(sine), np.abs(cosine))
    step = np.abs(value) * (10 * U + 4.0 * error / small) + np.minimum(np.abs(value), TINY)
    first = np.where(r[0] > error[0], k[0] + 1, k[0])
    last = np.where(r[1] < -error[1], k[1] - 1, k[1])
    near = (small < 2.0**20 * error).any(axis=0)
    unknown = near | _within(first, last, 1, 2) | ~(np.abs(x).max(axis=0) <= 1.5 * MOST_QUARTERS)
    return np.where(unknown, np.nan, value[0] - step[0]), np.where(unknown, np.nan, value[1] + step[1])


def _cbrt(low: Any, high: Any) -> tuple[Any, Any]:
    """NumPy's root is a guess: bounds near it are taken where their cubes are on the right sides."""
    x = np.stack([low, high])
    size = np.abs(x)
    third = np.where(size < 2.0**-700, 2.0**-100, np.where(size > 2.0**700, 2.0**100, 1.0))
    size = size * (1 / third) * (1 / third) * (1 / third)
    guess = np.cbrt(size)
    below, above = guess * (1 - 8 * U), guess * (1 + 8 * U)
    right = (below * below * below * (1 + 8 * U) <= size) & (above * above * above * (1 - 8 * U) >= size)
    below, above = np.where(right, below, np.nan) * third, np.where(right, above, np.nan) * third
    return np.where(x[0] > 0, below[0], -above[0]), np.where(x[1] > 0, above[1], -below[1])


def _rising(
    point: Callable[[Any], Any],
    units: float,
    floor: float = -np.inf,
    ceiling: float = np.inf,
    inside: Callable | None = None,
) -> Callable:
    """Bounds of a function that rises, from its values at the ends, which are right within some u.

    `inside(low, high)` tells where the function is defined on the whole interval; nothing is known elsewhere.
    """
    relative = (units + 2) * U

    def bounds(low: Any, high: Any) -> tuple[Any, Any]:
        value = point(np.stack([low, high]))
        step = np.abs(value)
        step = step * relative + np.minimum(step, 2 * TINY)
        # A value that overflows is still known to be large.
        lowest = np.where(value[0] > LARGEST, HUGE, value[0] - step[0])
        highest = np.where(value[1] < -LARGEST, -HUGE, value[1] + step[1])
        if floor > -np.inf or ceiling < np.inf:
            lowest, highest = np.maximum(lowest, floor), np.minimum(highest, ceiling)
        if inside is not None and not (defined := inside(low, high)).all():
            lowest, highest = np.where(defined, lowest, np.nan), np.where(defined, highest, np.nan)
        return lowest, highest

    return bounds


def _exp(low: Any, high: Any) -> tuple[Any, Any]:
    value = exp(np.stack([low, high]))
    step = value * (5 * U) + 2 * TINY
    return np.maximum(np.where(value[0] > LARGEST, HUGE, value[0] - step[0]), 0.0), value[1] + step[1]


def _atan2(y_low: Any, y_high: Any, x_low: Any, x_high: Any) -> tuple[Any, Any]:
    """The angle has no extremum inside, nor within a side: its bounds are those of the corners.

    Except where it jumps, across the negative half-axis: there they are ±π.
    """
    y_low, y_high, x_low, x_high = np.broadcast_arrays(y_low, y_high, x_low, x_high)
    y, x = np.stack([y_low, y_low, y_high, y_high]), np.stack([x_low, x_high, x_low, x_high])
    value = atan2(y, x)
    step = np.abs(value) * (10 * U) + np.minimum(np.abs(value), 2 * TINY)
    across = (y_low < 0) & (y_high >= 0) & (x_low < 0)
    pi = 2 * HALF_PI_HIGH * (1 + 4 * U)
    lowest, highest = np.min(value - step, axis=0), np.max(value + step, axis=0)
    return np.where(across, np.minimum(lowest, -pi), lowest), np.where(across, np.maximum(highest, pi), highest)


def _cosh(low: Any, high: Any) -> tuple[Any, Any]:
    size = np.stack([np.maximum(np.maximum(low, -high), 0.0), np.maximum(-low, high)])
    value = cosh(size)
    lowest = np.where(value[0] > LARGEST, HUGE, value[0] * (1 - 7 * U))
    return np.maximum(lowest, 1.0), value[1] * (1 + 7 * U)


def _acos(low: Any, high: Any) -> tuple[Any, Any]:
    value = acos(np.stack([high, low]))
    inside = (low >= -1) & (high <= 1)
    return np.where(inside, value[0] * (1 - 13 * U), np.nan), np.where(inside, value[1] * (1 + 13 * U), np.nan)


ELEMENTARY: dict[str, Callable[..., tuple[Any, Any]]] = {
    "sin": _wave(0),
    "cos": _wave(1),
    "tan": _tan,
    "asin": _rising(asin, 10, inside=lambda low, high: (low >= -1) & (high <= 1)),
    "acos": _acos,
    "atan": _rising(atan, 7),
    "exp": _exp,
    "expm1": _rising(expm1, 6, floor=-1.0),
    "log": _rising(log, 4, inside=lambda low, high: low > 0),
    "log1p": _rising(log1p, 4, inside=lambda low, high: low > -1),
    "sinh": _rising(sinh, 9),
    "cosh": _cosh,
    "tanh": _rising(tanh, 9, floor=-1.0, ceiling=1.0),
    "asinh": _rising(asinh, 9),
    "acosh": _rising(acosh, 9, inside=lambda low, high: low >= 1),
    "atanh": _rising(atanh, 7, inside=lambda low, high: (low > -1) & (high < 1)),
    "cbrt": _cbrt,
    "atan2": _atan2,
}
"""Bounds of each function from the bounds of its arguments: NaN where it is not defined on all of them."""

log_from_zero = _rising(log, 4, inside=lambda low, high: low >= 0)
"""The logarithm, -∞ at 0."""
