"""Defines the rotations of the plane and of space, SO(2) and SO(3), and their unit quaternions.

Source: Barfoot 2017, State Estimation for Robotics, chapter 7; Shepperd 1978 for the quaternion of a matrix.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Element, Flag, Vector
from covariant.geometry.lie._coefficients import angle_over_half_sine, inverse_jacobian_coefficient, stumpff
from covariant.geometry.lie._group import AbstractGroup

Quaternion = Float[Array, "4"]
"""Components wxyz, of unit length; q and −q are the same rotation."""


class AbstractRotations(AbstractGroup):
    """Rotations as orthogonal matrices."""

    def inverse(self, g: Element) -> Element:
        return g.T

    def defect(self, g: Element) -> Array:
        return rotation_defect(g)

    def unique_log(self, g: Element) -> Flag:
        return no_half_turn(g)


class SpecialOrthogonal2(AbstractRotations):
    """SO(2): rotations of the plane; x = (ω,) is the angle [rad]. `SO2` is its instance.

    Use it for one angle as a factor of a `ProductManifold`. For a machine with joints, `Coordinates` with circles is
    simpler, and stores a number in place of a matrix.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SO2
        >>> quarter_turn = SO2.exp(jnp.array([jnp.pi / 2]))
        >>> SO2.act(quarter_turn, jnp.array([1.0, 0.0])).round(9).tolist()
        [0.0, 1.0]
    """

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
        # Zero, computed from both arguments so that it has their common type.
        return 0 * x * y

    def exp(self, x: Vector) -> Element:
        c, s = jnp.cos(x[0]), jnp.sin(x[0])
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])

    def log(self, g: Element) -> Vector:
        # Sums of both entries give the angle of the nearest rotation, even if g is a rotation only to rounding.
        return jnp.arctan2(g[1, 0] - g[0, 1], g[0, 0] + g[1, 1])[None]

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        return y

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return y


class SpecialOrthogonal3(AbstractRotations):
    """SO(3): rotations of space; x (3,) is a rotation vector [rad]. `SO3` is its instance.

    Velocities are angular velocities [rad/s] in the body frame.

    Elements are matrices (3, 3) that take body components to space components. Unlike Euler angles, they have no
    singular attitude; `log` is unique up to half a turn. Convert quaternions by `rotation_from_quaternion`.

    Example:
        A quarter turn about the z axis takes the x axis to the y axis:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SO3
        >>> quarter_turn = SO3.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
        >>> SO3.act(quarter_turn, jnp.array([1.0, 0.0, 0.0])).round(9).tolist()
        [0.0, 1.0, 0.0]
    """

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
        # By Rodrigues' formula; the square of hat(x) is xxᵀ − |x|².
        square = x @ x
        turned = stumpff(0, square) * np.eye(3, dtype=x.dtype) + stumpff(2, square) * jnp.outer(x, x)
        return turned + stumpff(1, square) * self.hat(x)

    def log(self, g: Element) -> Vector:
        q = quaternion_from_rotation(g)
        return angle_over_half_sine(q[1:] @ q[1:], q[0]) * q[1:]

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        # The odd term has the sign for the body frame: J_r(x) = J_l(−x).
        square, turned = x @ x, jnp.cross(x, y)
        return y - stumpff(2, square) * turned + stumpff(3, square) * jnp.cross(x, turned)

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        turned = jnp.cross(x, y)
        return y + turned / 2 + inverse_jacobian_coefficient(x @ x) * jnp.cross(x, turned)


SO2 = SpecialOrthogonal2()
SO3 = SpecialOrthogonal3()


def rotation_defect(g: Element) -> Array:
    """Distance of a matrix from the rotations."""
    size = g.shape[0]
    # |gᵀg − 1| alone would also be zero for reflections, so the determinant is tested too.
    determinant = g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0] if size == 2 else jnp.dot(jnp.cross(g[0], g[1]), g[2])
    return jnp.where(determinant < 0, jnp.inf, jnp.max(jnp.abs(g.T @ g - jnp.eye(size, dtype=g.dtype))))


def no_half_turn(g: Element) -> Flag:
    """Whether a rotation g, (2, 2) or (3, 3), is not a turn by π, with a margin of the square root of rounding."""
    # The trace is 2cos θ in the plane and 1 + 2cos θ in space; 2 + 2cos θ = 4cos²(θ/2).
    squared_cosine = jnp.trace(g) + (4 - g.shape[0])  # 4cos²(θ/2), in the plane and in space
    return squared_cosine > 4 * jnp.finfo(g.dtype).eps


def quaternion_from_rotation(g: Float[Array, "3 3"]) -> Quaternion:
    """Unit quaternion of a rotation matrix.

    Each of the four rows below is four times the quaternion times one of its entries; the longest row is the most
    accurate. Near half a turn the axis therefore comes from the symmetric part of the matrix.

    Args:
        g: rotation matrix (3, 3).

    Returns:
        Quaternion wxyz (4,) with w ≥ 0.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import quaternion_from_rotation
        >>> quaternion_from_rotation(jnp.diag(jnp.array([1.0, -1.0, -1.0]))).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    x, y, z = g[0, 0], g[1, 1], g[2, 2]
    a, b, c = (g[i, j] - g[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (g[i, j] + g[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = ((1 + x + y + z, a, b, c), (a, 1 + x - y - z, f, e), (b, f, 1 - x + y - z, d), (c, e, d, 1 - x - y + z))
    table = jnp.stack([jnp.stack(row) for row in rows])
    longest = table[jnp.argmax(jnp.diagonal(table))]
    # Of q and −q, the one with w ≥ 0 gives the shorter rotation vector.
    upper = jnp.where(longest[0] < 0, -longest, longest)
    return upper / jnp.sqrt(upper @ upper)


def rotation_from_quaternion(q: Quaternion) -> Float[Array, "3 3"]:
    """Rotation matrix of a quaternion.

    Use it for readings of attitude sensors. The scalar part comes first. Many drivers put it last, which would give
    another rotation without an error message. The quaternion is normalised. The matrix takes body components to space
    components if the quaternion does.

    Args:
        q: quaternion wxyz (4,) of any nonzero length; q and −q have the same matrix.

    Returns:
        Rotation matrix (3, 3).

    Example:
        Half a turn about the x axis:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import rotation_from_quaternion
        >>> jnp.diagonal(rotation_from_quaternion(jnp.array([0.0, 2.0, 0.0, 0.0]))).tolist()
        [1.0, -1.0, -1.0]
    """
    w, v = q[0], q[1:]
    square = v @ v
    scaled = (w * w - square) * jnp.eye(3, dtype=q.dtype) + 2 * jnp.outer(v, v) + 2 * w * SO3.hat(v)
    # Numerator and denominator are both of degree 2 in q, so its length cancels.
    return scaled / (w * w + square)
