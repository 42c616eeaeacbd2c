"""Lie groups as matrices, and the Riemannian geometry of left-invariant metrics on them."""

from covariant.geometry.lie._group import AbstractGroup
from covariant.geometry.lie._left_invariant import AbstractInertia, Inertia, LeftInvariant
from covariant.geometry.lie._matrix import SU, MatrixGroup
from covariant.geometry.lie._motions import SE2, SE3
from covariant.geometry.lie._product import Product
from covariant.geometry.lie._rotations import SO2, SO3, quaternion_from_rotation, rotation_from_quaternion

__all__ = [
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "SU",
    "AbstractGroup",
    "AbstractInertia",
    "Inertia",
    "LeftInvariant",
    "MatrixGroup",
    "Product",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
]
