"""Defines the interface of a Lie group: matrices that are multiplied, and an algebra of real vectors.

Elements are matrices (N, N), so that `g @ h` composes them. Elements of the algebra are represented by coordinates x
(n,), which are real also for complex groups. Every operation is directional, and closed forms need no array of n²
entries. Use `jax.vmap` for batches.

Source: Maithripala, Berg & Dayawansa 2004, section II; Chirikjian 2012, Stochastic Models, Information Theory, and Lie
Groups, chapter 10, for the Jacobians.
"""

import abc

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Inexact

from covariant._linalg import traced_once
from covariant._typing import Element, Flag, Vector
from covariant.geometry._manifold import AbstractManifold
from scalargraph.errors import InputError


class AbstractGroup(AbstractManifold):
    """A matrix Lie group, trivialised by left translation: velocities are `g' = g hat(x)`, in the body frame.

    As a manifold its frame is the body frame, and its retraction follows one-parameter groups.

    Example:
        The body velocity from one element to another, on any group:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import lie
        >>> def velocity(group: lie.AbstractGroup, g, h):
        ...     return group.log(group.compose(group.inverse(g), h))
        >>> g, h = (lie.SO2.exp(jnp.array([angle])) for angle in (0.5, 0.75))
        >>> round(float(velocity(lie.SO2, g, h)[0]), 9)
        0.25
    """

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """Dimension n of the group and length of the vectors of its algebra."""

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Number N of rows of its matrices."""

    @abc.abstractmethod
    def hat(self, x: Vector) -> Element:
        """Matrix (N, N) of the algebra with the coordinates x (n,)."""

    @abc.abstractmethod
    def vee(self, matrix: Element) -> Vector:
        """Coordinates (n,) of a matrix (N, N) of the algebra; any other matrix is projected to the algebra first."""

    @abc.abstractmethod
    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        """Lie bracket `[x, y] = ad_x y`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            y: coordinates (n,) of another one.

        Returns:
            Coordinates (n,) of the commutator of the two matrices.
        """

    @abc.abstractmethod
    def exp(self, x: Vector) -> Element:
        """Exponential: the element reached after unit time along the one-parameter group with velocity x.

        Args:
            x: velocity (n,), coordinates in the algebra.

        Returns:
            Element (N, N).
        """

    @abc.abstractmethod
    def log(self, g: Element) -> Vector:
        """Principal logarithm: the shortest x with `exp(x) = g`.

        If two are equally short, as after half a turn, one of them is returned, and the choice is discontinuous there.
        Only in a `MatrixGroup` can an element have no logarithm.

        Args:
            g: element (N, N).

        Returns:
            Coordinates x (n,) in the algebra.
        """

    @abc.abstractmethod
    def inverse(self, g: Element) -> Element:
        """Inverse (N, N) of the element g."""

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        """Right Jacobian `J_r(x)y` of the exponential: the body velocity of `exp(x(t))` where x' = y.

        It is `exp(x)⁻¹ D exp(x)[y]`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            y: derivative x' (n,).

        Returns:
            Body velocity (n,).
        """
        # Using the inverse of the matrix exp(x) instead would lose twice as many digits.
        return self.vee(self.exp(-x) @ jax.jvp(self.exp, (x,), (y,))[1])

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """Inverse `J_r(x)⁻¹y` of the right Jacobian: the x' for which y is the body velocity of `exp(x(t))`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            y: body velocity (n,).

        Returns:
            Derivative x' (n,).
        """
        # By the matrix (n, n) of J_r: no series for the inverse converges everywhere that the inverse exists.
        one = jnp.eye(x.shape[0], dtype=x.dtype)
        return jnp.linalg.solve(jax.vmap(lambda e: self.right_jacobian(x, e), out_axes=1)(one), y)

    def identity(self, dtype: jax.typing.DTypeLike = float) -> Element:
        """Neutral element of the group.

        Args:
            dtype: real type of the coordinates, double precision by default.

        Returns:
            Identity matrix (N, N), complex for a complex group.
        """
        return jnp.eye(self.order, dtype=self.hat(jnp.zeros(self.dimension, dtype)).dtype)

    def compose(self, g: Element, h: Element) -> Element:
        """Product `g h` of two elements (N, N), the same as `g @ h`."""
        return g @ h

    def between(self, g: Element, h: Element) -> Vector:
        """Body velocity `log(g⁻¹ h)` that takes g to h in unit time.

        Args:
            g: element (N, N).
            h: element (N, N).

        Returns:
            Coordinates (n,) in the algebra.
        """
        return self.log(self.inverse(g) @ h)

    def left_jacobian(self, x: Vector, y: Vector) -> Vector:
        """Left Jacobian `J_l(x)y = J_r(−x)y` of the exponential: the spatial velocity `D exp(x)[y] exp(x)⁻¹`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            y: derivative x' (n,).

        Returns:
            Spatial velocity (n,).
        """
        return self.right_jacobian(-x, y)

    def left_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """Inverse `J_l(x)⁻¹y` of the left Jacobian: the x' for which y is the spatial velocity of `exp(x(t))`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            y: spatial velocity (n,).

        Returns:
            Derivative x' (n,).
        """
        return self.right_jacobian_inverse(-x, y)

    def adjoint(self, g: Element, x: Vector) -> Vector:
        """Adjoint action `Ad_g x`: a body velocity x at g, expressed in the space frame.

        Args:
            g: element (N, N).
            x: body velocity (n,).

        Returns:
            Coordinates (n,) of `g hat(x) g⁻¹`.
        """
        return self.vee(g @ self.hat(x) @ self.inverse(g))

    def coadjoint(self, x: Vector, mu: Vector) -> Vector:
        """Coadjoint operator `ad*_x μ` of the algebra, with `<ad*_x μ, y> = <μ, [x, y]>`.

        Args:
            x: coordinates (n,) of an element of the algebra.
            mu: momentum μ (n,).

        Returns:
            Covector (n,).
        """
        return jax.linear_transpose(lambda y: self.lie_bracket(x, y), x)(mu)[0]

    def coadjoint_action(self, g: Element, mu: Vector) -> Vector:
        """Coadjoint action `Ad*_g μ` on a momentum, with `<Ad*_g μ, y> = <μ, Ad_g y>`.

        Args:
            g: element (N, N).
            mu: momentum μ (n,).

        Returns:
            Covector (n,).
        """
        return jax.linear_transpose(lambda y: self.adjoint(g, y), mu)(mu)[0]

    def act(self, g: Element, point: Inexact[Array, "d"]) -> Inexact[Array, "d"]:
        """Image of a point under g.

        Args:
            g: element (N, N).
            point: point (d,) of the space that the group acts on.

        Returns:
            Point (d,), by default `g @ point`.
        """
        return g @ point

    @abc.abstractmethod
    def defect(self, g: Element) -> Array:
        """Distance of a matrix from the group.

        Args:
            g: matrix (N, N).

        Returns:
            The largest residual of the group's equations, a scalar.
        """

    @abc.abstractmethod
    def unique_log(self, g: Element) -> Flag:
        """Whether `log(g)` is the only shortest logarithm of g (N, N).

        Returns:
            False, to within rounding, on the cut locus, where a second logarithm is equally short; else True.
        """

    def contains(self, g: Element, tolerance: float) -> Flag:
        """Whether a matrix is an element of the group.

        Args:
            g: matrix (N, N).
            tolerance: largest `defect` of an element.

        Returns:
            Whether it is; False if it is not finite.
        """
        # A comparison with NaN is False, so a matrix that contains NaN is not an element.
        return self.defect(g) <= tolerance

    # As a manifold: the frame is the body frame, and the retraction follows one-parameter groups.

    @property
    def shape(self) -> tuple[int, int]:
        return (self.order, self.order)

    def origin(self, dtype: jax.typing.DTypeLike = float) -> Element:
        return self.identity(dtype)

    def zero(self, x: Element) -> Vector:
        # Velocities are real, even if the matrices are complex.
        return jnp.zeros(self.dimension, jnp.finfo(x.dtype).dtype)

    def tangent(self, x: Element, a: Vector) -> Element:
        # Left translation: the velocity a is in the body frame, so its matrix multiplies x from the right.
        return x @ self.hat(a)

    def components(self, x: Element, rate: Element) -> Vector:
        return self.vee(self.inverse(x) @ rate)

    def bracket(self, x: Element, a: Vector, b: Vector) -> Vector:
        return self.lie_bracket(a, b)

    def retract(self, x: Element, s: Vector) -> Element:
        return x @ self.exp(s)

    def local(self, x: Element, y: Element) -> Vector:
        return self.between(x, y)

    # The body velocity of x exp(s) is exp(−s) D exp(s)[s'], which does not depend on x.
    def frame_velocity(self, x: Element, s: Vector, rate: Vector) -> Vector:
        return self.right_jacobian(s, rate)

    def local_rate(self, x: Element, s: Vector, velocity: Vector) -> Vector:
        return self.right_jacobian_inverse(s, velocity)

    # The curve t ↦ x exp(ta) has the constant body velocity a.
    def retraction_acceleration(self, x: Element, a: Vector) -> Vector:
        return jnp.zeros_like(a)

    def carried_momentum(self, x: Element, s: Vector, mu: Vector) -> Vector:
        # The body frame at x exp(s) is the one at x moved by exp(s); momenta transform by the transpose of Ad.
        return self.coadjoint_action(self.exp(s), mu)

    def missing(self, y: Element) -> Bool[Array, "n"]:
        """Mask (n,), all True or all False: an element that contains NaN is missing as a whole."""
        return jnp.broadcast_to(jnp.any(jnp.isnan(y)), (self.dimension,))

    def towards(self, x: Element, y: Element) -> Vector:
        return self.local(x, self.measured(x, y))

    def measured(self, x: Element, y: Element) -> Element:
        return jnp.where(jnp.any(jnp.isnan(y)), x, y)

    def unique(self, x: Element, y: Element) -> Flag:
        return self.unique_log(self.inverse(x) @ y)

    @traced_once
    def admitted(self, y: Array) -> Array:
        # The tolerance is a hundred times the square root of rounding: rotations in single precision pass, too.
        tolerance = 100 * float(jnp.finfo(y.dtype).eps) ** 0.5
        return jnp.where(self.contains(y, tolerance) | jnp.any(jnp.isnan(y)), y, jnp.nan)

    def checked(self, y: Array) -> Array:
        valid = self.admitted(super().checked(y))
        # The numbers of a traced array are unknown; there NaN reports the error, see `AbstractManifold.checked`.
        if not isinstance(valid, Tracer) and np.isnan(valid).any():
            raise InputError("the configuration is not an element of the group; pass rotations as matrices")
        return valid
