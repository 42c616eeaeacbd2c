from ._assemble import assemble as assemble
from ._description import (
    BodyInertia as BodyInertia,
    Description as Description,
    Follows as Follows,
    Joint as Joint,
    Motor as Motor,
)
from ._library import ROBOTS as ROBOTS, located as located
from ._load import load as load, read as read
from ._space import RobotSpace as RobotSpace
from ._tree import KinematicTree as KinematicTree, Links as Links
