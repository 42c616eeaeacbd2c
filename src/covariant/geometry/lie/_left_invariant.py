"""Riemannian geometry of a group with a left-invariant metric, given by an inertia on its algebra.

All vectors are body velocities (n,): coordinates of `g⁻¹ g'`. No operation depends on its base point.

Source: Maithripala, Berg & Dayawansa 2004, section II, equations (1)–(11), corrected: the curvature (6)–(8) counts a
term up to four times; the gradient of the squared distance is the Riemannian logarithm, not the group's.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from covariant._linalg import solve
from covariant._typing import Element, Matrix, Vector
from covariant.geometry._space import AbstractSpace
from covariant.geometry.lie._group import AbstractGroup


class AbstractInertia(eqx.Module):
    """A symmetric positive definite map from velocities to momenta; a large one need not be stored as a matrix."""

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
        # In NumPy where the numbers are known: compiling a JAX program for each of the many small steps takes a second.
        inverse = _inverse(self.matrix) if isinstance(self.matrix, Tracer) else np.linalg.inv(np.asarray(self.matrix))
        self.inverse = jnp.asarray((inverse + inverse.T) / 2)

    def __call__(self, x: Vector) -> Vector:
        return self.matrix @ x

    def solve(self, mu: Vector) -> Vector:
        return self.inverse @ mu


def _inverse(matrix: Matrix) -> Matrix:
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


class LeftInvariant(AbstractSpace):
    """The left-invariant metric of an inertia: a matrix (n, n) or an `AbstractInertia`.

    In the body frame every operation is the same at all points.
    """

    group: AbstractGroup
    inertia: AbstractInertia

    def __init__(self, group: AbstractGroup, inertia):
        self.group = group
        self.inertia = inertia if isinstance(inertia, AbstractInertia) else Inertia(inertia)
        n = group.dimension
        if isinstance(self.inertia, Inertia) and self.inertia.matrix.shape != (n, n):
            raise ValueError(f"inertia: the group needs a matrix ({n}, {n}); got {self.inertia.matrix.shape}")

    @property
    def manifold(self) -> AbstractGroup:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.group

    @property
    def homogeneous(self) -> bool:
        return True

    def lower(self, x: Element, a: Vector) -> Vector:
        return self.inertia(a)

    def raise_(self, x: Element, mu: Vector) -> Vector:
        return self.inertia.solve(mu)

    def connection_force(self, x: Element, a: Vector, b: Vector) -> Vector:
        """`½(I[a, b] − ad*_a I b − ad*_b I a)`, the covector of the connection."""
        return (self.inertia(self.group.lie_bracket(a, b)) - self._coadjoint_sum(a, b)) / 2

    def kinetic_force(self, x: Element, v: Vector) -> Vector:
        return jnp.zeros_like(v)

    def connection(self, x: Element, a: Vector, b: Vector) -> Vector:
        """`B(a, b) = ½([a, b] − I⁻¹(ad*_a I b + ad*_b I a))` of left-invariant fields; equation (3)."""
        return (self.group.lie_bracket(a, b) - self.inertia.solve(self._coadjoint_sum(a, b))) / 2

    def curvature(self, x: Element, a: Vector, b: Vector, c: Vector) -> Vector:
        """`R(a, b)c = B(a, B(b, c)) − B(b, B(a, c)) − B([a, b], c)`."""
        along = jax.jit(lambda d, e: self.connection(x, d, e))  # traced once, not at each of the five places
        return along(a, along(b, c)) - along(b, along(a, c)) - along(self.group.lie_bracket(a, b), c)

    def _coadjoint_sum(self, a: Vector, b: Vector) -> Vector:
        return self.group.coadjoint(a, self.inertia(b)) + self.group.coadjoint(b, self.inertia(a))
