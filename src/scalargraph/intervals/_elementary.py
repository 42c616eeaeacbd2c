"""Bounds elementary functions over intervals: values at the ends, moved outward by their proved errors.

Each function takes the bounds of its argument, arrays (B,), and returns the bounds of its values. NaN as a bound means
that nothing is known, and is propagated.
"""

import functools
from collections.abc import Callable

import numpy as np

from scalargraph.intervals import _points as points
from scalargraph.intervals._points import HALF_PI_HIGH, UNITS, U

TINY = 2.0**-1022
"""Larger than the error of a result that underflows: the smallest normal double, as subnormal numbers are slow."""
LARGEST = np.finfo(float).max
HUGE = LARGEST * (1 - 2.0**-40)
"""A lower bound of every result that overflows, since the relative errors here are below 2⁻⁴⁰."""

THIRD = 0x2AA0000000000000
"""Two thirds of the bits of 1. Added to a third of the bits of a number, it gives the bits of roughly its cube root."""

Bounds = tuple[np.ndarray, np.ndarray]
Rule = Callable[..., Bounds]


def _relative(op: str) -> float:
    """Relative step outward that exceeds both the error of the value and the rounding of the step itself."""
    # On top of the error of the value: one unit for the rounding of value ± step, a quarter for that of the step.
    return (UNITS[op] + 1.25) * U


def _mask_undefined(defined: np.ndarray, bounds: Bounds) -> Bounds:
    """The bounds where the function is defined, and NaN elsewhere."""
    if defined.all():
        return bounds
    return np.where(defined, bounds[0], np.nan), np.where(defined, bounds[1], np.nan)


def _rising(op: str, floor: float = -np.inf, ceiling: float = np.inf) -> Rule:
    """Bounds of an increasing function. Its computed value must be zero exactly if the function is zero."""
    point, relative = getattr(points, op), _relative(op)

    def bounds(low: np.ndarray, high: np.ndarray) -> Bounds:
        value = point(np.stack([low, high]))
        size = np.abs(value)
        # The absolute part covers underflow. If the value is zero, the function is zero too, and the step is 0.
        step = np.minimum(size, TINY)
        size *= relative
        step += size
        # If a value overflows, a large lower bound is still known.
        lowest = np.where(value[0] > LARGEST, HUGE, value[0] - step[0])
        highest = np.where(value[1] < -LARGEST, -HUGE, value[1] + step[1])
        if floor > -np.inf or ceiling < np.inf:
            return np.maximum(lowest, floor), np.minimum(highest, ceiling)
        return lowest, highest

    return bounds


def _within(first: np.ndarray, last: np.ndarray, rest: int, period: int) -> np.ndarray:
    """Whether there is an integer from first to last that is congruent to `rest` modulo `period`."""
    return np.floor((last - rest) * (1 / period)) * period + rest >= first


