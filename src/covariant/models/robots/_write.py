"""Writes robots as files for simulators, depending on the end of the file's name: URDF, MJCF, or tables of servos."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant._optional import load_optional
from covariant.models.robots._assemble import still_joints
from covariant.models.robots._axes import locked_pose
from covariant.models.robots._description import NO_INERTIA, Description, Joint, Motor
from covariant.models.robots._forces import reduction_of
from covariant.models.robots._load import described
from covariant.models.robots._servos import servo_of
from covariant.models.robots._write_bam import bam_text
from covariant.models.robots._write_isaac import isaac_text
from covariant.models.robots._write_mjcf import ONE_AXIS, mjcf_text
from covariant.models.robots._write_urdf import urdf_text
from covariant.models.robots._write_xml import numbers_left_out
from scalargraph.errors import InputError

LAW = ("asymmetry", "stribeck", "stribeck_velocity", "load", "load_external")
"""Numbers of a `FrictionLaw` beyond viscous and Coulomb friction."""
SERVO = ("dead_band", "backlash", "switch", "logged_supply")
"""Properties of a `Servo` that no simulator's drive has."""
BAM = ".bam.json"
"""End of the names of parameter files for BAM; a joint's name comes before it."""
LEFT_OUT = {
    ".urdf": (("stiffness", "gain", "damping", "feedforward", "delay", "offset", *SERVO), LAW),
    ".xml": (SERVO, LAW),
    BAM: (("damping", "offset", "delay", "dead_band", "backlash", "logged_supply", "command_scale"), ("asymmetry",)),
    ".json": (SERVO, ("asymmetry", "stribeck_velocity", "load", "load_external")),
}
"""Properties of servos and friction that each format cannot represent, by the end of its file names: URDF, MJCF, BAM's
file of one servo, and the table for Isaac Lab."""


class RobotText(NamedTuple):
    """Text of a robot's file, and lines on numbers that the format cannot represent."""

    text: str
    left_out: tuple[str, ...]


def robot_text(
    name: str,
    path: str | Path,
    step: float,
    about: Sequence[str] = (),
    *,
    floating: bool = False,
    lock: Mapping[str, float] | None = None,
    actuated: Sequence[str] | None = None,
    payload: Mapping[str, Sequence[float]] | None = None,
    **numbers: Any,
) -> RobotText:
    """Text of a file of the robot that `load` loads with the same arguments; `step` is the simulation's step [s].

    `name` is that of the file, or its end.
    """
    suffix = next(each for each in LEFT_OUT if name.endswith(each))
    robot = described(path, actuated, **numbers)
    try:
        robot = _with_payload(robot, payload or {})
        of_urdf, robot = robot, _with_motors(_at_rest(robot, lock or {}), actuated)
        if suffix == BAM:
            robot = robot._replace(joints=(_joint_with_servo(robot, name.removesuffix(BAM)),))
        left_out = numbers_left_out(robot.joints, *LEFT_OUT[suffix])
        head = [*about, "This format has no entry for:", *left_out] if left_out else about
        if suffix == ".urdf":
            text = urdf_text(path, of_urdf, head)
        elif suffix == BAM:
            text = bam_text(robot, about, left_out)
        elif suffix == ".json":
            text = isaac_text(robot, step, about, left_out)
        else:
            text = mjcf_text(_on_its_base(robot) if floating else robot, step, head)
            _check_mjcf(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return RobotText(text, left_out)


def _check_mjcf(text: str) -> None:
    """Raise `ValueError` if MuJoCo rejects the text, for example because of bodies without mass."""
    mujoco = load_optional("mujoco", use="MJCF files are written with", extra="robots")
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read it as MJCF: {' '.join(str(error).split())}") from error


def _joint_with_servo(robot: Description, name: str) -> Joint:
    """The joint of this name, which has a servo."""
    joints = {joint.name: joint for joint in robot.joints if joint.servo is not None}
    if name not in joints:
        some = ", ".join(joints) or "there is none"
        raise InputError(f"the part before {BAM} must be the name of a joint with a servo ({some}); got {name!r}")
    return joints[name]


def _with_payload(robot: Description, payload: Mapping[str, Sequence[float]]) -> Description:
    links = dict(robot.links)
    for name, (mass, *place) in payload.items():
        links[name] = links[name].with_mass(mass, np.array(place))
    return robot._replace(links=links)


def _at_rest(robot: Description, lock: Mapping[str, float]) -> Description:
    """The robot with fixed joints in place of locked ones."""
    still, joints = still_joints(robot, dict(lock)), []
    for joint in robot.joints:
        if joint.name in still:
            rotation, shift = locked_pose(joint, still[joint.name])
            frame = joint.rotation @ rotation, joint.place + joint.rotation @ shift
            joint = Joint(joint.name, "fixed", joint.parent, joint.child, *frame, joint.axis)
        joints.append(joint)
    return robot._replace(joints=tuple(joints))


def _with_motors(robot: Description, actuated: Sequence[str] | None) -> Description:
    """The robot with a motor for each input; servos of its motors move to their joints."""
    joints = {joint.name: joint for joint in robot.joints if joint.kind != "fixed"}
    if robot.motors and actuated is None:
        motors = tuple(motor for motor in robot.motors if motor.joint in joints)
        for motor in motors:
            joint = joints[motor.joint]
            servo = joint.servo or servo_of(motor)
            if servo is not None:
                servo = servo._replace(command_scale=servo.command_scale * joint.torque_constant)
            joints[motor.joint] = joint._replace(servo=servo)
        motors = tuple(motor._replace(gain=motor.gain * joints[motor.joint].torque_constant) for motor in motors)
    else:
        motors = tuple(
            Motor(
                name, name, joint.torque_constant * (reduction_of(joint) if robot.motor_torques else 1.0), 0, 0, 0, ""
            )
            for name, joint in joints.items()
            if joint.kind in ONE_AXIS and joint.follows is None and (actuated is None or name in actuated)
        )
        joints = {n: j if any(m.joint == n for m in motors) else j._replace(servo=None) for n, j in joints.items()}
    return robot._replace(joints=tuple(joints.get(joint.name, joint) for joint in robot.joints), motors=motors)


def _on_its_base(robot: Description) -> Description:
    """The robot whose root link moves freely in the world."""
    still = np.eye(3), np.zeros(3), np.eye(3)[2]
    base = Joint(f"free joint of {robot.root}", "floating", "world", robot.root, *still)
    links = {"world": NO_INERTIA, **robot.links}
    return robot._replace(root="world", links=links, joints=(base, *robot.joints))
