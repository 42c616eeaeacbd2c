"""Covariances as tensors, so that a filter can be given the same noise in every chart."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Matrix, Scalar
from covariant.geometry import AbstractSpace
from covariant.observers._protocol import check_finite

Covariance = Scalar | Matrix | Callable[[Any], Matrix]
"""A covariance of vectors at a configuration, in the frame of the space: a number is a variance in metric units, the
same in every direction; a matrix (n, n) is the same at every configuration; or a function `q -> (n, n)`."""


def check_covariance(whose: str, name: str, covariance: Any, positive: bool = False) -> None:
    """Raise `ValueError` for a number or matrix that is no covariance; with `positive`, also for a singular one.

    A traced value and a function are not checked.
    """
    if callable(covariance) or isinstance(covariance, Tracer):
        return
    check_finite(whose, **{name: covariance})
    given = np.asarray(covariance, float)
    if given.ndim not in (0, 2) or (given.ndim == 2 and given.shape[0] != given.shape[1]):
        raise ValueError(f"{whose}: {name} must be a number or a square matrix; its shape is {given.shape}")
    matrix = np.atleast_2d(given)
    size = np.abs(matrix).max()
    if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-9 * size):
        raise ValueError(f"{whose}: {name} must be symmetric; got {given.tolist()}")
    least = np.linalg.eigvalsh(matrix)[0]
    if least < -1e-12 * size or (positive and not least > 1e-12 * size):
        wanted = "positive" if positive else "zero or more"
        raise ValueError(f"{whose}: {name} must have variances that are {wanted}; its least is {least:.3g}")


def covariance_at(covariance: Covariance, space: AbstractSpace, q: Array) -> Float[Array, "n n"]:
    """The covariance matrix (n, n) at the configuration q."""
    if callable(covariance):
        return covariance(q)
    covariance = jnp.asarray(covariance)
    if covariance.ndim:
        return covariance
    metric = space(q)
    return covariance * solve(metric, jnp.eye(metric.shape[0], dtype=metric.dtype))
