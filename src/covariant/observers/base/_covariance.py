"""Represents covariances as tensors, so that a filter can have the same noise in every chart."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Matrix, Scalar, Vector
from covariant.geometry import AbstractSpace
from covariant.observers.base._protocol import check_finite
from scalargraph.errors import InputError

Covariance = Scalar | Matrix | Callable[[Any], Matrix]
"""A covariance of vectors at a configuration, in the frame of the space. A number is a variance in metric units, equal
in all directions; a matrix (n, n) is the same at every configuration; a function is `q -> (n, n)`."""


def check_covariance(whose: str, name: str, covariance: Covariance, positive: bool = False) -> None:
    """Check that a number or matrix is a covariance; traced values and functions are not checked."""
    if callable(covariance) or isinstance(covariance, Tracer):
        return
    check_finite(whose, **{name: covariance})
    entries = np.asarray(covariance, float)
    if entries.ndim not in (0, 2) or (entries.ndim == 2 and entries.shape[0] != entries.shape[1]):
        raise InputError(f"{whose}: {name} must be a number or a square matrix; its shape is {entries.shape}")
    matrix = np.atleast_2d(entries)
    largest = np.abs(matrix).max()
    # Tolerances are relative to the largest entry, since units may have any size.
    if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-9 * largest):
        raise InputError(f"{whose}: {name} must be symmetric; got {entries.tolist()}")
    smallest = np.linalg.eigvalsh(matrix)[0]
    # Eigenvalues err by some n·eps of the largest one; 1e-12 allows for this in a singular covariance.
    if smallest < -1e-12 * largest or (positive and not smallest > 1e-12 * largest):
        condition = "positive" if positive else "zero or more"
        raise InputError(f"{whose}: {name} must have variances that are {condition}; its least is {smallest:.3g}")


def isotropic(std: Scalar | Vector, like: Vector) -> Matrix:
    """Covariance (n, n) of n independent numbers with a common standard deviation, or one for each."""
    return jnp.diag(jnp.broadcast_to(std**2, like.shape).astype(like.dtype))


def covariance_at(covariance: Covariance, space: AbstractSpace, q: Array) -> Float[Array, "n n"]:
    """Covariance matrix at a configuration."""
    if callable(covariance):
        return covariance(q)
    covariance = jnp.asarray(covariance)
    if covariance.ndim:
        return covariance
    # A variance in metric units means that variance times the inverse of the metric.
    metric = space(q)
    return covariance * solve(metric, jnp.eye(metric.shape[0], dtype=metric.dtype))


def covariance_along(covariance: Covariance, space: AbstractSpace, q: Array) -> Float[Array, "n n"]:
    """Covariance matrix of velocities at a configuration; on a leaf only its tangential part."""
    along = jax.vmap(lambda a: space.projected(q, a), in_axes=1, out_axes=1)
    return along(along(covariance_at(covariance, space, q)).T)