def _turns(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
    """Data of both ends reduced modulo π/2: quarter turns, sine and cosine, errors; and the range of quarter turns.

    The range is the first and the last whole quarter turn between the ends. A quarter turn counts as between them if
    rounding leaves open on which side of an end it lies. The last entry is the largest number of quarter turns; an
    argument with too many cannot be reduced.
    """
    x = np.stack([low, high])
    k, bits, r, rest = points.quarters(x)
    size = np.abs(k)
    error = size * points.QUARTER_ERROR
    # A reduced argument that is 0 within its error counts as lying on the quarter turn, so that no extremum is missed.
    first, last = k[0] + (r[0] > error[0]), k[1] - (r[1] < -error[1])
    largest = np.maximum(size[0], size[1])
    return bits, *points.sin_cos_reduced(r, rest), error, first, last, largest


def _wave(op: str) -> Rule:
    """Bounds of the sine or cosine; the cosine is the sine a quarter turn ahead."""
    ahead, relative = ("sin", "cos").index(op), max(_relative("sin"), _relative("cos"))

    def bounds(low: np.ndarray, high: np.ndarray) -> Bounds:
        bits, sine, cosine, error, first, last, largest = _turns(low, high)
        bits = bits + ahead
        value = np.where((bits & 1).astype(bool), cosine, sine)
        # Bit 1 of the count of quarter turns decides the sign: shifted by 62 it is the sign bit of a double.
        value = (value.view(np.int64) ^ ((bits & 2) << 62)).view(float)
        size = np.abs(value)
        error += np.minimum(size, TINY)
        size *= relative
        error += size
        lowest, highest = value - error, value + error
        lowest, highest = np.minimum(lowest[0], lowest[1]), np.maximum(highest[0], highest[1])
        # The sine is −1 at quarter turns 3 modulo 4 and 1 at 1; the cosine, a quarter turn ahead, at 2 and 0.
        lowest = np.where(_within(first, last, 3 - ahead, 4), -1.0, np.maximum(lowest, -1.0))
        highest = np.where(_within(first, last, 1 - ahead, 4), 1.0, np.minimum(highest, 1.0))
        irreducible = largest > points.MOST_QUARTERS
        if irreducible.any():
            lowest, highest = np.where(irreducible, -1.0, lowest), np.where(irreducible, 1.0, highest)
        return lowest, highest

    return bounds


def _tan(low: np.ndarray, high: np.ndarray) -> Bounds:
    bits, sine, cosine, error, first, last, largest = _turns(low, high)
    odd = (bits & 1).astype(bool)
    # tan(kπ/2 + r) is tan r for even k, and −cot r for odd k.
    value = np.where(odd, -cosine, sine) / np.where(odd, sine, cosine)
    size = np.abs(value)
    # The derivative of the tangent, 1 + tan², magnifies the remaining error of the reduction.
    step = size * _relative("tan") + 2.0 * error * (1.0 + size * size) + np.minimum(size, TINY)
    # Odd quarter turns are poles. An end at which the derivative magnifies the error too much counts as a pole.
    pole = _within(first, last, 1, 2) | ~(size * error < 2.0**-20).all(axis=0)
    return _mask_undefined((largest <= points.MOST_QUARTERS) & ~pole, (value[0] - step[0], value[1] + step[1]))


def _exp(low: np.ndarray, high: np.ndarray) -> Bounds:
    value = points.exp(np.stack([low, high]))
    step = value * _relative("exp")
    step += TINY
    # exp is positive, so a lower bound that an underflow would make negative is raised to 0.
    return np.maximum(np.where(value[0] > LARGEST, HUGE, value[0] - step[0]), 0.0), value[1] + step[1]


def _power(x_low: np.ndarray, x_high: np.ndarray, y_low: np.ndarray, y_high: np.ndarray) -> Bounds:
    """Bounds of xʸ for x ≥ 0, with y > 0 if x may be 0. The function is monotonic along every side of a box."""
    x = np.stack([x_low, x_high])
    # For x = 0 the logarithm is computed at 1 instead, and the result replaced by 0: 0ʸ = 0 for y > 0.
    parts, ends = points.log_parts(np.where(x == 0, 1.0, x)), []
    for y in (y_low,) if np.array_equal(y_low, y_high) else (y_low, y_high):
        value, error = points.power(parts, y)
        step = value * (error + 1.25 * U) + TINY
        low, high = np.where(value > LARGEST, HUGE, np.maximum(value - step, 0.0)), value + step
        ends.append((np.where(x == 0, 0.0, low), np.where(x == 0, 0.0, high), error.max(axis=0)))
    lows, highs, errors = (list(row) for row in zip(*ends, strict=True))
    low, high = functools.reduce(np.minimum, lows), functools.reduce(np.maximum, highs)
    defined = (x_low > 0) | (x_low == 0) & (y_low > 0)
    # The error bound is linear in the error; above 1e-3 it no longer holds.
    defined = defined & (x_high < np.inf) & (functools.reduce(np.maximum, errors) < 1e-3)
    return _mask_undefined(defined, (low.min(axis=0), high.max(axis=0)))


def _cosh(low: np.ndarray, high: np.ndarray) -> Bounds:
    # cosh is even and increases with |x|, so the smallest and the largest |x| of the interval give its bounds.
    value = points.cosh(np.stack([np.maximum(np.maximum(low, -high), 0.0), np.maximum(-low, high)]))
    step = value * _relative("cosh")
    return np.maximum(np.where(value[0] > LARGEST, HUGE, value[0] - step[0]), 1.0), value[1] + step[1]


def _acos(low: np.ndarray, high: np.ndarray) -> Bounds:
    # acos decreases, so its lower bound is its value at the upper end.
    value = points.acos(np.stack([high, low]))
    step = value * _relative("acos")
    return _mask_undefined((low >= -1) & (high <= 1), (value[0] - step[0], value[1] + step[1]))


def _atan2(y_low: np.ndarray, y_high: np.ndarray, x_low: np.ndarray, x_high: np.ndarray) -> Bounds:
    """Bounds of the angle. It has no extremum inside a box or a side, so its extreme values are at the corners.

    The exception is a box across the negative half-axis, where the angle jumps; its bounds are ±π.
    """
    x, ends = np.stack([x_low, x_high]), []
    for y in (y_low, y_high):
        value = points.atan2(y, x)
        size = np.abs(value)
        step = size * _relative("atan2") + np.minimum(size + np.abs(y), TINY)
        ends.append((value - step, value + step))
    lowest = np.minimum(ends[0][0], ends[1][0]).min(axis=0)
    highest = np.maximum(ends[0][1], ends[1][1]).max(axis=0)
    # An interval across the cut has angles up to π on one side and down to −π on the other.
    across, pi = (y_low < 0) & (y_high >= 0) & (x_low < 0), 2 * HALF_PI_HIGH * (1 + 4 * U)
    return np.where(across, np.minimum(lowest, -pi), lowest), np.where(across, np.maximum(highest, pi), highest)


def _cbrt(low: np.ndarray, high: np.ndarray) -> Bounds:
    """Bounds of the cube root: numbers slightly below and above an approximate root, verified by their cubes.

    Newton's method starts from a third of the exponent, with a relative error below 0.07, and squares it in each step.
    """
    x = np.stack([low, high])
    size = np.abs(x)
    # Cubes must neither underflow nor overflow: x is scaled by a power of 2, by ∛(s³x) = s∛x, which is exact.
    scale = np.where(size < 2.0**-700, 2.0**-100, np.where(size > 2.0**700, 2.0**100, 1.0))
    back = 1 / scale
    size = size * back * back * back
    usual = (size > 0) & (size < np.inf)
    inside = np.where(usual, size, 1.0)
    guess = (inside.view(np.int64) // 3 + THIRD).view(float)
    # Newton's method doubles the digits: from an error of 6 %, four steps reach rounding, and the fifth is a reserve.
    for _ in range(5):
        guess = (2.0 * guess + inside / (guess * guess)) / 3.0
    guess = np.where(usual, guess, size)
    below, above = guess * (1 - 6 * U), guess * (1 + 6 * U)
    # Three products err by at most 3u, so that the factors 1 ± 4u make both comparisons rigorous.
    verified = (below * below * below * (1 + 4 * U) <= size) & (above * above * above * (1 - 4 * U) >= size)
    below, above = np.where(verified, below * scale, np.nan), np.where(verified, above * scale, np.nan)
    # For a negative number, the negative of the larger root is the lower bound.
    return np.where(x[0] > 0, below[0], -above[0]), np.where(x[1] > 0, above[1], -below[1])


def _inside(rule: Rule, defined: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Rule:
    return lambda low, high: _mask_undefined(defined(low, high), rule(low, high))


ELEMENTARY: dict[str, Rule] = {
    "sin": _wave("sin"),
    "cos": _wave("cos"),
    "tan": _tan,
    "asin": _inside(_rising("asin"), lambda low, high: (low >= -1) & (high <= 1)),
    "acos": _acos,
    "atan": _rising("atan"),
    "atan2": _atan2,
    "exp": _exp,
    "expm1": _rising("expm1", floor=-1.0),
    "log": _inside(_rising("log"), lambda low, high: low > 0),
    "log1p": _inside(_rising("log1p"), lambda low, high: low > -1),
    "sinh": _rising("sinh"),
    "cosh": _cosh,
    "tanh": _rising("tanh", floor=-1.0, ceiling=1.0),
    "asinh": _rising("asinh"),
    "acosh": _inside(_rising("acosh"), lambda low, high: low >= 1),
    "atanh": _inside(_rising("atanh"), lambda low, high: (low > -1) & (high < 1)),
    "cbrt": _cbrt,
    "pow": _power,
}
"""Bounds of each function from the bounds of its arguments; NaN if it is undefined somewhere in the box."""
