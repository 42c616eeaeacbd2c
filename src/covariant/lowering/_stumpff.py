"""Stumpff's functions: what is 0/0 at small angles, as one operation of a graph instead of a branch.

A JAX primitive, so that a graph knows it by identity and not by how it is computed: its two branches, a series near
zero and a closed form beyond, agree to rounding only, and a branch that a box leaves open proves nothing. As a real
function it is entire, falls on [0, π²], and its derivative is made of its own kind.

Source: Stiefel & Scheifele 1971, Linear and Regular Celestial Mechanics, section 11.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from covariant._typing import Scalar

U = 2.0**-53
TERMS = 24
"""Of the series: what is left out is below 10⁻³⁶ of the first term, for x up to π²."""
FALLS_UNTIL = 9.869
"""A little below π²."""


def stumpff(k: int, x: Scalar) -> Scalar:
    """`c_k(x) = Σ_j (−x)^j / (2j + k)!`, x = θ² ≥ 0.

    c₀ = cos θ, c₁ = sin θ / θ, c₂ = (1 − cos θ)/θ², c₃ = (θ − sin θ)/θ³, and so on; c_k' = (k c_{k+2} − c_{k+1})/2.
    """
    return STUMPFF.bind(jnp.asarray(x), k=int(k))


STUMPFF = core.Primitive("stumpff")
STUMPFF.def_abstract_eval(lambda x, *, k: ShapedArray(x.shape, x.dtype))


@STUMPFF.def_impl
@functools.partial(jax.jit, static_argnames="k")
def _values(x, *, k: int):
    # From c₃ on the closed forms cancel below k(k − 1), where the terms of the series decrease. For k below 3 the
    # closed form would do from 1 on.
    threshold = max(1.0, k * (k - 1.0))
    small = x < threshold
    near, far = jnp.asarray(jnp.where(small, x, 0.0)), jnp.asarray(jnp.where(small, threshold, x))
    return jnp.where(small, _series(k, threshold, near), _closed(k, far))


mlir.register_lowering(STUMPFF, mlir.lower_fun(_values, multiple_results=False))
ad.defjvp(STUMPFF, lambda g, x, *, k: (k * stumpff(k + 2, x) - stumpff(k + 1, x)) / 2 * g)
batching.primitive_batchers[STUMPFF] = lambda values, axes, *, k: (STUMPFF.bind(*values, k=k), axes[0])


def _series(k: int, threshold: float, x: Scalar) -> Scalar:
    coefficients = [1 / math.factorial(k)]
    while coefficients[-1] * threshold ** (len(coefficients) - 1) > 1e-18 * coefficients[0]:
        coefficients.append(1 / math.factorial(2 * len(coefficients) + k))
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = coefficient - x * total
    return total


def _closed(k: int, x: Scalar) -> Scalar:
    if k == 0:
        return jnp.cos(jnp.sqrt(x))
    if k == 1:
        theta = jnp.sqrt(x)
        return jnp.sin(theta) / theta
    if k == 2:
        return _closed(1, x / 4) ** 2 / 2
    return (1 / math.factorial(k - 2) - _closed(k - 2, x)) / x


# In NumPy: values, and bounds of them.


def values(k: Any, x: Any) -> Any:
    """c_k at numbers, by NumPy."""
    x = np.asarray(x, float)
    near = _horner(int(k), np.clip(x, 0.0, FALLS_UNTIL), -1.0)
    safe = np.maximum(x, FALLS_UNTIL)
    theta = np.sqrt(safe)
    far = np.cos(theta) if int(k) % 2 == 0 else np.sin(theta) / theta
    for j in range(2 + int(k) % 2, int(k) + 1, 2):
        far = (1 / math.factorial(j - 2) - far) / safe
    return np.where(x < FALLS_UNTIL, near, far)


def bounds(k: int, low: Any, high: Any) -> tuple[Any, Any]:
    """Bounds of c_k from bounds of x (B,): it falls until π², and is nowhere beyond ±1/k!. NaN where x may be negative.

    The sum is off by a part 3·TERMS·u of that of the absolute terms (N. J. Higham, Accuracy and Stability of Numerical
    Algorithms, 2002, section 5.1), the last one of which is added for those left out.
    """
    most = (1 / math.factorial(k)) * (1 + 4 * U)
    inside = (low >= 0) & (high <= FALLS_UNTIL)
    x = np.where(inside, np.stack([high, low]), 0.0)
    value, size = _horner(k, x, -1.0), _horner(k, x, 1.0)
    off = (4 * TERMS * U + 1e-30) * size
    lowest, highest = np.maximum(value[0] - off[0], -most), np.minimum(value[1] + off[1], most)
    known = low >= 0
    return (
        np.where(inside, lowest, np.where(known, -most, np.nan)),
        np.where(inside, highest, np.where(known, most, np.nan)),
    )


def _horner(k: int, x: Any, sign: float) -> Any:
    total = np.zeros_like(x)
    for j in reversed(range(TERMS)):
        total = 1 / math.factorial(2 * j + k) + sign * x * total
    return total
