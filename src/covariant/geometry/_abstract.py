"""What a metric is, and what a search along it returns.

A metric is any callable `q (n,) -> (n, n)`. An `AbstractMetric` knows every operation the library needs, from closed
forms, the recursions of a robot, or automatic derivatives (`Metric`). Everything is directional: no array of n³ entries
exists.

Source: Aghannan & Rouchon 2003, section II. Curvature sign: on the unit sphere `R(x, y)z = <y, z>x − <x, z>y`.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

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


def inner(metric: AbstractMetric | MatrixField, q: Vector, x: Vector, y: Vector) -> Scalar:
    """`<x, y>` at q; for a kinetic-energy metric `½ <v, v>` is the kinetic energy in joule."""
    return x @ metric(q) @ y


def norm(metric: AbstractMetric | MatrixField, q: Vector, x: Vector) -> Scalar:
    """`|x|` at q, with a zero (not undefined) derivative at x = 0."""
    square = inner(metric, q, x, x)
    none = square <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))
