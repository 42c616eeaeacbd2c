"""Loads robots from files of any supported format."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from covariant._typing import Number
from covariant.models._mechanical import MechanicalSystem
from covariant.models.robots._against_mujoco import refuse_difference
from covariant.models.robots._assemble import assemble
from covariant.models.robots._changes import changed
from covariant.models.robots._description import Description, FrictionLaw, Joint
from covariant.models.robots._library import ROBOTS, located
from covariant.models.robots._mjcf import read_mjcf
from covariant.models.robots._mjcf_bounds import check_bounds
from covariant.models.robots._urdf import read_urdf
from covariant.models.robots._xml import parse
from scalargraph.errors import InputError
from scalargraph.files import bounded


def read(path: str | Path, *, motor_torques: bool = False) -> Description:
    """Read the description of a robot from a URDF or MJCF file.

    Use it to inspect links, joints, limits and inertias, or to check a file before a model is built. It returns data
    only. `load` builds the mechanical system from the same file.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        motor_torques: Whether to read the reductions of a URDF file's transmissions too.

    Returns:
        Links, joints and motors of the robot.

    Raises:
        ValueError: The file has a fault; one line with the path describes it.
        ImportError: The file is MJCF and MuJoCo is not installed.

    Example:
        >>> from covariant import models
        >>> robot = models.robots.read("double_pendulum")
        >>> [joint.kind for joint in robot.joints].count("continuous")
        2
    """
    return _read(path, motor_torques)[0]


def _read(path: str | Path, motor_torques: bool) -> tuple[Description, Any]:
    """The description of a robot, and MuJoCo's model if the file is MJCF, else None."""
    try:
        return _read_file(located(path), motor_torques)
    except InputError as error:  # errors of file access contain the path already
        text = str(error) + ("" if located(path).exists() else f", or one of {', '.join(ROBOTS)}")
        raise InputError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from error


def _read_file(path: Path, motor_torques: bool) -> tuple[Description, Any]:
    outermost = parse(path)
    if outermost.tag == "mujoco":
        if motor_torques:
            raise InputError(
                "motor_torques is for URDF; an MJCF file's motors have their gear: leave motor_torques out"
            )
        check_bounds(path, outermost)
        with bounded(path):
            return read_mjcf(path)
    if outermost.tag != "robot":
        raise InputError(f"a robot's file begins with <robot> (URDF) or <mujoco> (MJCF); found <{outermost.tag}>")
    return read_urdf(outermost, path.stem, motor_torques), None


