"""Rigid motions of the plane and of space, SE(2) and SE(3), with twists (v, ω): translation first.

A twist is treated as a dual number: with ε² = 0 the bracket of SE(3) is the cross product of `ω + εv`. So every formula
of SO(3) that consists of cross products gives the one of SE(3) by a directional derivative. SE(2) is SE(3) restricted
to the plane.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Element, Flag, Vector
from covariant.geometry.lie._group import AbstractGroup
from covariant.geometry.lie._rotations import SO2, SO3, no_half_turn, rotation_defect


class AbstractMotions(AbstractGroup):
    """Rigid motions as affine matrices, with the translation in the last column."""

    def inverse(self, g: Element) -> Element:
        # A rotation is inverted by its transpose: this needs no linear system, and is exact for exact rotations.
        return _affine(g[:-1, :-1].T, -g[:-1, :-1].T @ g[:-1, -1], 1.0)

    def act(self, g: Element, point: Vector) -> Vector:
        return g[:-1, :-1] @ point + g[:-1, -1]

    def defect(self, g: Element) -> Array:
        size = g.shape[0] - 1
        last = jnp.max(jnp.abs(g[size] - jnp.eye(size + 1, dtype=g.dtype)[size]))
        # No equation of the group restricts a translation, so an infinite one is excluded here.
        finite = jnp.where(jnp.all(jnp.isfinite(g)), last, jnp.inf)
        return jnp.maximum(rotation_defect(g[:size, :size]), finite)

    def unique_log(self, g: Element) -> Flag:
        return no_half_turn(g[:-1, :-1])


class SpecialEuclidean2(AbstractMotions):
    """SE(2): rigid motions of the plane; x = (v₁, v₂, ω) in the body frame [m, m, rad]. `SE2` is its instance.

    Use it for vehicles in the plane. Elements are matrices (3, 3), with the translation in the last column. Velocities
    are in the body frame, so a forward motion keeps its components in a turn.

    Example:
        The pose after 1 m along x; the image of its origin:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SE2
        >>> pose = SE2.exp(jnp.array([1.0, 0.0, 0.0]))
        >>> SE2.act(pose, jnp.zeros(2)).tolist()
        [1.0, 0.0]
    """

    @property
    def dimension(self) -> int:
        return 3

    @property
    def order(self) -> int:
        return 3

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return ((2,),)

    def hat(self, x: Vector) -> Element:
        # The last entry is 0 in the algebra, as the derivative of the 1 in an element.
        return _affine(SO2.hat(x[2:]), x[:2], 0.0)

    def vee(self, matrix: Element) -> Vector:
        return jnp.concatenate([matrix[:2, 2], SO2.vee(matrix[:2, :2])])

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return _flatten(SE3.lie_bracket(_lift(x), _lift(y)))

    def exp(self, x: Vector) -> Element:
        return SE3.exp(_lift(x))[_PLANE]

    def log(self, g: Element) -> Vector:
        angle = SO2.log(g[:2, :2])
        # The plane is z = 0 in space; a rotation vector (0, 0, ω) maps this plane to itself.
        at_start = jnp.concatenate([g[:2, 2], jnp.zeros_like(angle)])
        return jnp.concatenate([SO3.left_jacobian_inverse(_axis(angle), at_start)[:2], angle])

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        return _flatten(SE3.right_jacobian(_lift(x), _lift(y)))

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return _flatten(SE3.right_jacobian_inverse(_lift(x), _lift(y)))


class SpecialEuclidean3(AbstractMotions):
    """SE(3): rigid motions of space; x = (v, ω) in the body frame [m, rad]. `SE3` is its instance.

    Use it for bodies that turn and move, such as vehicles under water or in the air. Elements are matrices (4, 4). The
    translation comes first in x; many texts put the rotation first, so reorder their vectors and inertia matrices.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SE3
        >>> twist = jnp.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        >>> bool(jnp.allclose(SE3.log(SE3.exp(twist)), twist))
        True
    """

    @property
    def dimension(self) -> int:
        return 6

    @property
    def order(self) -> int:
        return 4

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return ((3, 4, 5),)

    def hat(self, x: Vector) -> Element:
        return _affine(SO3.hat(x[3:]), x[:3], 0.0)

    def vee(self, matrix: Element) -> Vector:
        return jnp.concatenate([matrix[:3, 3], SO3.vee(matrix[:3, :3])])

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return _dual(SO3.lie_bracket, x, y)

    def exp(self, x: Vector) -> Element:
        # The translation is ∫ exp(tω) v dt over unit time, which is J_l(ω) v.
        return _affine(SO3.exp(x[3:]), SO3.left_jacobian(x[3:], x[:3]), 1.0)

    def log(self, g: Element) -> Vector:
        omega = SO3.log(g[:3, :3])
        # The translation of exp is J_l(ω) v, whose inverse gives v.
        return jnp.concatenate([SO3.left_jacobian_inverse(omega, g[:3, 3]), omega])

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        return _dual(SO3.right_jacobian, x, y)

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return _dual(SO3.right_jacobian_inverse, x, y)


SE2 = SpecialEuclidean2()
SE3 = SpecialEuclidean3()

_PLANE = np.ix_([0, 1, 3], [0, 1, 3])


def _dual(formula, x: Vector, y: Vector) -> Vector:
    """A formula of SO(3) in rotation vectors, evaluated on the dual numbers `ω + εv`."""
    # f(ω + εv) = f(ω) + ε Df(ω)[v], as ε² = 0: the ε part is the translation, so SO(3)'s formulas serve for SE(3).
    real, dual = jax.jvp(formula, (x[3:], y[3:]), (x[:3], y[:3]))
    return jnp.concatenate([dual, real])


def _affine(linear: Array, shift: Array, corner: float) -> Element:
    upper = jnp.concatenate([linear, shift[:, None]], axis=1)
    return jnp.concatenate([upper, corner * np.eye(upper.shape[1], dtype=upper.dtype)[-1:]])


def _axis(angle: Array) -> Array:
    return jnp.concatenate([jnp.zeros(2, angle.dtype), angle])


def _lift(x: Float[Array, "3"]) -> Float[Array, "6"]:
    zero = jnp.zeros(3, x.dtype)
    return jnp.concatenate([x[:2], zero, x[2:]])


def _flatten(x: Float[Array, "6"]) -> Float[Array, "3"]:
    return jnp.concatenate([x[:2], x[5:]])
