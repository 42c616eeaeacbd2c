"""The prover's tests on boxes as compiled C: `enclosed_by`, `definite` and `weights` do the same operations in NumPy.

Each sum is taken in the same order, so that all numbers are the same to the last bit; where the library is loaded this
is tried, and a compiler that rounds in another way is refused. The factors C are computed by LAPACK for both.
"""

import ctypes
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool

from covariant._compile import EXACT, compiled, compiler
from covariant._typing import Arithmetic
from covariant.lowering import Enclosure, in_c
from covariant.proofs._definite import ROUND, SLACK, TINY, definite, factors, weights
from covariant.proofs._enclosure import EnclosedMatrices, enclosed_by

LANES = 64
"""Number of boxes for which each operation is done at once."""


class CompiledTests:
    """The prover's tests in a compiled library, with results equal to those of NumPy to the last bit.

    Args:
        text: C of the tests; by default that of `source`.

    Raises:
        OSError: There is no C compiler, or the library rounds in another way than NumPy.

    Example:
        >>> import numpy as np
        >>> from covariant.proofs._tests_in_c import tests_in_c
        >>> tests = tests_in_c("auto", 1)  # None where NumPy does the work
        >>> tests is None or tests.definite(np.array([[2.0]]), np.array([[1.0]]))[0].tolist() == [True]
        True
    """

    def __init__(self, text: str = ""):
        if compiler() is None:
            raise OSError("there is no C compiler `cc`, so NumPy does the work")
        # EXACT forbids fused products and sums, and other orders of a sum, which change the last bits.
        self._library = compiled(text or source(), EXACT, ctypes.CDLL)
        if not self._agrees():
            raise OSError(f"{compiler()} rounds in another way than NumPy, so NumPy does the work")

    def enclosed(self, at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> EnclosedMatrices:
        """The enclosures of `enclosed_by`.

        Args:
            at: Bounds of the entries and their first derivatives at the centres of B boxes.
            on: Bounds of the entries, first and second derivatives on these boxes.
            half: Half widths (f, B) of the boxes.
            k: Number of entries on and below the diagonal, K.
        """
        f, boxes = half.shape
        m = f + f * (f + 1) // 2
        result = [np.empty(shape) for shape in [(k, boxes), (m, k, boxes), *[(k, boxes)] * 3, (m, k, boxes)]]
        bounds = (_rows(side) for side in (at.low, at.high, on.low, on.high))
        _call(self._library.taylor, k, f, boxes, *bounds, half, on.smooth.astype(float), *result)
        return EnclosedMatrices(*result, smooth=on.smooth)

    def definite(
        self, middle: np.ndarray, radius: np.ndarray, terms: np.ndarray | None = None
    ) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
        """The verdict and the factors of the function of this name in NumPy.

        Args:
            middle: Middles (K, B) of the entries on and below the diagonal.
            radius: Radii (K, B) around them.
            terms: Optional further terms (m, K, B).
        """
        c, positive = factors(middle)
        n, boxes, below = len(c), c.shape[2], np.empty(c.shape[2])
        terms = np.empty((0, *middle.shape)) if terms is None else terms
        _call(self._library.definite, n, len(terms), boxes, c, middle, radius, terms, below)
        return (below != 0) & positive, c

    def weights(self, c: np.ndarray, terms: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """The weights (m, B) of the function of this name in NumPy.

        Args:
            c: Factors C (n, n, B).
            terms: Terms (m, K, B).
            shares: Contributions (m, K, B) to the remainder.
        """
        n, boxes, m = len(c), c.shape[2], len(terms)
        result = np.empty((m, boxes))
        _call(self._library.weights, n, m, boxes, c, terms, shares, result)
        return result

    def _agrees(self) -> bool:
        """Whether random matrices give the same bits as in NumPy."""
        for n, f, boxes in ((1, 1, 3), (2, 3, 70), (4, 2, 64), (3, 0, 5)):
            at, on, half, k = _trial(n, f, boxes)
            expected, result = enclosed_by(at, on, half, k), self.enclosed(at, on, half, k)
            tested, c = definite(expected.centre, expected.rest, expected.terms)
            expected = (*expected, tested, weights(c, expected.terms, expected.shares))
            result = (
                *result,
                self.definite(result.centre, result.rest, result.terms)[0],
                self.weights(c, result.terms, result.shares),
            )
            # Equality of bits, not a tolerance: verdicts and trees must not depend on the engine.
            if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(expected, result, strict=True)):
                return False
        return True


def _trial(n: int, f: int, boxes: int) -> tuple[Enclosure, Enclosure, np.ndarray, int]:
    """Bounds of random matrices near definite ones, some unknown or unbounded."""
    rng, k = np.random.default_rng(n), n * (n + 1) // 2
    counts = (k + f * k, k + f * k + f * (f + 1) // 2 * k)
    enclosures = []
    for count in counts:
        low = rng.normal(size=(count, boxes)) * 0.1
        low[:k] += np.eye(n)[np.tril_indices(n)][:, None] * 3
        high = low + rng.exponential(size=low.shape) * 0.01
        high[:, ::7] = np.inf
        low[:, 3::11] = np.nan
        enclosures.append(Enclosure(low.T, high.T, rng.random(boxes) < 0.9))
    return enclosures[0], enclosures[1], rng.exponential(size=(f, boxes)), k


def _rows(ends: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(ends.T)


def _call(function: Any, *arguments: Any) -> None:
    passed = [np.ascontiguousarray(a) if isinstance(a, np.ndarray) else a for a in arguments]
    function(*(ctypes.c_int64(a) if isinstance(a, int) else ctypes.c_void_p(a.ctypes.data) for a in passed))


LARGEST = 16
"""Largest matrices that are tested by C: their numbers stand on the stack."""


def tests_in_c(engine: Arithmetic, n: int) -> CompiledTests | None:
    """The compiled tests of matrices (n, n), where compiled C bounds the graphs too.

    Args:
        engine: Arithmetic, as for `lowering.enclose`.
        n: Number of rows; above `LARGEST` NumPy does the work.

    Returns:
        The tests, or None where NumPy does the work.
    """
    return _loaded() if n <= LARGEST and in_c(engine) else None


@functools.cache
def _loaded() -> CompiledTests | None:
    try:
        return CompiledTests()
    except OSError:
        return None


@functools.cache
def source() -> str:
    """The C of the tests, with the tolerances of `_definite` as hexadecimal constants, which are exact."""
    # Hexadecimal, so that the constants are the same doubles as in NumPy.
    numbers = {"LANES": LANES, "ROUND": ROUND.hex(), "TINY": TINY.hex(), "MOST": (1 - SLACK).hex()}
    return "\n".join([*(f"#define {name} {value}" for name, value in numbers.items()), _SOURCE])


_SOURCE = """
#include <math.h>
#include <stdint.h>

#define EACH for (i = 0; i < lanes; ++i)
#define LARGER(a, b) ((b) != (b) || (b) > (a) ? (b) : (a))
#define KNOWN_LARGER(a, b) ((b) != (b) || (a) >= (b) ? (a) : (b))
#define KNOWN_SMALLER(a, b) ((b) != (b) || (a) <= (b) ? (a) : (b))
#define MIDDLE(a, b) ((a) / 2.0 + (b) / 2.0)

typedef double lane[LANES];

static void ball(int lanes, const double *restrict low, const double *restrict high, double *restrict middle,
                 double *restrict radius)
{
    int i;
    EACH {
        const double m = MIDDLE(low[i], high[i]), up = high[i] - m, down = m - low[i];
        middle[i] = m;
        radius[i] = LARGER(up, down) * (1.0 + ROUND) + TINY;
    }
}

static double outward(double x, double sign)
{
    return x + sign * (fabs(x) * ROUND + TINY);
}

/* One entry of the matrix: a column of numbers with k columns a row and so many boxes a number. */
static void entry(int lanes, int64_t k, int64_t f, int64_t boxes, const double *al, const double *ah, const double *ol,
                  const double *oh, const double *half, const double *smooth, double *centre, double *terms,
                  double *rest, double *middle, double *radius, double *shares)
{
    lane value, around, m, r, bent, squares, sizes, wide, spread;
    const int64_t row = k * boxes;
    int64_t v, u, p = f;
    int i;
    ball(lanes, al, ah, value, around);
    EACH bent[i] = squares[i] = sizes[i] = wide[i] = spread[i] = 0.0;
    for (v = 0; v < f; ++v) {
        const int64_t at = (1 + v) * row, to = v * row;
        const double *h = half + v * boxes;
        ball(lanes, al + at, ah + at, m, r);
        EACH {
            const double t = m[i] * h[i], s = r[i] * h[i], a = fabs(ol[at + i]), b = fabs(oh[at + i]);
            terms[to + i] = t;
            shares[to + i] = s;
            sizes[i] += fabs(t);
            spread[i] += s;
            wide[i] += LARGER(a, b) * h[i];
        }
    }
    for (v = 0; v < f; ++v)
        for (u = v; u < f; ++u, ++p) {
            const int64_t at = (1 + p) * row, to = p * row;
            const double *g = half + v * boxes, *h = half + u * boxes, over = u == v ? 2.0 : 1.0;
            const double part = u == v ? 0.5 : 1.0, square = u == v ? 1.0 : 0.0;
            ball(lanes, ol + at, oh + at, m, r);
            EACH {
                const double size = g[i] * h[i] / over, t = m[i] * (size * part), s = r[i] * (size * (1.0 + ROUND));
                terms[to + i] = t;
                shares[to + i] = s;
                sizes[i] += fabs(t);
                bent[i] += fabs(t);
                squares[i] += square != 0.0 ? t : 0.0;
                spread[i] += s;
            }
        }
    EACH {
        const double moved = value[i] + squares[i];
        const double off = around[i] + ROUND * (fabs(value[i]) + bent[i]);
        const double most = smooth[i] != 0.0 ? (off + spread[i]) * (1.0 + ROUND) + TINY : INFINITY;
        const double far = smooth[i] != 0.0 ? around[i] + wide[i] * (1.0 + ROUND) : INFINITY;
        const double reach = most + sizes[i] * (1.0 + ROUND);
        const double low = outward(moved - reach, -1.0), high = outward(moved + reach, 1.0);
        const double lower = KNOWN_LARGER(low, ol[i]), upper = KNOWN_SMALLER(high, oh[i]);
        const double below = outward(value[i] - far, -1.0), above = outward(value[i] + far, 1.0);
        const double least = KNOWN_LARGER(lower, below), largest = KNOWN_SMALLER(upper, above);
        const double half_way = MIDDLE(least, largest), up = largest - half_way, down = half_way - least;
        centre[i] = moved;
        rest[i] = most;
        middle[i] = half_way;
        radius[i] = LARGER(up, down) * (1.0 + ROUND) + TINY;
    }
}

void taylor(int64_t k, int64_t f, int64_t boxes, const double *al, const double *ah, const double *ol,
            const double *oh, const double *half, const double *smooth, double *centre, double *terms, double *rest,
            double *middle, double *radius, double *shares)
{
    int64_t box, e;
    for (box = 0; box < boxes; box += LANES)
        for (e = 0; e < k; ++e) {
            const int64_t at = e * boxes + box;
            entry(boxes - box < LANES ? (int)(boxes - box) : LANES, k, f, boxes, al + at, ah + at, ol + at, oh + at,
                  half + box, smooth + box, centre + at, terms + at, rest + at, middle + at, radius + at, shares + at);
        }
}

static int64_t place(int64_t i, int64_t j)
{
    return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i;
}

/* The entries of C'SC on and below the diagonal. */
static void congruent(int lanes, int64_t n, lane *c, lane *s, lane *column, lane *found)
{
    int64_t a, b, j, l;
    int i;
    for (b = 0; b < n; ++b) {
        for (l = 0; l < n; ++l) {
            double *restrict sum = column[l];
            for (j = 0; j < n; ++j) {
                const double *restrict x = s[place(l, j)], *restrict y = c[j * n + b];
                if (j)
                    EACH sum[i] += x[i] * y[i];
                else
                    EACH sum[i] = x[i] * y[i];
            }
        }
        for (a = b; a < n; ++a) {
            double *restrict sum = found[place(a, b)];
            for (l = 0; l < n; ++l) {
                const double *restrict x = column[l], *restrict y = c[l * n + a];
                if (l)
                    EACH sum[i] += x[i] * y[i];
                else
                    EACH sum[i] = x[i] * y[i];
            }
        }
    }
}

static void times(int lanes, int64_t n, lane *e, lane *x, lane *found)
{
    int64_t a, b;
    int i;
    for (a = 0; a < n; ++a)
        for (b = 0; b < n; ++b) {
            const double *restrict p = e[place(a, b)], *restrict q = x[b];
            double *restrict sum = found[a];
            if (b)
                EACH sum[i] += p[i] * q[i];
            else
                EACH sum[i] = p[i] * q[i];
        }
}

void definite(int64_t n, int64_t m, int64_t boxes, const double *factors, const double *middle, const double *radius,
              const double *terms, double *below)
{
    const int64_t k = n * (n + 1) / 2;
    lane c[n * n], absolute[n * n], s[k], e[k], turned[k], sum[k], size[k], column[n], x[n], y[n], good, top;
    int64_t box, j, a, b, t;
    int i;
    for (box = 0; box < boxes; box += LANES) {
        const int lanes = boxes - box < LANES ? (int)(boxes - box) : LANES;
        for (j = 0; j < n * n; ++j)
            EACH {
                c[j][i] = factors[j * boxes + box + i];
                absolute[j][i] = fabs(c[j][i]);
            }
        for (j = 0; j < k; ++j)
            EACH {
                s[j][i] = middle[j * boxes + box + i];
                sum[j][i] = size[j][i] = 0.0;
            }
        congruent(lanes, n, c, s, column, e);
        for (a = 0; a < n; ++a)
            for (b = 0; b <= a; ++b)
                EACH e[place(a, b)][i] = fabs((a == b ? 1.0 : 0.0) - e[place(a, b)][i]);
        for (t = 0; t < m; ++t) {
            for (j = 0; j < k; ++j)
                EACH s[j][i] = terms[(t * k + j) * boxes + box + i];
            congruent(lanes, n, c, s, column, turned);
            for (j = 0; j < k; ++j)
                EACH {
                    sum[j][i] += fabs(turned[j][i]);
                    size[j][i] += fabs(s[j][i]);
                }
        }
        for (j = 0; j < k; ++j)
            EACH {
                const double here = fabs(middle[j * boxes + box + i]);
                e[j][i] += sum[j][i];
                s[j][i] = radius[j * boxes + box + i] + ROUND * (here + size[j][i]);
            }
        congruent(lanes, n, absolute, s, column, turned);
        for (j = 0; j < k; ++j)
            EACH e[j][i] = (e[j][i] + turned[j][i]) * (1.0 + ROUND) + ROUND;
        for (a = 0; a < n; ++a)
            EACH x[a][i] = 1.0;
        for (t = 0; t < 4; ++t) {
            times(lanes, n, e, x, y);
            for (a = 0; a < n; ++a)
                EACH {
                    x[a][i] = y[a][i] + 1e-6;
                    top[i] = a ? LARGER(top[i], x[a][i]) : x[a][i];
                }
            for (a = 0; a < n; ++a)
                EACH x[a][i] /= top[i];
        }
        times(lanes, n, e, x, y);
        EACH good[i] = 1.0;
        for (a = 0; a < n; ++a)
            EACH good[i] = y[a][i] * (1.0 + ROUND) + TINY <= MOST * x[a][i] ? good[i] : 0.0;
        EACH below[box + i] = good[i];
    }
}

void weights(int64_t n, int64_t m, int64_t boxes, const double *factors, const double *terms, const double *shares,
             double *found)
{
    const int64_t k = n * (n + 1) / 2;
    lane c[n * n], width[n], s[k], turned[k], column[n];
    int64_t box, j, a, b, t;
    int i;
    for (box = 0; box < boxes; box += LANES) {
        const int lanes = boxes - box < LANES ? (int)(boxes - box) : LANES;
        for (j = 0; j < n * n; ++j)
            EACH c[j][i] = factors[j * boxes + box + i];
        for (a = 0; a < n; ++a)
            for (b = 0; b < n; ++b)
                EACH width[a][i] = fabs(c[a * n + b][i]) + (b ? width[a][i] : 0.0);
        for (t = 0; t < m; ++t) {
            double *to = found + t * boxes + box;
            for (j = 0; j < k; ++j)
                EACH s[j][i] = terms[(t * k + j) * boxes + box + i];
            congruent(lanes, n, c, s, column, turned);
            EACH to[i] = 0.0;
            for (a = 0; a < n; ++a)
                for (b = 0; b <= a; ++b) {
                    const int64_t p = place(a, b);
                    const double *share = shares + (t * k + p) * boxes + box;
                    const double times = a == b ? 1.0 : 2.0;
                    EACH to[i] += (fabs(turned[p][i]) + share[i] * (width[a][i] * width[b][i])) * times;
                }
        }
    }
}
"""
