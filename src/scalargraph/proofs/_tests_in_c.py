"""Runs the prover's tests on boxes in compiled C; `enclosed_by`, `definite` and `weights` are the same in NumPy.

Each sum is taken in the same order, so that all numbers agree to the last bit. This is tested when the library is
loaded, and a library that rounds differently is refused. LAPACK computes the factors C for both.
"""

import ctypes
import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from scalargraph._typing import Arithmetic
from scalargraph.compiler import EXACT, compiled, compiler
from scalargraph.intervals import Enclosure, in_c
from scalargraph.proofs._definite import ROUND, SLACK, TINY, definite, factors, weights
from scalargraph.proofs._enclosure import EnclosedMatrices, enclosed_by
from scalargraph.template import fill

LANES = 64
"""Number of boxes that each operation processes at once."""


class CompiledTests:
    """The prover's tests in a compiled library, with results equal to those of NumPy to the last bit.

    Args:
        text: C of the tests; by default that of `source`.

    Raises:
        OSError: There is no C compiler, or the library rounds in another way than NumPy.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs._tests_in_c import tests_in_c
        >>> tests = tests_in_c("auto", 1)  # None where NumPy does the work
        >>> tests is None or tests.definite(np.array([[2.0]]), np.array([[1.0]]))[0].tolist() == [True]
        True
    """

    def __init__(self, text: str = ""):
        if compiler() is None:
            raise OSError("there is no C compiler `cc`, so NumPy does the work")
        # EXACT forbids fused products and sums, and reordered sums, which would change the last bits.
        self._library = compiled(text or source(), EXACT, ctypes.CDLL)
        if not self._agrees():
            raise OSError(f"{compiler()} rounds in another way than NumPy, so NumPy does the work")

    def enclosed(self, at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> EnclosedMatrices:
        """The enclosures of `enclosed_by`."""
        f, boxes = half.shape
        m = f + f * (f + 1) // 2
        result = [np.empty(shape) for shape in [(k, boxes), (m, k, boxes), *[(k, boxes)] * 3, (m, k, boxes)]]
        bounds = (_rows(side) for side in (at.low, at.high, on.low, on.high))
        _call(self._library.taylor, k, f, boxes, *bounds, half, on.smooth.astype(float), *result)
        return EnclosedMatrices(*result, smooth=on.smooth)

    def definite(
        self, middle: np.ndarray, radius: np.ndarray, terms: np.ndarray | None = None
    ) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
        """The verdict and the factors, as from the NumPy function of this name."""
        c, positive = factors(middle)
        n, boxes, below = len(c), c.shape[2], np.empty(c.shape[2])
        terms = np.empty((0, *middle.shape)) if terms is None else terms
        _call(self._library.definite, n, len(terms), boxes, c, middle, radius, terms, below)
        return (below != 0) & positive, c

    def weights(self, c: np.ndarray, terms: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """The weights (m, B), as from the NumPy function of this name."""
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
            # Bits are compared, without a tolerance: verdicts and trees must not depend on the engine.
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


def _call(function: Callable[..., None], *arguments: np.ndarray | int) -> None:
    passed = [np.ascontiguousarray(a) if isinstance(a, np.ndarray) else a for a in arguments]
    function(*(ctypes.c_int64(a) if isinstance(a, int) else ctypes.c_void_p(a.ctypes.data) for a in passed))


LARGEST = 16
"""Largest number of rows of matrices that C tests, as their numbers are stored on the stack."""


def tests_in_c(engine: Arithmetic, n: int) -> CompiledTests | None:
    """The compiled tests of matrices (n, n), if compiled C bounds the graphs too; otherwise None."""
    return _load_tests() if n <= LARGEST and in_c(engine) else None


@functools.cache
def _load_tests() -> CompiledTests | None:
    try:
        return CompiledTests()
    except OSError:
        return None


@functools.cache
def source() -> str:
    """The C of the tests, with the tolerances of `_definite`."""
    # Hexadecimal constants are exact, so that both implementations use the same doubles.
    numbers = {"LANES": LANES, "ROUND": ROUND.hex(), "TINY": TINY.hex(), "MOST": (1 - SLACK).hex()}
    return fill("scalargraph", "tests.c", numbers)
