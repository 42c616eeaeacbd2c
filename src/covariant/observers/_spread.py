"""Covariances as tensors: what a filter is told of noise, in every chart."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Matrix, Scalar
from covariant.geometry import AbstractSpace

Spread = Scalar | Matrix | Callable[[Any], Matrix]
"""A covariance of vectors at a configuration, in the frame of the space: a number is a variance in metric units, the
same in every direction; a matrix (n, n) is the same everywhere; else a function `q -> (n, n)`."""


def spread_at(spread: Spread, space: AbstractSpace, q: Array) -> Float[Array, "n n"]:
    """The covariance at a configuration."""
    if callable(spread):
        return spread(q)
    spread = jnp.asarray(spread)
    if spread.ndim:
        return spread
    metric = space(q)
    return spread * solve(metric, jnp.eye(metric.shape[0], dtype=metric.dtype))
