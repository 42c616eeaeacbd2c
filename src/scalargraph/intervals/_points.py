"""Computes elementary functions at points from sums, products, quotients and roots alone, with proved error bounds.

No library function is trusted. The argument is reduced without error, or with an error that is carried along; the
Taylor polynomial of the reduced function has a remainder that is known in closed form; and every operation rounds by at
most a part u = 2⁻⁵³ of its result (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2002, chapter 5).
`UNITS` states the total error in u; tests of this package derive it automatically by a first-order analysis. The
argument reductions follow J.-M. Muller, Elementary Functions, 2016.

Besides IEEE arithmetic, only exact operations are trusted: comparisons and operations on bits. Arguments are arrays
(...).
"""

import math
from collections.abc import Sequence

import numpy as np

U = 2.0**-53
"""The largest relative error of one rounding."""
MAGIC = 1.5 * 2.0**52
"""Adding it to a number well below 2⁵¹ puts the nearest integer into the last bits of the sum."""

UNITS = {
    "exp": 2.5,
    "pow": 3.5,
    "expm1": 6.0,
    "sinh": 8.5,
    "cosh": 5.0,
    "tanh": 8.5,
    "log": 3.25,
    "log1p": 3.25,
    "asinh": 7.0,
    "acosh": 7.0,
    "atanh": 5.5,
    "atan": 5.0,
    "atan2": 5.0,
    "asin": 7.0,
    "acos": 8.0,
    "sin": 2.0,
    "cos": 2.75,
    "tan": 6.0,
}
"""Relative errors in u; underflow and the error of the reduction modulo π/2 are not included."""


def _hex_doubles(*digits: str) -> list[float]:
    return [float.fromhex(f"0x{each}") for each in digits]


# Constants split into words of a few bits, whose products with integers of 11 or 20 bits are exact; the last word has
# 53 bits.
LN2_HIGH, LN2_LOW = _hex_doubles("1.62e42fefa38p-1", "1.ef35793c7673p-45")
QUARTER_HIGH, QUARTER_MIDDLE, QUARTER_LOW = _hex_doubles("1.921fb544p+0", "1.0b4611a6p-34", "1.3198a2e037073p-69")
HALF_PI_HIGH, HALF_PI_LOW = _hex_doubles("1.921fb54442d18p+0", "1.1a62633145c07p-54")
_UNUSED = (math.nan,) * 3
ATAN_HIGH = np.array(
    [
        *_hex_doubles("0p+0", "1.f5b75f92c80ddp-3", "1.dac670561bb4fp-2", "1.4978fa3269ee1p-1", "1.921fb54442d18p-1"),
        *_UNUSED,
    ]
)
"""Arc tangents of 0, ¼, ½, ¾ and 1, to the nearest double; the remaining entries are read if the argument is NaN."""
ATAN_LOW = np.array(
    [
        *_hex_doubles(
            "0p+0", "1.8ab6e3cf7afbdp-57", "1.a2b7f222f65e2p-56", "1.2419a87f2a458p-56", "1.1a62633145c07p-55"
        ),
        *_UNUSED,
    ]
)
"""Differences of the exact values from `ATAN_HIGH`."""

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


def horner(coefficients: Sequence[float], x: np.ndarray) -> np.ndarray:
    """Evaluate a polynomial by Horner's rule."""
    total = x * coefficients[0]
    total += coefficients[1]
    for coefficient in coefficients[2:]:
        total *= x
        total += coefficient
    return total


