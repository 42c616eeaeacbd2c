"""Riemannian geometry of a group whose metric is an inertia on its algebra, moved about by left translation.

All vectors are body velocities x (n,): coordinates of `g⁻¹ g'`. The base point matters nowhere, so it is no argument.

Source: Maithripala, Berg & Dayawansa 2004, section II, equations (1)–(11), corrected: the curvature (6)–(8) counts a
term up to four times; the gradient of the squared distance is the Riemannian logarithm, not the group's.
"""

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from covariant._linalg import solve
from covariant._typing import Element, Matrix, Scalar, Vector, Vectors
from covariant.geometry._abstract import AbstractMetric, Budget, Shot, Transported
from covariant.geometry._numeric import follow, shoot
from covariant.geometry.lie._group import AbstractGroup


class AbstractInertia(eqx.Module):
    """A symmetric positive definite map from velocities to momenta; large ones need not be matrices."""

    @abc.abstractmethod
    def __call__(self, x: Vector) -> Vector:
        """The momentum `I x` of a velocity."""

    @abc.abstractmethod
    def solve(self, mu: Vector) -> Vector:
        """The velocity `I⁻¹ μ` of a momentum."""


class Inertia(AbstractInertia):
    """An inertia given by its matrix (n, n), such as diag(m, m, m, I₁, I₂, I₃) for the twist (v, ω) of a body.

    Raises `ValueError` unless the matrix is symmetric and positive definite.
    """

    matrix: Matrix
    inverse: Matrix

    def __init__(self, matrix):
        matrix = jnp.asarray(matrix)
        self.matrix = matrix if jnp.issubdtype(matrix.dtype, jnp.floating) else matrix.astype(float)
        if self.matrix.ndim != 2 or self.matrix.shape[0] != self.matrix.shape[1]:
            raise ValueError(f"inertia: the matrix must have shape (n, n); got {self.matrix.shape}")
        if not isinstance(self.matrix, Tracer):
            given = np.asarray(self.matrix)
            if not np.abs(given - given.T).max() <= 1e-6 * np.abs(given).max():
                raise ValueError("inertia: the matrix is not symmetric")
            least = float(np.linalg.eigvalsh(given)[0])
            if not least > 0:
                raise ValueError(f"inertia: the matrix must be positive definite; its least eigenvalue is {least:.3g}")
        inverse = solve(self.matrix, jnp.eye(self.matrix.shape[0], dtype=self.matrix.dtype))
        self.inverse = (inverse + inverse.T) / 2

    def __call__(self, x: Vector) -> Vector:
        return self.matrix @ x

    def solve(self, mu: Vector) -> Vector:
        return self.inverse @ mu


class Carried(NamedTuple):
    """Where a unit-time geodesic from the identity ends, its body velocity there, and vectors carried in parallel."""

    g: Element
    velocity: Vector
    w: Vectors


