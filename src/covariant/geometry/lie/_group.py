"""The interface of a Lie group in this library: matrices that are multiplied, and an algebra of real vectors.

Elements are matrices (N, N), so that `g @ h` composes them. Elements of the algebra are given by coordinates x (n,),
real also for complex groups. Every operation is directional, and the closed forms form no array of n² entries. Batches
come from `jax.vmap`.

Source: Maithripala, Berg & Dayawansa 2004, section II; Chirikjian 2012, Stochastic Models, Information Theory, and Lie
Groups, chapter 10, for the Jacobians.
"""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Inexact

from covariant._linalg import traced_once
from covariant._typing import Element, Flag, Vector
from covariant.geometry._manifold import AbstractManifold


class AbstractGroup(AbstractManifold):
    """A matrix Lie group, trivialised by left translation: velocities are `g' = g hat(x)`, in the body frame."""

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
        """The algebra's matrix with coordinates x (n,)."""

    @abc.abstractmethod
    def vee(self, matrix: Element) -> Vector:
        """Coordinates of a matrix of the algebra; of any other matrix, those of its projection."""

    @abc.abstractmethod
    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        """`[x, y] = ad_x y`, coordinates of the commutator of the matrices."""

    @abc.abstractmethod
    def exp(self, x: Vector) -> Element:
        """The element reached after unit time along the one-parameter group with velocity x."""

    @abc.abstractmethod
    def log(self, g: Element) -> Vector:
        """The principal logarithm: the shortest x with `exp(x) = g`.

        Where two are equally short, as after half a turn, one of them is returned, and the choice is discontinuous
        there. Only a `MatrixGroup` has elements without a logarithm.
        """

    @abc.abstractmethod
    def inverse(self, g: Element) -> Element:
        """The inverse element."""

    @abc.abstractmethod
    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        """`J_r(x)y`: the body velocity of `exp(x(t))` where x' = y, `exp(x)⁻¹ D exp(x)[y]`."""

    @abc.abstractmethod
    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """`J_r(x)⁻¹y`: the velocity x' that makes y the body velocity of `exp(x(t))`."""

    def identity(self, dtype: Any = float) -> Element:
        """The neutral element; `dtype` is the real type of the coordinates."""
        return jnp.eye(self.order, dtype=self.hat(jnp.zeros(self.dimension, dtype)).dtype)

    def compose(self, g: Element, h: Element) -> Element:
        """The product `g h`, the same as `g @ h`."""
        return g @ h

    def between(self, g: Element, h: Element) -> Vector:
        """`log(g⁻¹ h)`: the body velocity that takes g to h in unit time."""
        return self.log(self.inverse(g) @ h)

    def left_jacobian(self, x: Vector, y: Vector) -> Vector:
        """`J_l(x)y = J_r(−x)y`: the spatial velocity `D exp(x)[y] exp(x)⁻¹`."""
        return self.right_jacobian(-x, y)

    def left_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """`J_l(x)⁻¹y`."""
        return self.right_jacobian_inverse(-x, y)

    def adjoint(self, g: Element, x: Vector) -> Vector:
        """`Ad_g x`, the coordinates of `g hat(x) g⁻¹`: a body velocity x at g in the space frame."""
        return self.vee(g @ self.hat(x) @ self.inverse(g))

    def coadjoint(self, x: Vector, mu: Vector) -> Vector:
        """`ad*_x μ`, with `<ad*_x μ, y> = <μ, [x, y]>`."""
        return jax.linear_transpose(lambda y: self.lie_bracket(x, y), x)(mu)[0]

    def coadjoint_action(self, g: Element, mu: Vector) -> Vector:
        """`Ad*_g μ`, with `<Ad*_g μ, y> = <μ, Ad_g y>`: the coadjoint action on a momentum."""
        return jax.linear_transpose(lambda y: self.adjoint(g, y), mu)(mu)[0]

    @abc.abstractmethod
    def act(self, g: Element, point: Inexact[Array, "d"]) -> Inexact[Array, "d"]:
        """The image under g of a point of the space that the group acts on."""

    @abc.abstractmethod
    def defect(self, g: Element) -> Array:
        """Distance of a matrix from the group: the largest entry by which it violates the equations of the group."""

    @abc.abstractmethod
    def unique_log(self, g: Element) -> Flag:
        """False, to within rounding, on the cut locus, where a second logarithm is as short as `log(g)`."""

    def contains(self, g: Element, tolerance: float) -> Flag:
        """Whether a matrix is an element of the group to that tolerance; False where it is not finite."""
        return self.defect(g) <= tolerance

    # As a manifold: the frame is the body frame, and the retraction follows one-parameter groups.

    @property
    def shape(self) -> tuple[int, int]:
        return (self.order, self.order)

    def origin(self, dtype: Any = float) -> Element:
        return self.identity(dtype)

    def zero(self, x: Element) -> Vector:
        return jnp.zeros(self.dimension, jnp.finfo(x.dtype).dtype)

    def tangent(self, x: Element, a: Vector) -> Element:
        return x @ self.hat(a)

    def components(self, x: Element, rate: Element) -> Vector:
        return self.vee(self.inverse(x) @ rate)

    def bracket(self, x: Element, a: Vector, b: Vector) -> Vector:
        return self.lie_bracket(a, b)

    def retract(self, x: Element, s: Vector) -> Element:
        return x @ self.exp(s)

    def local(self, x: Element, y: Element) -> Vector:
        return self.between(x, y)

    def frame_velocity(self, x: Element, s: Vector, rate: Vector) -> Vector:
        return self.right_jacobian(s, rate)

    def local_rate(self, x: Element, s: Vector, velocity: Vector) -> Vector:
        return self.right_jacobian_inverse(s, velocity)

    def retraction_acceleration(self, x: Element, a: Vector) -> Vector:
        return jnp.zeros_like(a)

    def carried_momentum(self, x: Element, s: Vector, mu: Vector) -> Vector:
        return self.coadjoint_action(self.exp(s), mu)

    def missing(self, y: Element) -> Bool[Array, "n"]:
        """All or none: an element with a NaN in it is missing as a whole."""
        return jnp.broadcast_to(jnp.any(jnp.isnan(y)), (self.dimension,))

    def towards(self, x: Element, y: Element) -> Vector:
        return self.local(x, self.measured(x, y))

    def measured(self, x: Element, y: Element) -> Element:
        return jnp.where(jnp.any(jnp.isnan(y)), x, y)

    def unique(self, x: Element, y: Element) -> Flag:
        return self.unique_log(self.inverse(x) @ y)

    @traced_once
    def admitted(self, y: Array) -> Array:
        tolerance = 100 * float(jnp.finfo(y.dtype).eps) ** 0.5
        return jnp.where(self.contains(y, tolerance) | jnp.any(jnp.isnan(y)), y, jnp.nan)

    def checked(self, y: Array) -> Array:
        found = self.admitted(super().checked(y))
        if not isinstance(found, Tracer) and np.isnan(found).any():
            raise ValueError("the configuration is not an element of the group; pass rotations as matrices")
        return found
