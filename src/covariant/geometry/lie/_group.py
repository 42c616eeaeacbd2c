"""What a Lie group is to this library: matrices that multiply, and an algebra of real vectors.

Elements are matrices (N, N), so that `g @ h` composes them; elements of the algebra are their coordinates x (n,), real
also for complex groups. Everything is directional, and the closed forms make no array of n² entries. Batches come from
`jax.vmap`.

Source: Maithripala, Berg & Dayawansa 2004, section II; Chirikjian 2012, Stochastic Models, Information Theory, and Lie
Groups, chapter 10, for the Jacobians.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from covariant._typing import Element, Flag, Vector


class AbstractGroup(eqx.Module):
    """A matrix Lie group with left translation as its trivialisation: velocities are `g' = g hat(x)`."""

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """Dimension n of the group and length of the vectors of its algebra."""

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Number N of rows of its matrices."""

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        """Which entries of x (n,) are rotation vectors [rad]; None where that is not known of a group.

        Where all of them are shorter than π, `exp` is undone by `log`, smoothly.
        """
        return None

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
        """Where the one-parameter group with velocity x is after unit time."""

    @abc.abstractmethod
    def log(self, g: Element) -> Vector:
        """The principal logarithm: the shortest x with `exp(x) = g`.

        Where two are as short, as after half a turn, one of them is returned, but which one jumps there. Only a
        `MatrixGroup` has elements without.
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
        """The neutral element; `dtype` is the real one of the coordinates."""
        return jnp.eye(self.order, dtype=self.hat(jnp.zeros(self.dimension, dtype)).dtype)

    def compose(self, g: Element, h: Element) -> Element:
        """The product `g h`, the same as `g @ h`."""
        return g @ h

    def between(self, g: Element, h: Element) -> Vector:
        """`log(g⁻¹ h)`: the body velocity that leads from g to h in unit time."""
        return self.log(self.inverse(g) @ h)

    def left_jacobian(self, x: Vector, y: Vector) -> Vector:
        """`J_l(x)y = J_r(−x)y`: the spatial velocity `D exp(x)[y] exp(x)⁻¹`."""
        return self.right_jacobian(-x, y)

    def left_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """`J_l(x)⁻¹y`."""
        return self.right_jacobian_inverse(-x, y)

    def adjoint(self, g: Element, x: Vector) -> Vector:
        """`Ad_g x`: a body velocity x at g as seen from the other side, `g hat(x) g⁻¹`."""
        return self.vee(g @ self.hat(x) @ self.inverse(g))

    def coadjoint(self, x: Vector, mu: Vector) -> Vector:
        """`ad*_x μ`, with `<ad*_x μ, y> = <μ, [x, y]>`."""
        return jax.linear_transpose(lambda y: self.lie_bracket(x, y), x)(mu)[0]

    def coadjoint_action(self, g: Element, mu: Vector) -> Vector:
        """`Ad*_g μ`, with `<Ad*_g μ, y> = <μ, Ad_g y>`: a momentum carried along by the motion."""
        return jax.linear_transpose(lambda y: self.adjoint(g, y), mu)(mu)[0]

    @abc.abstractmethod
    def act(self, g: Element, point: Inexact[Array, "d"]) -> Inexact[Array, "d"]:
        """Where g takes a point of the space the group moves."""

    @abc.abstractmethod
    def defect(self, g: Element) -> Array:
        """How far a matrix is from the group: the largest entry by which it breaks the group's equations."""

    @abc.abstractmethod
    def unique_log(self, g: Element) -> Flag:
        """False within rounding of the cut locus, where a second logarithm is as short as `log(g)`."""

    def contains(self, g: Element, tolerance: float) -> Flag:
        """Whether a matrix is an element of the group to that tolerance; False where it is not finite."""
        return self.defect(g) <= tolerance
