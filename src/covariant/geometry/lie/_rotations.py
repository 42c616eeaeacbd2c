"""The rotations of the plane and of space, SO(2) and SO(3), and the unit quaternions that represent them.

Source: Barfoot 2017, State Estimation for Robotics, chapter 7; Shepperd 1978 for the quaternion of a matrix.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Element, Flag, Vector
from covariant.geometry.lie._coefficients import angle_over_half_sine, inverse_jacobian_coefficient, stumpff
from covariant.geometry.lie._group import AbstractGroup

Quaternion = Float[Array, "4"]
"""wxyz, of unit length; q and −q are the same rotation."""


class SpecialOrthogonal2(AbstractGroup):
    """SO(2): rotations of the plane; x = (ω,) is the angle [rad]."""

    @property
    def dimension(self) -> int:
        return 1

    @property
    def order(self) -> int:
        return 2

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return ((0,),)

    def hat(self, x: Vector) -> Element:
        zero = jnp.zeros_like(x[0])
        return jnp.stack([jnp.stack([zero, -x[0]]), jnp.stack([x[0], zero])])

    def vee(self, matrix: Element) -> Vector:
        return (matrix[1, 0] - matrix[0, 1])[None] / 2

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return 0 * x * y

    def exp(self, x: Vector) -> Element:
        c, s = jnp.cos(x[0]), jnp.sin(x[0])
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])

    def log(self, g: Element) -> Vector:
        return jnp.arctan2(g[1, 0] - g[0, 1], g[0, 0] + g[1, 1])[None]

    def inverse(self, g: Element) -> Element:
        return g.T

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        return y

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return y

    def act(self, g: Element, point: Float[Array, "2"]) -> Float[Array, "2"]:
        return g @ point

    def defect(self, g: Element) -> Array:
        return rotation_defect(g)

    def unique_log(self, g: Element) -> Flag:
        return no_half_turn(g)


class SpecialOrthogonal3(AbstractGroup):
    """SO(3): rotations of space; x (3,) is a rotation vector [rad]; velocities are angular ones in the body frame."""

    @property
    def dimension(self) -> int:
        return 3

    @property
    def order(self) -> int:
        return 3

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return ((0, 1, 2),)

    def hat(self, x: Vector) -> Element:
        zero = jnp.zeros_like(x[0])
        rows = ((zero, -x[2], x[1]), (x[2], zero, -x[0]), (-x[1], x[0], zero))
        return jnp.stack([jnp.stack(row) for row in rows])

    def vee(self, matrix: Element) -> Vector:
        return jnp.stack([matrix[i, j] - matrix[j, i] for i, j in ((2, 1), (0, 2), (1, 0))]) / 2

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return jnp.cross(x, y)

    def exp(self, x: Vector) -> Element:
        # Rodrigues' formula; the square of hat(x) is xxᵀ − |x|².
        square = x @ x
        turned = stumpff(0, square) * np.eye(3, dtype=x.dtype) + stumpff(2, square) * jnp.outer(x, x)
        return turned + stumpff(1, square) * self.hat(x)

    def log(self, g: Element) -> Vector:
        q = quaternion_from_rotation(g)
        return angle_over_half_sine(q[1:] @ q[1:], q[0]) * q[1:]

    def inverse(self, g: Element) -> Element:
        return g.T

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        square, turned = x @ x, jnp.cross(x, y)
        return y - stumpff(2, square) * turned + stumpff(3, square) * jnp.cross(x, turned)

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        turned = jnp.cross(x, y)
        return y + turned / 2 + inverse_jacobian_coefficient(x @ x) * jnp.cross(x, turned)

    def act(self, g: Element, point: Float[Array, "3"]) -> Float[Array, "3"]:
        return g @ point

    def defect(self, g: Element) -> Array:
        return rotation_defect(g)

    def unique_log(self, g: Element) -> Flag:
        return no_half_turn(g)


SO2 = SpecialOrthogonal2()
SO3 = SpecialOrthogonal3()


def rotation_defect(g: Element) -> Array:
    """Largest entry of |gᵀg − 1|, or infinity for a reflection."""
    size = g.shape[0]
    turned = g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0] if size == 2 else jnp.dot(jnp.cross(g[0], g[1]), g[2])
    return jnp.where(turned < 0, jnp.inf, jnp.max(jnp.abs(g.T @ g - jnp.eye(size, dtype=g.dtype))))


def no_half_turn(g: Element) -> Flag:
    """False for a turn by π, to within the square root of rounding."""
    squared_cosine = jnp.trace(g) + (4 - g.shape[0])  # 4cos²(θ/2), in the plane and in space
    return squared_cosine > 4 * jnp.finfo(g.dtype).eps


def quaternion_from_rotation(g: Float[Array, "3 3"]) -> Quaternion:
    """The unit quaternion wxyz, w ≥ 0, of a rotation matrix.

    Each of the four rows below is the quaternion times four times one of its entries; the longest row is the most
    accurate. Near half a turn the axis thus comes from the symmetric part of the matrix.
    """
    x, y, z = g[0, 0], g[1, 1], g[2, 2]
    a, b, c = (g[i, j] - g[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (g[i, j] + g[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = ((1 + x + y + z, a, b, c), (a, 1 + x - y - z, f, e), (b, f, 1 - x + y - z, d), (c, e, d, 1 - x - y + z))
    table = jnp.stack([jnp.stack(row) for row in rows])
    longest = table[jnp.argmax(jnp.diagonal(table))]
    upper = jnp.where(longest[0] < 0, -longest, longest)
    return upper / jnp.sqrt(upper @ upper)


def rotation_from_quaternion(q: Quaternion) -> Float[Array, "3 3"]:
    """The rotation matrix of a quaternion wxyz of any length but zero; q and −q give the same matrix."""
    w, v = q[0], q[1:]
    square = v @ v
    turned = (w * w - square) * jnp.eye(3, dtype=q.dtype) + 2 * jnp.outer(v, v) + 2 * w * SO3.hat(v)
    return turned / (w * w + square)
