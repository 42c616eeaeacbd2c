"""Robots from files, whatever their format."""

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

    Use it to look at links, joints, limits and inertias, or to check a file, before mechanics are built. It returns
    data only. `load` builds the mechanical system from the same file.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        motor_torques: Whether to read the reductions of a URDF file's transmissions too.

    Returns:
        Links, joints and motors of the robot.

    Raises:
        ValueError: One line with the path, for what is wrong in the file.
        ImportError: The file is MJCF and MuJoCo is not installed.

    Example:
        >>> from covariant import models
        >>> robot = models.robots.read("double_pendulum")
        >>> [joint.kind for joint in robot.joints].count("continuous")
        2
    """
    return _read(path, motor_torques)[0]


def _read(path: str | Path, motor_torques: bool) -> tuple[Description, Any]:
    """The description of a robot, and MuJoCo's model of it where the file is MJCF, else None."""
    try:
        return _read_file(located(path), motor_torques)
    except InputError as error:  # of the door it names the file already
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

    Coordinates are the joints that are not fixed, locked or following another one, by their names [rad or m]; those
    without limits are full circles. Inputs are the torques [N m] or forces [N] at them, or the inputs of the motors of
    the joints where an MJCF file names some. Gravity is 9.81 m/s² along −z of the root, or of the world, or as an MJCF
    file says. Friction of a joint is `damping v + friction (2/π) atan(100 v)`; that of a floating joint acts so on each
    component of its velocity, the linear one in the world and the angular one in the body. An MJCF file is compared
    with MuJoCo at random states, so a robot that would move otherwise is refused.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        floating: Whether the root link moves freely, as it does where the file has a floating joint. A configuration is
            then its pose T_world_root (4, 4), row by row, followed by the joints, and a velocity its twist (v, ω) in
            its own frame, followed by the rates of the joints.
        lock: Joints that stand still, with their position [rad or m].
        actuated: Names of the joints with an input, in the order of the joints; motors of the file are then left out.
            All joints by default.
        payload: Point masses, `{link: (mass, x, y, z)}` [kg, m in the frame of the link]. They may be traced and
            differentiated by JAX.
        dry_friction: False leaves out the part of the friction that does not grow with the speed, as where it is
            compensated.
        motor_torques: True where logs have the torques [N m] of motors, before the reductions that the `transmission`s
            of a URDF file state. Every joint with an input needs one; losses in the gear count as friction.
        friction: Fields of `FrictionLaw` by joint, in place of the damping and dry friction of the file:
            `{joint: {"viscous": 0.1, "coulomb": 0.5}}`.
        armature: Inertia of the rotor as felt at the joint, by joint [kg m² or kg].
        inertia: Mass, centre of mass and inertia about it, by link, in its frame:
            `{link: (mass, cx, cy, cz, ixx, iyy, izz, ixy, ixz, iyz)}` [kg, m, kg m²].
        gravity: Its magnitude, along its direction in the file, or the vector [m/s²].
        torque_constants: Factor of the logged torque, force or motor input, by joint.
        offsets: What has to be added to a logged position for the true one, by joint [rad or m].
        servos: Keys of the tables `[servo.JOINT]` of a model file, by joint: such a joint is told positions, and holds
            them by its own controller, `{joint: {"stiffness": 20.0, "delay": 0.04}}`. Its input is the command.
        loops: Keys of the tables `[loop.NAME]` of a model file, by name, for loops that a URDF file cannot state: a
            point of each of two links that coincide, `{name: {"links": [a, b], "points": [[0.4, 0, 0], [0.3, 0, 0]]}}`
            [m], in the frame of each link; also `"rpy": [0, 0, 0]`, roll, pitch and yaw [rad] of the second link in the
            first, for frames that coincide; or a polynomial between positions of two joints,
            `{name: {"joints": ["lift", "shaft"], "polynomial": [c0, c1, c2]}}`.
        assembly: Positions of the joints [rad or m] where the loops are closed as they are built, to a few digits, as
            `{"motor": 0.6, "coupler": 0.3}`; 0 for others. By default the pose of an MJCF file, or one of its
            keyframes. The same motor angles may be assembled in several ways, of which none is guessed.

    Returns:
        The system, with its configuration space as a `RobotSpace`, or a `covariant.geometry.Leaf` of one if the robot
        has closed loops.

    Raises:
        ValueError: One line with the path, for what is wrong in the file, for names it does not have, for loops that do
            not close or that close by exact lengths alone, and for an MJCF file whose robot moves otherwise in MuJoCo.
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
    """The description that `load` makes a system of: that of the file with other numbers."""
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
