"""Robots from their descriptions: the geometry and mechanics of a tree of rigid bodies."""

from covariant.models.robots._assemble import assemble
from covariant.models.robots._description import BodyInertia, Description, Follows, Joint, Motor
from covariant.models.robots._library import ROBOTS, located
from covariant.models.robots._load import load, read
from covariant.models.robots._space import KinematicTree, Links, RobotSpace

__all__ = [
    "ROBOTS",
    "BodyInertia",
    "Description",
    "Follows",
    "Joint",
    "KinematicTree",
    "Links",
    "Motor",
    "RobotSpace",
    "assemble",
    "load",
    "located",
    "read",
]
