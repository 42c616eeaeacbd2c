"""Every coefficient of a rotation that is 0/0 at small angles, as a series in the squared angle.

Source: Stiefel & Scheifele 1971, Linear and Regular Celestial Mechanics, section 11 (Stumpff's functions).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp

from covariant._typing import Scalar

TERMS = 16
"""Terms of a series; they reach the rounding error of float64 up to the thresholds below."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def stumpff(k: int, x: Scalar) -> Scalar:
    """`c_k(x) = Σ_j (−x)^j / (2j + k)!`, x = θ² ≥ 0.

    c₀ = cos θ, c₁ = sin θ / θ, c₂ = (1 − cos θ)/θ², c₃ = (θ − sin θ)/θ³, and so on. The series is exact to rounding
    below its threshold: 1 for the first three, which have accurate closed forms, 10 > π² for the others, whose closed
    forms cancel.
    """
    series = x < (1.0 if k < 3 else 10.0)
    return jnp.where(series, _series(k, jnp.where(series, x, 0.0)), _closed(k, jnp.where(series, 16.0, x)))


@stumpff.defjvp
def _(k: int, primals, tangents):
    (x,), (dx,) = primals, tangents
    return stumpff(k, x), (k * stumpff(k + 2, x) - stumpff(k + 1, x)) / 2 * dx


def _series(k: int, x: Scalar) -> Scalar:
    total = jnp.ones_like(x)
    for j in range(TERMS, 0, -1):
        total = 1 - x / ((2 * j + k) * (2 * j + k - 1)) * total
    return total / math.factorial(k)


def _closed(k: int, x: Scalar) -> Scalar:
    theta = jnp.sqrt(x)
    if k == 0:
        return jnp.cos(theta)
    if k == 1:
        return jnp.sin(theta) / theta
    if k == 2:
        return 2 * jnp.sin(theta / 2) ** 2 / x
    return (1 / math.factorial(k - 2) - _closed(k - 2, x)) / x


def inverse_jacobian_coefficient(x: Scalar) -> Scalar:
    """`(1 − (θ/2) cot(θ/2))/θ²`, written without cancellation as `(c₃ − 2c₄)/(2c₂)`."""
    return (stumpff(3, x) - 2 * stumpff(4, x)) / (2 * stumpff(2, x))


def angle_over_half_sine(squared_sine: Scalar, cosine: Scalar) -> Scalar:
    """`θ / sin(θ/2)` from `sin²(θ/2)` and `cos(θ/2) ≥ 0`: it turns a quaternion's vector into a rotation vector."""
    small = squared_sine < 0.01 * cosine**2
    safe_cosine = jnp.where(small, cosine, 1.0)
    x = jnp.where(small, squared_sine, 0.0) / safe_cosine**2
    total = jnp.zeros_like(x)
    for j in range(TERMS, -1, -1):  # atan(r)/r in r²
        total = 1 / (2 * j + 1) - x * total
    sine = jnp.sqrt(jnp.where(small, 1.0, squared_sine))
    return jnp.where(small, 2 * total / safe_cosine, 2 * jnp.arctan2(sine, cosine) / sine)
