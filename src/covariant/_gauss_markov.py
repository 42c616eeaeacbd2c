"""A first-order Gauss–Markov process over one step: the one place of its formulas."""

import jax.numpy as jnp

from covariant._typing import Scalar


def gauss_markov(steps: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Mean, end and added variance of a process `x' = −x/τ + white noise` over a step of length h."""
    safe = jnp.where(steps > 0, steps, 1.0)  # no step has no mean
    # By expm1, since for a large τ these are differences of equal numbers.
    return jnp.where(steps > 0, -jnp.expm1(-safe) / safe, 1.0), jnp.exp(-steps), -jnp.expm1(-2 * steps)