class LeftInvariant(eqx.Module):
    """The left-invariant metric of an inertia: a matrix (n, n) or an `AbstractInertia`."""

    group: AbstractGroup
    inertia: AbstractInertia

    def __init__(self, group: AbstractGroup, inertia):
        self.group = group
        self.inertia = inertia if isinstance(inertia, AbstractInertia) else Inertia(inertia)
        n = group.dimension
        if isinstance(self.inertia, Inertia) and self.inertia.matrix.shape != (n, n):
            raise ValueError(f"inertia: the group needs a matrix ({n}, {n}); got {self.inertia.matrix.shape}")

    def inner(self, x: Vector, y: Vector) -> Scalar:
        """`<x, y> = x · I y`."""
        return x @ self.inertia(y)

    def norm(self, x: Vector) -> Scalar:
        """`|x|`, with a zero (not undefined) derivative at x = 0."""
        square = self.inner(x, x)
        none = square <= 0
        return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))

    def connection(self, x: Vector, y: Vector) -> Vector:
        """`B(x, y) = ∇_x y = ½([x, y] − I⁻¹(ad*_x I y + ad*_y I x))` of left-invariant fields; equation (3)."""
        momenta = self.group.coadjoint(x, self.inertia(y)) + self.group.coadjoint(y, self.inertia(x))
        return (self.group.lie_bracket(x, y) - self.inertia.solve(momenta)) / 2

    def spray(self, x: Vector) -> Vector:
        """`−B(x, x) = I⁻¹ ad*_x I x`, the acceleration of free motion (Euler–Poincaré); equation (16)."""
        return self.inertia.solve(self.group.coadjoint(x, self.inertia(x)))

    def curvature(self, x: Vector, y: Vector, z: Vector) -> Vector:
        """`R(x, y)z = B(x, B(y, z)) − B(y, B(x, z)) − B([x, y], z)`."""
        b = self.connection
        return b(x, b(y, z)) - b(y, b(x, z)) - b(self.group.lie_bracket(x, y), z)

    def transport_along(self, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Carried:
        """Follow the geodesic of that body velocity from the identity for unit time, carrying w (..., n) along."""
        end = self.chart.transport_along(jnp.zeros_like(velocity), velocity, w, budget)
        carried = _each(lambda a: self.group.right_jacobian(end.q, a), end.w)
        return Carried(self.group.exp(end.q), self.group.right_jacobian(end.q, end.velocity), carried)

    def exp(self, velocity: Vector, budget: Budget = Budget()) -> Element:
        """Riemannian exponential at the identity."""
        return self.transport_along(velocity, jnp.zeros((0, *velocity.shape), velocity.dtype), budget).g

    def shoot(self, g: Element, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        """The geodesic from the identity to g, found by Newton's method from the group logarithm or the guess.

        Its velocities are body velocities at either end.
        """
        q = self.group.log(g)
        shot = self.chart.shoot(jnp.zeros_like(q), q, guess, budget)
        return shot._replace(arrival=self.group.right_jacobian(q, shot.arrival))

    @property
    def chart(self) -> "ExponentialChart":
        """The same metric in the coordinates `x -> exp(x)`, for everything that needs coordinates."""
        return ExponentialChart(self)


class ExponentialChart(AbstractMetric):
    """A left-invariant metric in exponential coordinates (of the first kind), regular for rotations below 2π."""

    metric: LeftInvariant

    def __call__(self, q: Vector) -> Matrix:
        jacobian = jax.vmap(lambda e: self.metric.group.right_jacobian(q, e))(jnp.eye(q.shape[0], dtype=q.dtype))
        return jacobian @ jax.vmap(self.metric.inertia)(jacobian).T

    def christoffel(self, q: Vector, x: Vector, y: Vector) -> Vector:
        """`∇_x y` of fields with constant coordinates, carried to the body and back."""
        body_y, change = jax.jvp(lambda p: self.metric.group.right_jacobian(p, y), (q,), (x,))
        body_x = self.metric.group.right_jacobian(q, x)
        return self.metric.group.right_jacobian_inverse(q, change + self.metric.connection(body_x, body_y))

    def curvature(self, q: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
        bodies = (self.metric.group.right_jacobian(q, a) for a in (x, y, z))
        return self.metric.group.right_jacobian_inverse(q, self.metric.curvature(*bodies))

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget) -> Transported:
        """The Euler–Poincaré equation in the body, the coordinates beside it."""
        group, metric = self.metric.group, self.metric

        def flow(_, x: Transported) -> Transported:
            carried = _each(lambda a: -metric.connection(x.velocity, a), x.w)
            return Transported(group.right_jacobian_inverse(x.q, x.velocity), metric.spray(x.velocity), carried)

        start = Transported(p, group.right_jacobian(p, velocity), _each(lambda a: group.right_jacobian(p, a), w))
        end = follow(budget, flow, start)
        back = _each(lambda a: group.right_jacobian_inverse(end.q, a), end.w)
        return Transported(end.q, group.right_jacobian_inverse(end.q, end.velocity), back)

    def shoot(self, p: Vector, q: Vector, guess: Vector | None, budget: Budget) -> Shot:
        return shoot(self, p, q, guess, budget)


def _each(operation: Callable[[Array], Array], w: Vectors) -> Vectors:
    """The operation applied to each of the vectors w (..., n), of which there may be none."""
    return jax.vmap(operation)(w.reshape(-1, w.shape[-1])).reshape(w.shape)