def whole(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round to the nearest integer."""
    shifted = x + MAGIC
    # The unit of the last bit of the sum is 1, so the sum is rounded to an integer; the difference is exact.
    return shifted - MAGIC, shifted.view(np.int64)


def _power_of_two(bits: np.ndarray) -> np.ndarray:
    """2ᵏ from the bits of k, |k| ≤ 1022."""
    return ((bits + 1023) << 52).view(float)


def _scale_by_power(x: np.ndarray | float, k: np.ndarray) -> np.ndarray:
    """x·2ᵏ for integers |k| ≤ 2000, as two products, of which one may underflow or overflow."""
    # A single factor 2ᵏ might overflow although the product does not.
    half, bits = whole(0.5 * k)
    return x * _power_of_two(bits) * _power_of_two(whole(k - half)[1])


# Exponential functions. x = k ln 2 + r with |r| ≤ 0.34658; the difference x - k·LN2_HIGH is exact.


def exp_reduced(r: np.ndarray) -> np.ndarray:
    """exp r − 1 for |r| ≤ 0.34658.

    The remainder is below r¹⁴/14!·1.03, that is 0.12 u |r|.
    """
    # r is added last: the quadratic remainder is at most a fifth of r, so its rounding contributes little.
    return r + r * r * horner(EXP, r)


def _exp_parts(x: np.ndarray, rest: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    k, _ = whole(x * (1 / math.log(2)))
    r = (x - k * LN2_HIGH) - k * LN2_LOW
    return k, exp_reduced(r if rest is None else r + rest)


def exp(x: np.ndarray, shift: float = 0.0, rest: np.ndarray | None = None) -> np.ndarray:
    """exp(x + rest) · 2ˢʰⁱᶠᵗ, infinite where it overflows.

    Args:
        x: The argument.
        shift: Integer exponent of a power of two; −1 halves the value without an intermediate overflow.
        rest: Correction of x, below a unit in its last place.
    """
    # exp(−746) is below half of the smallest subnormal number, exp(712) above the largest double.
    k, q = _exp_parts(np.minimum(np.maximum(x, -746.0), 712.0), rest)
    return _scale_by_power(1.0 + q, k + shift)


def expm1(x: np.ndarray) -> np.ndarray:
    """exp x − 1, infinite where it overflows."""
    # exp(−40) = 4e-18 is below half a unit of 1, so the result is −1 for all smaller x.
    k, q = _exp_parts(np.minimum(np.maximum(x, -40.0), 712.0))
    return _scale_by_power((1.0 - _scale_by_power(1.0, -k)) + q, k)


def sinh(x: np.ndarray) -> np.ndarray:
    """sinh x as (q + q/(q + 1))/2 for q = exp |x| − 1, or half the exponential for |x| > 20, with the sign of x.

    A relative error of q is not magnified: the logarithmic derivative with respect to log q is at most 1.
    """
    size = np.abs(x)
    q = expm1(np.minimum(size, 20.0))
    # Beyond 20, exp(−|x|) is e⁻⁴⁰ = 4e-18 of exp |x|, less than half a unit.
    return np.copysign(np.where(size > 20.0, exp(size, -1.0), 0.5 * (q + q / (q + 1.0))), x)


def cosh(x: np.ndarray) -> np.ndarray:
    """cosh x as h + 1/(4h) for h = exp |x|/2, which does not overflow before the result does."""
    half = exp(np.abs(x), -1.0)
    return half + 0.25 / half


def tanh(x: np.ndarray) -> np.ndarray:
    """tanh x as q/(q + 2) for q = exp 2|x| − 1, which magnifies no relative error. For |x| ≥ 22 it is 1 within u/4."""
    q = expm1(2.0 * np.minimum(np.abs(x), 22.0))
    return np.copysign(q / (q + 2.0), x)


# Logarithms. x = 2ᵏ m with √½ ≤ m < √2, and log m = 2 artanh s for s = f/(2 + f), f = m - 1.


def log_tail(f: np.ndarray) -> np.ndarray:
    """f − log(1 + f) for −0.2929 ≤ f ≤ 0.4143.

    It is s (f − R) for log(1 + f) = 2s + s R, since s (2 + f) = f. The remainder is below s²³/23·2.1, below 0.01 u of
    the logarithm.
    """
    # The caller adds f, which is exact, so that only the small rest carries errors of this function.
    s = f / (2.0 + f)
    z = s * s
    return s * (f - z * horner(LOG, z))


def _mantissa(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """k and m - 1 of a positive number x = 2ᵏ m, both exact."""
    low = x < 2.0**-1022
    if low.any():
        # A subnormal number has no exponent bits, so it is scaled by 2⁵⁴; the 54 is subtracted below.
        x = np.where(low, x * 2.0**54, x)
    # 0x3FE6A09E is the leading word of √½: after this shift the exponent changes at √½ instead of at a power of 2.
    bits = x.view(np.int64) + (0x3FF0000000000000 - 0x3FE6A09E00000000)
    m = ((bits & 0x000FFFFFFFFFFFFF) + 0x3FE6A09E00000000).view(float)
    return ((bits >> 52) - 0x3FF - 54 * low).astype(float), m - 1.0


def log(x: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """log x + shift·log 2: −∞ at 0, NaN below.

    Args:
        x: The argument.
        shift: Integer; 1 gives log 2x, even if 2x would overflow.
    """
    k, f = _mantissa(x)
    k += shift
    # k·LN2_HIGH is exact and the largest term, so it is added last, to the sum of the smaller ones.
    return _at_ends(x, f - (log_tail(f) - k * LN2_LOW) + k * LN2_HIGH)


def log1p(x: np.ndarray) -> np.ndarray:
    """log(1 + x). The rounding error of the sum 1 + x is computed exactly, divided by 1 + x and added."""
    total = 1.0 + x
    k, f = _mantissa(total)
    # Here 1 + x is between √½ and √2, so k = 0 and f is x itself: the rounding of the sum loses nothing.
    small = (x > -0.2928) & (x < 0.4142)
    k, f = np.where(small, 0.0, k), np.where(small, x, f)
    rest = np.where(small, 0.0, _rounding_error(1.0, x, total) / total + k * LN2_LOW)
    return _at_ends(total, f - (log_tail(f) - rest) + k * LN2_HIGH)


def _rounding_error(a: np.ndarray | float, b: np.ndarray, total: np.ndarray) -> np.ndarray:
    """a + b - total for the rounded sum, exactly (D. E. Knuth, The Art of Computer Programming 2, section 4.2.2)."""
    # This takes six operations, but holds whichever of a and b is larger.
    part = total - a
    return (a - (total - part)) + (b - part)


def _at_ends(x: np.ndarray, value: np.ndarray) -> np.ndarray:
    usual = (x > 0) & (x < np.inf)
    return value if usual.all() else np.where(usual, value, np.where(x == 0, -np.inf, np.where(x > 0, x, np.nan)))


def log_parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The logarithm of a positive number as the sum of two doubles, with a bound on its error."""
    k, f = _mantissa(x)
    tail = log_tail(f) - k * LN2_LOW
    first = k * LN2_HIGH
    head = first + f
    rest = _rounding_error(first, f, head) - tail
    return head, rest, U * (6.0 * np.abs(tail) + 2.0 * np.abs(rest)) + 2.0**-83


def power(parts: tuple[np.ndarray, np.ndarray, np.ndarray], y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """xʸ from the logarithm of x."""
    head, rest, error = parts
    more = y * rest
    product, lost = _product(y, head)
    lost = lost + more
    exponent = product + lost
    value = exp(exponent, rest=(product - exponent) + lost)
    return value, UNITS["pow"] * U + 1.01 * (np.abs(y) * error + 2.0 * U * (np.abs(more) + np.abs(lost)))


def _product(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """a·b rounded, and its rounding error, exactly (T. J. Dekker, Numerische Mathematik 18, 1971)."""
    product = a * b
    (a, c), (b, d) = _halves(a), _halves(b)
    return product, ((a * b - product) + a * d + c * b) + c * d


def _halves(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A number as the sum of two numbers of 26 bits."""
    c = (2.0**27 + 1) * a
    high = c - (c - a)
    return high, a - high


def asinh(x: np.ndarray) -> np.ndarray:
    """asinh x as log1p(a + a²/(1 + √(1 + a²))) for a = |x|, or log 2a where a > 2²⁸, with the sign of x.

    log1p does not magnify relative errors.
    """
    a = np.abs(x)
    b = np.minimum(a, 2.0**28)
    # Beyond 2²⁸, asinh a = log 2a + 1/(4a²) is log 2a to within rounding, and a², which may overflow, is not needed.
    return np.copysign(np.where(a > b, log(a, 1.0), log1p(b + b * b / (1.0 + np.sqrt(1.0 + b * b)))), x)


def acosh(x: np.ndarray) -> np.ndarray:
    """acosh x as log1p(t + √(t (t + 2))) for t = x − 1, or log 2x where x > 2²⁸."""
    t = np.minimum(x, 2.0**28) - 1.0
    return np.where(x > 2.0**28, log(x, 1.0), log1p(t + np.sqrt(t * (t + 2.0))))


def atanh(x: np.ndarray) -> np.ndarray:
    """atanh x as ½ log1p(2a/(1 − a)) for a = |x|, with the sign of x."""
    a = np.abs(x)
    return np.copysign(0.5 * log1p(2.0 * a / (1.0 - a)), x)


# Inverse trigonometric functions. atan t = atan c + atan((t - c)/(1 + c t)) for a near c among 0, ¼, ½, ¾ and 1.


def atan_reduced(t: np.ndarray, c: np.ndarray, high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """atan t from the arc tangent of a nearby c; the difference t − c is exact.

    The remainder is below z²³/23 for a quotient |z| ≤ 0.1875, that is 0.05 u of z.
    """
    z = (t - c) / (1.0 + c * t)
    w = z * z
    return high + (low + (z - z * w * horner(ATAN, w)))


def from_axis(theta: np.ndarray, turns: int) -> np.ndarray:
    """The angle from an axis: a number of quarter turns minus theta."""
    return turns * HALF_PI_HIGH - (theta - turns * HALF_PI_LOW)


def angle(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The angle of the point (x, y) [rad]: 0 at the origin, π on the negative half-axis."""
    size = np.abs(x)
    largest = np.maximum(y, size)
    # The quotient of the smaller by the larger number is at most 1; two reflections below restore the octant.
    t = np.minimum(y, size) / np.where(largest == 0, 1.0, largest)
    j, bits = whole(4.0 * t - 0.25)
    # The index is limited to three bits, so that it is valid for NaN too; the result is NaN in any case.
    index = bits & 7
    theta = atan_reduced(t, 0.25 * j, np.choose(index, ATAN_HIGH), np.choose(index, ATAN_LOW))
    theta = np.where(y > size, from_axis(theta, 1), theta)
    return np.where(x < 0, from_axis(theta, 2), theta)


def atan(x: np.ndarray) -> np.ndarray:
    """atan x as the angle of the point (1, |x|), with the sign of x."""
    return np.copysign(angle(np.abs(x), np.ones_like(x)), x)


def atan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The angle of the point (x, y) in −π … π [rad]; on the negative half-axis it is π, also for y = −0."""
    # −0 + 0 is +0, so the cut belongs to the upper side.
    return np.copysign(angle(np.abs(y), x), y + 0.0)


def asin(x: np.ndarray) -> np.ndarray:
    """asin x as the angle of the point (√((1 − x)(1 + x)), x)."""
    # (1 − x)(1 + x) keeps the digits of 1 − x near 1, which 1 − x² would lose.
    return np.copysign(angle(np.abs(x), np.sqrt((1.0 - x) * (1.0 + x))), x)


def acos(x: np.ndarray) -> np.ndarray:
    """acos x as twice the angle whose tangent is √(1 − x)/√(1 + x)."""
    # tan(½ acos x) = √((1 − x)/(1 + x)); 1 − x and 1 + x lose no digits at either end.
    return 2.0 * angle(np.sqrt(1.0 - x), np.sqrt(1.0 + x))


# Trigonometric functions. x = k π/2 + r with |r| ≤ 0.7854.

MOST_QUARTERS = 2.0**20
"""Largest number of quarter turns in an argument; for more, the words of π/2 have too few bits."""
QUARTER_ERROR = 2.0**-119
"""Error of the reduced argument for each quarter turn."""


def quarters(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reduce an argument modulo π/2: x = k π/2 + r.

    The products with the first two parts of π/2, of 33 bits, and the first difference are exact. The error of r is at
    most |k|·QUARTER_ERROR plus u² times r.
    """
    k, bits = whole(x * (2 / math.pi))
    # Reduction of Cody and Waite: products of k with the leading words are exact, and so the cancellation in x − kπ/2.
    first, second = x - k * QUARTER_HIGH, k * -QUARTER_MIDDLE
    r = first + second
    rest = _rounding_error(first, second, r) - k * QUARTER_LOW
    total = r + rest
    return k, bits, total, rest - (total - r)


def sin_cos_reduced(r: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """sin and cos of r + rest.

    The remainders are below r¹⁹/19! and r¹⁸/18!; rest·r⁴/24 and rest·r³/6 are omitted too: 0.03 u and 0.12 u in all.
    """
    z = r * r
    half = 0.5 * z
    # First order in `rest`: sin(r + e) = sin r + e cos r, with cos r = 1 − r²/2 to the accuracy that e needs.
    sine = r - (z * r * horner(SIN, z) - rest * (1.0 - half))
    cosine = 1.0 - (half - (z * z * horner(COS, z) - r * rest))
    return sine, cosine