def load(
    path: str | Path,
    *,
    floating: bool = False,
    lock: Mapping[str, float] | None = None,
    actuated: Sequence[str] | None = None,
    payload: Mapping[str, Sequence[Number]] | None = None,
    dry_friction: bool = True,
    motor_torques: bool = False,
    friction: Mapping[str, Mapping[str, Number]] | None = None,
    armature: Mapping[str, Number] | None = None,
    inertia: Mapping[str, Sequence[Number]] | None = None,
    gravity: Number | Sequence[Number] | None = None,
    torque_constants: Mapping[str, Number] | None = None,
    offsets: Mapping[str, Number] | None = None,
    servos: Mapping[str, Any] | None = None,
    loops: Mapping[str, Mapping[str, Any]] | None = None,
    assembly: Mapping[str, Any] | None = None,
) -> MechanicalSystem:
    """Load the mechanical system of a robot from its URDF or MJCF file.

    Coordinates are the joints that are not fixed, locked or following another joint, by name [rad or m]; those without
    limits are full circles. Inputs are the torques [N m] or forces [N] at these joints, or the inputs of the motors
    that an MJCF file names. Gravity is 9.81 m/s² along −z of the root, or of the world, or as an MJCF file states.
    Friction of a joint is `damping v + friction (2/π) atan(100 v)`; in a floating joint it acts in this way on each
    component of the velocity, the linear one in the world and the angular one in the body. An MJCF file is compared
    with MuJoCo at random states, so a robot that would move differently is refused.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        floating: Whether the root link moves freely, as it also does if the file has a floating joint. A configuration
            is then its pose T_world_root (4, 4), row by row, followed by the joints, and a velocity its twist (v, ω) in
            its own frame, followed by the rates of the joints.
        lock: Locked joints, with their position [rad or m].
        actuated: Names of the joints with an input, in the order of the joints; motors of the file are then ignored.
            All joints by default.
        payload: Point masses, `{link: (mass, x, y, z)}` [kg, m in the frame of the link]. They may be traced and
            differentiated by JAX.
        dry_friction: False leaves out the part of the friction that does not grow with speed, for robots in which it is
            compensated.
        motor_torques: True if logs contain torques [N m] of motors, before the reductions that the `transmission`s of a
            URDF file state. Every joint with an input needs one; losses in the gear count as friction.
        friction: Fields of `FrictionLaw` by joint, in place of the damping and dry friction of the file:
            `{joint: {"viscous": 0.1, "coulomb": 0.5}}`.
        armature: Inertia of the rotor, reflected to the joint, by joint [kg m² or kg].
        inertia: Mass, centre of mass and inertia about it, by link, in its frame:
            `{link: (mass, cx, cy, cz, ixx, iyy, izz, ixy, ixz, iyz)}` [kg, m, kg m²].
        gravity: Its magnitude, in the direction of the file, or the vector [m/s²].
        torque_constants: Factor of the logged torque, force or motor input, by joint.
        offsets: Offset to add to a logged position to get the true one, by joint [rad or m].
        servos: Keys of the tables `[servo.JOINT]` of a model file, by joint. Such a joint receives position commands,
            which its own controller follows: `{joint: {"stiffness": 20.0, "delay": 0.04}}`. Its input is the command.
        loops: Keys of the tables `[loop.NAME]` of a model file, by name, for loops that a URDF file cannot state: a
            point of each of two links that coincide, `{name: {"links": [a, b], "points": [[0.4, 0, 0], [0.3, 0, 0]]}}`
            [m], in the frame of each link; also `"rpy": [0, 0, 0]`, roll, pitch and yaw [rad] of the second link in the
            first, for frames that coincide; or a polynomial between positions of two joints,
            `{name: {"joints": ["lift", "shaft"], "polynomial": [c0, c1, c2]}}`.
        assembly: Positions of the joints [rad or m] in a pose in which the loops are closed, to a few digits, such as
            `{"motor": 0.6, "coupler": 0.3}`; 0 for others. By default the pose of an MJCF file, or one of its
            keyframes. It is never guessed, since the same motor angles may allow several assemblies.

    Returns:
        The system, with its configuration space as a `RobotSpace`, or a `covariant.geometry.Leaf` of one if the robot
        has closed loops.

    Raises:
        ValueError: One line with the path: a fault in the file, a name that it does not have, loops that do not close
            or close for exact lengths only, or an MJCF file whose robot moves differently in MuJoCo.
        ImportError: The file is MJCF and MuJoCo is not installed.

    Example:
        >>> from covariant import models
        >>> scara = models.robots.load("scara")
        >>> scara.inputs == len(scara.coordinates)
        True
    """
    numbers = {
        "friction": friction,
        "armature": armature,
        "inertia": inertia,
        "gravity": gravity,
        "torque_constants": torque_constants,
        "offsets": offsets,
        "servos": servos,
        "loops": loops,
        "assembly": assembly,
    }
    robot = described(path, actuated, dry_friction=dry_friction, motor_torques=motor_torques, **numbers)
    try:
        return assemble(robot, floating=floating, lock=lock, actuated=actuated, payload=payload)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def described(
    path: str | Path,
    actuated: Sequence[str] | None = None,
    *,
    dry_friction: bool = True,
    motor_torques: bool = False,
    **numbers: Any,
) -> Description:
    """The description from which `load` builds a system: the one in the file, with other numbers."""
    robot, engine = _read(path, motor_torques)
    try:
        if engine is not None:
            refuse_difference(engine, robot, actuated)
        robot = changed(robot, **numbers)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return robot if dry_friction else robot._replace(joints=tuple(map(_without_dry_friction, robot.joints)))


def _without_dry_friction(joint: Joint) -> Joint:
    return joint._replace(friction=0.0, law=joint.law and FrictionLaw(viscous=joint.law.viscous))
