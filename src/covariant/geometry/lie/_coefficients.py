"""Coefficients in formulas of rotations, which are 0/0 at angle zero, as smooth functions of the squared angle x = θ².

Source: Stiefel & Scheifele 1971, Linear and Regular Celestial Mechanics, section 11 (Stumpff's functions).
"""

import jax.numpy as jnp

from covariant._typing import Scalar
from scalargraph import stumpff


def _alternating(coefficients: list[float], x: Scalar) -> Scalar:
    """`Σ (−x)^j a_j` by Horner's rule."""
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = coefficient - x * total
    return total


def inverse_jacobian_coefficient(x: Scalar) -> Scalar:
    """Coefficient `(1 − (θ/2) cot(θ/2))/θ²` of the inverse Jacobians of rotations.

    It is computed as `(c₂ − c₃)/(4c₁)` of the half angle, without cancellation.
    """
    x = x / 4
    # With h = θ/2: 1 − h cot h = (c₁ − c₀)/c₁, and c₁ − c₀ = h²(c₂ − c₃); its h² cancels with θ² = 4h².
    return (stumpff(2, x) - stumpff(3, x)) / (4 * stumpff(1, x))


def angle_over_half_sine(squared_sine: Scalar, cosine: Scalar) -> Scalar:
    """Factor `θ / sin(θ/2)` from the vector part of a quaternion to the rotation vector."""
    # For tan²(θ/2) < 0.01 the first omitted term of the series, of order 9 in tan², is below 1e-19.
    small = squared_sine < 0.01 * cosine**2
    # At half a turn the cosine is 0. It is replaced, so that no derivative of the unused branch is NaN.
    safe_cosine = jnp.where(small, cosine, 1.0)
    x = jnp.where(small, squared_sine, 0.0) / safe_cosine**2
    arctangent = _alternating([1 / (2 * j + 1) for j in range(9)], x)  # divided by its argument
    # The root has an infinite derivative at 0, so it is not evaluated there.
    sine = jnp.sqrt(jnp.where(small, 1.0, squared_sine))
    return jnp.where(small, 2 * arctangent / safe_cosine, 2 * jnp.arctan2(sine, cosine) / sine)
