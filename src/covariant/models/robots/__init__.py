"""Robots from their descriptions: the geometry and mechanics of a tree of rigid bodies."""

from covariant.models.robots._assemble import assemble
from covariant.models.robots._description import Description, Follows, Inertia, Joint
from covariant.models.robots._load import load, read
from covariant.models.robots._space import RobotSpace, Tree

__all__ = ["Description", "Follows", "Inertia", "Joint", "RobotSpace", "Tree", "assemble", "load", "read"]
