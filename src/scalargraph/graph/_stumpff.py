"""Defines Stumpff's functions, such as sin θ/θ, as one operation of a graph that is smooth at angle zero.

Each is one JAX primitive, so that a graph contains one operation in place of its computation. That computation has two
branches, a series near zero and a closed form beyond, which agree only to rounding; in intervals, a branch that is
undecided on a box would prove nothing. As functions of real numbers they are entire and decrease on [0, π²], and their
derivatives are again Stumpff's functions.

Source: Stiefel & Scheifele 1971, Linear and Regular Celestial Mechanics, section 11.
"""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike

U = 2.0**-53
STUMPFF_TERMS = 24
"""Number of terms of the series: the remainder is below 10⁻³⁶ of the first term, for x up to π²."""
FALLS_UNTIL = 9.869
"""A number slightly below π²."""
LEAST = -1.0
"""The smallest argument for which bounds are given."""


def stumpff(k: int, x: ArrayLike) -> jax.Array:
    """Stumpff's function `c_k(x) = Σ_j (−x)^j / (2j + k)!`, such as c₁(θ²) = sin θ/θ.

    Args:
        k: Order, an integer ≥ 0.
        x: Square of an angle, θ² ≥ 0 [rad²].

    Example:
        >>> import numpy as np
        >>> import scalargraph
        >>> theta = 0.5
        >>> bool(np.isclose(scalargraph.stumpff(1, theta**2), np.sin(theta) / theta))
        True
        >>> float(scalargraph.stumpff(2, 0.0))  # (1 − cos θ)/θ² at 0
        0.5
    """
    return STUMPFF.bind(jnp.asarray(x), k=int(k))


STUMPFF = core.Primitive("stumpff")
STUMPFF.def_abstract_eval(lambda x, *, k: ShapedArray(x.shape, x.dtype))


@STUMPFF.def_impl
@functools.partial(jax.jit, static_argnames="k")
def _values(x, *, k: int):
    # From c₃ on, the closed form loses digits below k(k − 1), where the terms of the series decrease. For k below 3 the
    # closed form is accurate from 1 on.
    threshold = max(1.0, k * (k - 1.0))
    small = x < threshold
    series_x, closed_x = jnp.asarray(jnp.where(small, x, 0.0)), jnp.asarray(jnp.where(small, threshold, x))
    # Each branch gets a harmless argument where the other one is chosen: the closed form is 0/0 at 0.
    return jnp.where(small, _series(k, threshold, series_x), _closed_form(k, closed_x))


mlir.register_lowering(STUMPFF, mlir.lower_fun(_values, multiple_results=False))
# By 2 c_k′ = k c_{k+2} − c_{k+1}, which contains no division by x and so is valid at x = 0.
ad.defjvp(STUMPFF, lambda g, x, *, k: (k * stumpff(k + 2, x) - stumpff(k + 1, x)) / 2 * g)
batching.primitive_batchers[STUMPFF] = lambda values, axes, *, k: (STUMPFF.bind(*values, k=k), axes[0])


def _series(k: int, threshold: float, x: jax.Array) -> jax.Array:
    coefficients = [1 / math.factorial(k)]
    # Terms are added until one is below the rounding error of the first term at the largest x.
    while coefficients[-1] * threshold ** (len(coefficients) - 1) > 1e-18 * coefficients[0]:
        coefficients.append(1 / math.factorial(2 * len(coefficients) + k))
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = coefficient - x * total
    return total


def _closed_form(k: int, x: jax.Array) -> jax.Array:
    if k == 0:
        return jnp.cos(jnp.sqrt(x))
    if k == 1:
        theta = jnp.sqrt(x)
        return jnp.sin(theta) / theta
    if k == 2:
        # 1 − cos θ = 2 sin²(θ/2) has no cancellation, unlike (1 − cos θ)/θ².
        return _closed_form(1, x / 4) ** 2 / 2
    return (1 / math.factorial(k - 2) - _closed_form(k - 2, x)) / x


# Values by NumPy, and bounds.


def values(k: float, x: np.ndarray) -> np.ndarray:
    """Values of Stumpff's function c_k, by NumPy."""
    x = np.asarray(x, float)
    series = _horner(stumpff_coefficients(int(k)), np.clip(x, LEAST, FALLS_UNTIL), -1.0)
    safe = np.maximum(x, FALLS_UNTIL)
    theta = np.sqrt(safe)
    # c_{k+2}(x) = (1/k! − c_k(x))/x, upwards from cos θ for even k or from sin θ/θ for odd k.
    closed = np.cos(theta) if int(k) % 2 == 0 else np.sin(theta) / theta
    for j in range(2 + int(k) % 2, int(k) + 1, 2):
        closed = (1 / math.factorial(j - 2) - closed) / safe
    return np.where(x < FALLS_UNTIL, series, closed)


def stumpff_coefficients(k: int) -> list[float]:
    """Magnitudes of the power series coefficients of c_k: 1/k!, 1/(k + 2)!, …, `STUMPFF_TERMS` of them."""
    return [1 / math.factorial(2 * j + k) for j in range(STUMPFF_TERMS)]


def stumpff_bounds(series: Sequence[float], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of Stumpff's function c_k on intervals.

    c_k decreases until π², also below 0, where all terms of its series are positive; for x ≥ 0 it lies within ±1/k!.
    Squares are not negative, but their enclosures may reach below 0, so the series is used from `LEAST` on. The
    relative error of the sum is at most 3·STUMPFF_TERMS·u of the sum of the absolute terms (N. J. Higham, Accuracy and
    Stability of Numerical Algorithms, 2002, section 5.1); the last term is added to account for the omitted ones.
    """
    most = series[0] * (1 + 4 * U)
    inside = (low >= LEAST) & (high <= FALLS_UNTIL)
    # c_k decreases, so its lower bound is its value at the upper end of x.
    x = np.where(inside, np.stack([high, low]), 0.0)
    value, size = _horner(series, x, -1.0), _horner(series, np.maximum(x, -x), 1.0)
    # Horner's rule rounds twice per term, the coefficients once; `size` sums the absolute values of all terms.
    off = (4 * STUMPFF_TERMS * U + 1e-30) * size
    # |c_k(x)| ≤ c_k(0) = 1/k! for all x ≥ 0, because c_k is an average of cosines.
    known = low >= 0
    lowest, highest = np.maximum(value[0] - off[0], -most), value[1] + off[1]
    highest = np.where(known, np.minimum(highest, most), highest)
    return (
        np.where(inside, lowest, np.where(known, -most, np.nan)),
        np.where(inside, highest, np.where(known, most, np.nan)),
    )


def _horner(series: Sequence[float], x: np.ndarray, sign: float) -> np.ndarray:
    total = np.zeros_like(x)
    for coefficient in reversed(series):
        total = coefficient + sign * x * total
    return total
