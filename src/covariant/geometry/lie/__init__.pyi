from ._group import AbstractGroup as AbstractGroup
from ._left_invariant import AbstractInertia as AbstractInertia, Inertia as Inertia, LeftInvariant as LeftInvariant
from ._matrix import SU as SU, MatrixGroup as MatrixGroup
from ._motions import SE2 as SE2, SE3 as SE3
from ._product import Product as Product
from ._rotations import (
    SO2 as SO2,
    SO3 as SO3,
    quaternion_from_rotation as quaternion_from_rotation,
    rotation_from_quaternion as rotation_from_quaternion,
)

__all__ = ["SE2", "SE3", "SO2", "SO3", "SU", "LeftInvariant", "quaternion_from_rotation", "rotation_from_quaternion"]
