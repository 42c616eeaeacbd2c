"""What a metric is, and the functions every user calls.

A metric is any callable `q (n,) -> (n, n)`; `as_metric` gives it the derived operations (`Metric`). An `AbstractMetric`
may know better: closed forms, or the recursions of a robot. Everything is directional: no array of n³ entries exists.

Source: Aghannan & Rouchon 2003, section II. Curvature sign: on the unit sphere `R(x, y)z = <y, z>x − <x, z>y`.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from covariant._linalg import solve
from covariant._typing import Code, Matrix, MatrixField, Scalar, Vector, Vectors


class Budget(NamedTuple):
    """How much work a numerical `exp` or `log` may do. Closed forms need none and ignore it.

    `newton=None` is for work offline: Newton shooting until converged, `steps` eighth-order steps along the unit-time
    geodesic. A number is for real time: exactly that many corrections and `steps` fourth-order steps, all static, so
    that it can be exported.
    """

    newton: int | None = None
    steps: int = 8


class Shot(NamedTuple):
    """A geodesic from p to q over unit time: its velocity at p (`log_p q`) and at q, and how well it was found.

    `residual` is the metric length by which the geodesic misses q; `result` is a `covariant.Result` code.
    """

    velocity: Vector
    arrival: Vector
    residual: Scalar
    result: Code


class Transported(NamedTuple):
    """Where a unit-time geodesic ends, its velocity there, and the vectors carried along in parallel."""

    q: Vector
    velocity: Vector
    w: Vectors


class AbstractMetric(eqx.Module):
    """A Riemannian metric in coordinates, with every operation the library needs."""

    @abc.abstractmethod
    def __call__(self, q: Vector) -> Matrix:
        """The metric's matrix at q."""

    @abc.abstractmethod
    def christoffel(self, q: Vector, x: Vector, y: Vector) -> Vector:
        """`Γ(q)(x, y)`."""

    @abc.abstractmethod
    def curvature(self, q: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
        """`R(x, y)z`."""

    @abc.abstractmethod
    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget) -> Transported:
        """Follow the geodesic of that velocity for unit time, carrying the vectors w (..., n) in parallel."""

    @abc.abstractmethod
    def shoot(self, p: Vector, q: Vector, guess: Vector | None, budget: Budget) -> Shot:
        """The geodesic from p to q."""


def as_metric(metric: AbstractMetric | MatrixField) -> AbstractMetric:
    """Give a plain callable `q -> (n, n)` the derived operations; an `AbstractMetric` is returned as it is."""
    from covariant.geometry._numeric import Metric

    return metric if isinstance(metric, AbstractMetric) else Metric(metric)


def christoffel(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector) -> Vector:
    """Christoffel contraction `Γ(q)(x, y)`, symmetric in x and y, so that `∇_q̇ w = ẇ + Γ(q̇, w)`."""
    return as_metric(metric).christoffel(q, x, y)


def curvature(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
    """Riemann curvature `R(x, y)z = ∇_x∇_y z − ∇_y∇_x z − ∇_[x,y] z` at q."""
    return as_metric(metric).curvature(q, x, y, z)


def inner(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector) -> Scalar:
    """`<x, y>` at q; for a kinetic-energy metric `½ <v, v>` is the kinetic energy in joule."""
    return x @ metric(q) @ y


def norm(metric: AbstractMetric | MatrixField, q: Vector, x: Vector) -> Scalar:
    """`|x|` at q, with a zero (not undefined) derivative at x = 0."""
    square = inner(metric, q, x, x)
    none = square <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))


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
    from covariant.signals import Result

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
