"""Formulas of a first-order Gauss–Markov process over one step."""

import jax.numpy as jnp

from covariant._typing import Scalar


def gauss_markov(steps: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Mean and end per initial value, and added variance per stationary one, of `x' = −x/τ + white noise` over h/τ."""
    safe = jnp.where(steps > 0, steps, 1.0)  # avoids 0/0 for a step of length 0
    # expm1, since 1 − exp(·) loses its digits for a large τ.
    return jnp.where(steps > 0, -jnp.expm1(-safe) / safe, 1.0), jnp.exp(-steps), -jnp.expm1(-2 * steps)
