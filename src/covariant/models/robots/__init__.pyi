from ._assemble import assemble as assemble
from ._changes import (
    OF_INERTIA as OF_INERTIA,
    changed as changed,
    inertia_of as inertia_of,
    numbers_of as numbers_of,
)
from ._description import (
    BodyInertia as BodyInertia,
    Coincide as Coincide,
    Coupled as Coupled,
    Description as Description,
    Follows as Follows,
    FrictionLaw as FrictionLaw,
    Joint as Joint,
    Motor as Motor,
    Servo as Servo,
)
from ._forces import dry_friction as dry_friction
from ._legs import Legs as Legs, legs as legs
from ._library import ROBOTS as ROBOTS, located as located
from ._load import load as load, read as read
from ._loops import robot_space as robot_space
from ._servos import (
    OF_GEAR as OF_GEAR,
    OF_SERVO as OF_SERVO,
    ServoDissipation as ServoDissipation,
    ServoForce as ServoForce,
    Servos as Servos,
    complete_tables as complete_tables,
    servos_in as servos_in,
)
from ._space import RobotSpace as RobotSpace
from ._tree import KinematicTree as KinematicTree, Links as Links
from ._write import robot_text as robot_text
from ._write_urdf import urdf_with_inertias as urdf_with_inertias

__all__ = ["load", "located", "read"]
