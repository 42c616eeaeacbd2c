"""Every coefficient of a rotation that is 0/0 at small angles, as a series in the squared angle.

Source: Stiefel & Scheifele 1971, Linear and Regular Celestial Mechanics, section 11 (Stumpff's functions).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp

from covariant._typing import Scalar


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def stumpff(k: int, x: Scalar) -> Scalar:
    """`c_k(x) = Σ_j (−x)^j / (2j + k)!`, x = θ² ≥ 0.

    c₀ = cos θ, c₁ = sin θ / θ, c₂ = (1 − cos θ)/θ², c₃ = (θ − sin θ)/θ³, and so on. From c₃ on the closed forms cancel
    below x = k(k − 1), where the terms of the series decrease.
    """
    threshold = max(1.0, k * (k - 1.0))  # also where the closed form would do: around 0 the series alone has a say
    small = x < threshold
    return jnp.where(small, _series(k, threshold, jnp.where(small, x, 0.0)), _closed(k, jnp.where(small, threshold, x)))


@stumpff.defjvp
def _(k: int, primals, tangents):
    (x,), (dx,) = primals, tangents
    return stumpff(k, x), (k * stumpff(k + 2, x) - stumpff(k + 1, x)) / 2 * dx


def _series(k: int, threshold: float, x: Scalar) -> Scalar:
    coefficients = [1 / math.factorial(k)]
    while coefficients[-1] * threshold ** (len(coefficients) - 1) > 1e-18 * coefficients[0]:
        coefficients.append(1 / math.factorial(2 * len(coefficients) + k))
    return _alternating(coefficients, x)


def _alternating(coefficients: list[float], x: Scalar) -> Scalar:
    """`Σ (−x)^j a_j` by Horner's rule."""
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


def inverse_jacobian_coefficient(x: Scalar) -> Scalar:
    """`(1 − (θ/2) cot(θ/2))/θ²`, as `(c₂ − c₃)/(4c₁)` of the half angle, where nothing cancels."""
    x = x / 4
    return (stumpff(2, x) - stumpff(3, x)) / (4 * stumpff(1, x))


def angle_over_half_sine(squared_sine: Scalar, cosine: Scalar) -> Scalar:
    """`θ / sin(θ/2)` from `sin²(θ/2)` and `cos(θ/2) ≥ 0`: it turns a quaternion's vector into a rotation vector."""
    small = squared_sine < 0.01 * cosine**2
    safe_cosine = jnp.where(small, cosine, 1.0)
    x = jnp.where(small, squared_sine, 0.0) / safe_cosine**2
    arctangent = _alternating([1 / (2 * j + 1) for j in range(9)], x)  # over its argument
    sine = jnp.sqrt(jnp.where(small, 1.0, squared_sine))
    return jnp.where(small, 2 * arctangent / safe_cosine, 2 * jnp.arctan2(sine, cosine) / sine)
