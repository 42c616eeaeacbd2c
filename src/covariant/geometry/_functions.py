"""The functions every user calls: metric first, then the base point."""

import jax.numpy as jnp

from covariant._linalg import solve
from covariant._typing import MatrixField, Scalar, Vector, Vectors
from covariant.geometry._abstract import AbstractMetric, Budget, Shot, Transported, norm
from covariant.geometry._numeric import Metric
from covariant.signals import Result


def as_metric(metric: AbstractMetric | MatrixField) -> AbstractMetric:
    """Give a plain callable `q -> (n, n)` the derived operations; an `AbstractMetric` is returned as it is."""
    return metric if isinstance(metric, AbstractMetric) else Metric(metric)


def christoffel(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector) -> Vector:
    """Christoffel contraction `Γ(q)(x, y)`, symmetric in x and y, so that `∇_q̇ w = ẇ + Γ(q̇, w)`."""
    return as_metric(metric).christoffel(q, x, y)


def curvature(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
    """Riemann curvature `R(x, y)z = ∇_x∇_y z − ∇_y∇_x z − ∇_[x,y] z` at q."""
    return as_metric(metric).curvature(q, x, y, z)


def gradient(metric: AbstractMetric | MatrixField, q: Vector, covector: Vector) -> Vector:
    """Raise a covector, such as a differential or a generalised force, to the tangent vector `g(q)⁻¹ covector`."""
    return solve(metric(q), covector)


def exp(metric: AbstractMetric | MatrixField, q: Vector, v: Vector, budget: Budget = Budget()) -> Vector:
    """Riemannian exponential: where the geodesic from q with velocity v is after unit time."""
    return as_metric(metric).transport_along(q, v, v[None], budget).q


def shoot(
    metric: AbstractMetric | MatrixField,
    p: Vector,
    q: Vector,
    guess: Vector | None = None,
    budget: Budget = Budget(),
) -> Shot:
    """The geodesic from p to q with residual and result code; `guess` warm-starts its initial velocity."""
    return as_metric(metric).shoot(p, q, guess, budget)


def log(metric: AbstractMetric | MatrixField, p: Vector, q: Vector, budget: Budget = Budget()) -> Vector:
    """Riemannian logarithm: the velocity at p of the unit-time geodesic to q.

    NaN where no geodesic was found; `shoot` says why. A geodesic beyond a conjugate point is returned as found, and
    flagged by `shoot`: it is a geodesic, but not the shortest one.
    """
    shot = shoot(metric, p, q, None, budget)
    return jnp.where(shot.result == Result.NOT_CONVERGED, jnp.nan, shot.velocity)


def distance(metric: AbstractMetric | MatrixField, p: Vector, q: Vector, budget: Budget = Budget()) -> Scalar:
    """Geodesic distance, the length of `log`."""
    return norm(metric, p, log(metric, p, q, budget))


def transport(
    metric: AbstractMetric | MatrixField, p: Vector, v: Vector, q: Vector, budget: Budget = Budget()
) -> Vector:
    """Parallel transport of v from p to q along the geodesic that joins them: a linear isometry."""
    return as_metric(metric).transport_along(p, log(metric, p, q, budget), v, budget).w


def transport_along(
    metric: AbstractMetric | MatrixField, p: Vector, velocity: Vector, w: Vectors, budget: Budget = Budget()
) -> Transported:
    """Follow a geodesic for unit time and carry the vectors w (..., n) along it in parallel."""
    return as_metric(metric).transport_along(p, velocity, w, budget)
