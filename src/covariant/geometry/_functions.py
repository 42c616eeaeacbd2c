"""The public functions of geometry: space first, then the base point. A plain callable `q -> (n, n)` is a space too."""

import jax.numpy as jnp

from covariant._typing import MatrixField, Scalar, Vector, Vectors
from covariant.geometry._geodesics import Budget, Shot, Transported
from covariant.geometry._manifold import Configuration
from covariant.geometry._metric import as_space
from covariant.geometry._space import AbstractSpace
from covariant.signals import Result

Space = AbstractSpace | MatrixField


def inner(space: Space, q: Configuration, x: Vector, y: Vector) -> Scalar:
    """`<x, y>` at q; for a kinetic-energy metric `½ <v, v>` is the kinetic energy in joule."""
    return as_space(space).inner(q, x, y)


def norm(space: Space, q: Configuration, x: Vector) -> Scalar:
    """`|x|` at q, with a zero (not undefined) derivative at x = 0."""
    return as_space(space).norm(q, x)


def connection(space: Space, q: Configuration, x: Vector, y: Vector) -> Vector:
    """`B(x, y) = ∇_x y` of the field y with constant components, so that `∇_q̇ w = ẇ + B(v, w)` for a velocity v.

    `B(x, y) − B(y, x) = [x, y]`: in a frame that is not of coordinates, the direction x and the differentiated field y
    do not commute.
    """
    return as_space(space).connection(q, x, y)


def christoffel(space: Space, q: Vector, x: Vector, y: Vector) -> Vector:
    """Christoffel symbols `Γ(q)(x, y)` contracted with x and y: the `connection` in coordinates, symmetric in both."""
    return as_space(space).connection(q, x, y)


def curvature(space: Space, q: Configuration, x: Vector, y: Vector, z: Vector) -> Vector:
    """Riemann curvature `R(x, y)z = ∇_x∇_y z − ∇_y∇_x z − ∇_[x,y] z` at q."""
    return as_space(space).curvature(q, x, y, z)


def sectional_curvature(space: Space, q: Configuration, x: Vector, y: Vector) -> Scalar:
    """`K(x, y) = <R(x, y)y, x> / (|x|²|y|² − <x, y>²)` at q: of the plane of two vectors; 1 on the unit sphere.

    Its unit is the reciprocal of that of the metric. Where it is negative, geodesics that start side by side part.
    """
    space = as_space(space)
    xx, xy, yy = space.inner(q, x, x), space.inner(q, x, y), space.inner(q, y, y)
    return space.inner(q, space.curvature(q, x, y, y), x) / (xx * yy - xy**2)


def gradient(space: Space, q: Configuration, covector: Vector) -> Vector:
    """Raise a covector, such as a differential or a generalised force, to the tangent vector `g(q)⁻¹ covector`."""
    return as_space(space).raise_(q, covector)


def exp(space: Space, q: Configuration, v: Vector, budget: Budget = Budget()) -> Configuration:
    """Riemannian exponential: the end, after unit time, of the geodesic from q with velocity v."""
    return as_space(space).transport_along(q, v, v[None], budget).q


def shoot(
    space: Space,
    p: Configuration,
    q: Configuration,
    guess: Vector | None = None,
    budget: Budget = Budget(),
) -> Shot:
    """The geodesic from p to q with residual and result code; `guess` is a first guess of its initial velocity."""
    return as_space(space).shoot(p, q, guess, budget)


def log(space: Space, p: Configuration, q: Configuration, budget: Budget = Budget()) -> Vector:
    """Riemannian logarithm: the velocity at p of the unit-time geodesic to q.

    It is NaN where no geodesic was found; `shoot` reports why. A geodesic beyond a conjugate point is returned as found
    and flagged by `shoot`: it is a geodesic, but not the shortest one.
    """
    shot = shoot(space, p, q, None, budget)
    return jnp.where(shot.result == Result.NOT_CONVERGED, jnp.nan, shot.velocity)


def distance(space: Space, p: Configuration, q: Configuration, budget: Budget = Budget()) -> Scalar:
    """Geodesic distance, the length of `log`."""
    return norm(space, p, log(space, p, q, budget))


def transport(space: Space, p: Configuration, v: Vector, q: Configuration, budget: Budget = Budget()) -> Vector:
    """Parallel transport of v from p to q along the geodesic between them: a linear isometry."""
    return as_space(space).transport_along(p, log(space, p, q, budget), v, budget).w


def transport_along(
    space: Space, p: Configuration, velocity: Vector, w: Vectors, budget: Budget = Budget()
) -> Transported:
    """Follow a geodesic for unit time, and transport the vectors w (..., n) in parallel along it."""
    return as_space(space).transport_along(p, velocity, w, budget)
