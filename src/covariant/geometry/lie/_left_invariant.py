"""Riemannian geometry of a Lie group whose left-invariant metric is defined by an inertia on its algebra.

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
from scalargraph.errors import InputError


class AbstractInertia(eqx.Module):
    """A symmetric positive definite map from velocities to momenta; it need not be stored as a matrix.

    Example:
        A subclass for equal principal moments of inertia [kg m²]:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import lie
        >>> class Ball(lie.AbstractInertia):
        ...     moment: float
        ...     def __call__(self, x):
        ...         return self.moment * x
        ...     def solve(self, mu):
        ...         return mu / self.moment
        >>> space = lie.LeftInvariant(lie.SO3, Ball(0.5))
        >>> omega = jnp.array([0.0, 0.0, 2.0])  # rad/s
        >>> float(space.inner(jnp.eye(3), omega, omega) / 2)  # kinetic energy [J]
        1.0
    """

    @abc.abstractmethod
    def __call__(self, x: Vector) -> Vector:
        """Momentum `I x` (n,) of a velocity x (n,)."""

    @abc.abstractmethod
    def solve(self, mu: Vector) -> Vector:
        """Velocity `I⁻¹ μ` (n,) of a momentum μ (n,)."""


class Inertia(AbstractInertia):
    """An inertia defined by its matrix (n, n), such as diag(m, m, m, I₁, I₂, I₃) for the twist (v, ω) of a body.

    Args:
        matrix: symmetric positive definite matrix (n, n), for SE(3) in [kg] and [kg m²].

    Attributes:
        matrix: the matrix, as floating-point numbers.
        inverse: its inverse matrix (n, n), exactly symmetric.

    Raises:
        ValueError: the matrix is not square, symmetric and positive definite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import Inertia
        >>> inertia = Inertia(jnp.diag(jnp.array([1.0, 2.0, 4.0])))
        >>> inertia(jnp.ones(3)).tolist(), inertia.solve(jnp.ones(3)).tolist()
        ([1.0, 2.0, 4.0], [1.0, 0.5, 0.25])
    """

    matrix: Matrix
    inverse: Matrix

    def __init__(self, matrix):
        matrix = jnp.asarray(matrix)
        self.matrix = matrix if jnp.issubdtype(matrix.dtype, jnp.floating) else matrix.astype(float)
        if self.matrix.ndim != 2 or self.matrix.shape[0] != self.matrix.shape[1]:
            raise InputError(f"inertia: the matrix must have shape (n, n); got {self.matrix.shape}")
        if not isinstance(self.matrix, Tracer):
            values = np.asarray(self.matrix)
            # Written as `not … <=`, so that NaN is refused too.
            if not np.abs(values - values.T).max() <= 1e-6 * np.abs(values).max():
                raise InputError("inertia: the matrix is not symmetric")
            least = float(np.linalg.eigvalsh(values)[0])
            if not least > 0:
                raise InputError(f"inertia: the matrix must be positive definite; its least eigenvalue is {least:.3g}")
        # NumPy inverts known numbers, since JAX would take a second to compile a program for each small step.
        inverse = _inverse(self.matrix) if isinstance(self.matrix, Tracer) else np.linalg.inv(np.asarray(self.matrix))
        # The inverse is symmetric but its rounding is not; symmetrised, `raise_` is self-adjoint as `lower` is.
        self.inverse = jnp.asarray((inverse + inverse.T) / 2)

    def __call__(self, x: Vector) -> Vector:
        return self.matrix @ x

    def solve(self, mu: Vector) -> Vector:
        return self.inverse @ mu


def _inverse(matrix: Matrix) -> Matrix:
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


class LeftInvariant(AbstractSpace):
    """The left-invariant metric of an inertia on a Lie group.

    In the body frame every operation is the same at all points.

    Use it for the kinetic energy of a free rigid body or vehicle, whose inertia is constant in the body frame.
    `models.GroupSystem` builds it from an inertia matrix. Its geodesics are the motions without forces; in general they
    differ from `group.exp` of a constant velocity.

    Args:
        group: the group.
        inertia: matrix (n, n) or an `AbstractInertia`.

    Raises:
        ValueError: the matrix has the wrong shape, or `Inertia` refuses it.

    Example:
        A free rigid body: `−B(ω, ω)` is its angular acceleration by Euler's equations.

        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SO3, LeftInvariant
        >>> body = LeftInvariant(SO3, jnp.diag(jnp.array([1.0, 2.0, 4.0])))
        >>> omega = jnp.array([1.0, 1.0, 0.0])  # rad/s
        >>> float(-body.connection(jnp.eye(3), omega, omega)[2])
        -0.25
    """

    group: AbstractGroup
    inertia: AbstractInertia

    def __init__(self, group: AbstractGroup, inertia):
        self.group = group
        self.inertia = inertia if isinstance(inertia, AbstractInertia) else Inertia(inertia)
        n = group.dimension
        if isinstance(self.inertia, Inertia) and self.inertia.matrix.shape != (n, n):
            raise InputError(f"inertia: the group needs a matrix ({n}, {n}); got {self.inertia.matrix.shape}")

    @property
    def manifold(self) -> AbstractGroup:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.group

    def lower(self, x: Element, a: Vector) -> Vector:
        return self.inertia(a)

    def raise_(self, x: Element, mu: Vector) -> Vector:
        return self.inertia.solve(mu)

    def connection_force(self, x: Element, a: Vector, b: Vector) -> Vector:
        """Covector `½(I[a, b] − ad*_a I b − ad*_b I a)` of the connection.

        Args:
            x: element (N, N); the result does not depend on it.
            a: direction (n,).
            b: components (n,) of the differentiated left-invariant field.

        Returns:
            Covector (n,).
        """
        return (self.inertia(self.group.lie_bracket(a, b)) - self._coadjoint_sum(a, b)) / 2

    # Zero, as the energy ½<Iv, v> of a body velocity does not depend on the configuration.
    def kinetic_force(self, x: Element, v: Vector, momentum: Vector | None = None) -> Vector:
        return jnp.zeros_like(v)

    def connection(self, x: Element, a: Vector, b: Vector) -> Vector:
        """Covariant derivative of left-invariant fields; equation (3).

        It is `B(a, b) = ½([a, b] − I⁻¹(ad*_a I b + ad*_b I a))`.

        Args:
            x: element (N, N); the result does not depend on it.
            a: direction (n,).
            b: components (n,) of the differentiated field.

        Returns:
            Vector (n,).
        """
        # B(v, v) = −I⁻¹ ad*_v I v, so geodesics v' = −B(v, v) satisfy Euler's equation I v' = ad*_v I v.
        return (self.group.lie_bracket(a, b) - self.inertia.solve(self._coadjoint_sum(a, b))) / 2

    def curvature(self, x: Element, a: Vector, b: Vector, c: Vector) -> Vector:
        """Riemann curvature `R(a, b)c = B(a, B(b, c)) − B(b, B(a, c)) − B([a, b], c)`.

        Args:
            x: element (N, N); the result does not depend on it.
            a: first vector (n,) of the pair in which R is antisymmetric.
            b: second vector (n,) of this pair.
            c: vector (n,) on which R acts.

        Returns:
            Vector (n,).
        """
        along = jax.jit(lambda d, e: self.connection(x, d, e))  # traced once, although it is called five times
        # The terms ∂B of the general formula vanish, since B has the same components at every point.
        return along(a, along(b, c)) - along(b, along(a, c)) - along(self.group.lie_bracket(a, b), c)

    def _coadjoint_sum(self, a: Vector, b: Vector) -> Vector:
        return self.group.coadjoint(a, self.inertia(b)) + self.group.coadjoint(b, self.inertia(a))
