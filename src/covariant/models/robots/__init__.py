"""Robots from their descriptions: the geometry and mechanics of a tree of rigid bodies."""

from covariant.models.robots._assemble import assemble
from covariant.models.robots._description import BodyInertia, Description, Follows, Joint
from covariant.models.robots._load import load, read
from covariant.models.robots._space import KinematicTree, RobotSpace

__all__ = ["BodyInertia", "Description", "Follows", "Joint", "KinematicTree", "RobotSpace", "assemble", "load", "read"]
