"""Writes URDF files with other numbers: inertias of links, and friction, rotors, limits, axes and zeros of joints."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from covariant._names import refuse_unknown
from covariant.models.robots._changes import numbers_of
from covariant.models.robots._description import Description, Joint, turn_about
from covariant.models.robots._library import located
from covariant.models.robots._servos import drive_limit
from covariant.models.robots._transmission import ROTOR, reduction
from covariant.models.robots._urdf import read_urdf
from covariant.models.robots._write_mjcf import ONE_AXIS, plain_friction
from covariant.models.robots._write_xml import numbers_text, xml_text
from covariant.models.robots._xml import name_of, parse
from scalargraph.errors import InputError

KEYS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
DRAKE = "http://drake.mit.edu"
"""Namespace of Drake's additions to URDF."""
ANY_SPEED = 1e6
"""Speed limit [rad/s or m/s] that is written with a torque limit if none is known: URDF requires both."""


def urdf_with_inertias(path: str | Path, inertia: Mapping[str, Sequence[float]]) -> str:
    """Text of a URDF file with other inertias; everything else stays, except comments.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        inertia: The ten numbers of `OF_INERTIA`, by link, in the frame of the link.

    Returns:
        The text.

    Raises:
        ValueError: The file is not a URDF file, or has no such link.

    Example:
        >>> from covariant.models import robots
        >>> numbers = (1.0, 0.0, 0.0, -0.1, 0.01, 0.01, 0.001, 0.0, 0.0, 0.0)
        >>> '<mass value="1.0"' in robots.urdf_with_inertias("double_pendulum", {"lower": numbers})
        True
    """
    robot = _parse_urdf(path)
    links = {link.get("name", ""): link for link in robot.findall("link")}
    for name, numbers in inertia.items():
        refuse_unknown(f"link of {path}", name, links)
        _set_inertia(links[name], numbers)
    return xml_text(robot, [])


def urdf_text(path: str | Path, robot: Description, about: Sequence[str] = ()) -> str:
    """Text of the URDF file of a robot with the numbers of a changed description; everything else stays.

    Positions of joints are then those of the log: an encoder offset becomes part of the joint's pose.
    """
    if robot.loops:
        raise InputError(f"URDF has no closed loops, such as {robot.loops[0].name!r}; write an .xml file, MJCF")
    whole = _parse_urdf(path)
    before = read_urdf(whole, robot.name)
    links = {link.get("name", ""): link for link in whole.findall("link")}
    for name, inertia in robot.links.items():
        numbers = numbers_of(inertia)
        if not np.array_equal(numbers, numbers_of(before.links[name])):
            _set_inertia(links[name], numbers)
    entries = {entry.get("name", ""): entry for entry in whole.findall("joint") if "type" in entry.attrib}
    changed = {joint.name: joint for joint in robot.joints}
    for joint in before.joints:
        _set_joint(whole, entries[joint.name], joint, changed)
    ElementTree.register_namespace("drake", DRAKE)
    return xml_text(whole, about)


def _parse_urdf(path: str | Path) -> Element:
    robot = parse(located(path))
    if name_of(robot) != "robot":
        raise InputError(f"{path}: a URDF file begins with <robot>; found <{name_of(robot)}>")
    return robot


def _set_inertia(link: Element, numbers: Sequence[float] | np.ndarray) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    mass, *rest = (float(number) for number in numbers)
    new = Element("inertial")
    SubElement(new, "origin", xyz=" ".join(map(repr, rest[:3])), rpy="0 0 0")
    SubElement(new, "mass", value=repr(mass))
    SubElement(new, "inertia", {key: repr(value) for key, value in zip(KEYS, rest[3:], strict=True)})
    link.insert(0, new)


def _set_joint(whole: Element, entry: Element, before: Joint, changed: Mapping[str, Joint]) -> None:
    """Write the properties of a joint that differ from before."""
    joint = changed[before.name]
    losses = plain_friction(joint)
    if losses != (before.damping, before.friction):
        damping, friction = (repr(float(loss)) for loss in losses)
        _part(entry, "dynamics").attrib.update(damping=damping, friction=friction)
    if not np.array_equal(joint.axis, before.axis):
        _part(entry, "axis").set("xyz", numbers_text(joint.axis))
    if joint.encoder_offset:
        _set_origin(_part(entry, "origin"), joint)
    _set_limit(entry, before, joint)
    if joint.follows is not None and before.follows is not None:
        leader = changed[joint.follows.joint]
        # Both positions count from the zeros of their logs.
        offset = joint.follows.offset + joint.follows.ratio * leader.encoder_offset - joint.encoder_offset
        if (joint.follows.ratio, offset) != (before.follows.ratio, before.follows.offset):
            numbers = {"multiplier": joint.follows.ratio, "offset": offset}
            _part(entry, "mimic").attrib.update({key: repr(float(value)) for key, value in numbers.items()})
    if joint.armature != before.armature:
        _set_rotor(whole, joint)


def _set_limit(entry: Element, before: Joint, joint: Joint) -> None:
    ends = np.array([joint.lower, joint.upper]) - joint.encoder_offset
    limited = joint.kind in ("revolute", "prismatic") and before.lower < before.upper  # zeros mean unknown limits
    if limited and not np.array_equal(ends, [before.lower, before.upper]):
        _part(entry, "limit").attrib.update(lower=repr(float(ends[0])), upper=repr(float(ends[1])))
    if joint.servo is None:
        return
    effort = drive_limit(joint.servo)[0]
    if np.isfinite(effort) and effort != before.effort:
        limit = _part(entry, "limit")
        limit.set("effort", repr(float(effort)))
        if "velocity" not in limit.attrib:
            limit.set("velocity", repr(ANY_SPEED))


def _set_origin(origin: Element, joint: Joint) -> None:
    """Turn or move the frame of a joint to its pose at a logged position of zero."""
    rotation, place = joint.rotation, joint.place
    if joint.kind == "prismatic":
        place = place + rotation @ joint.axis * joint.encoder_offset
    else:
        rotation = rotation @ turn_about(joint.axis, joint.encoder_offset)
    origin.set("xyz", numbers_text(place))
    origin.set("rpy", numbers_text(_roll_pitch_yaw(rotation)))


def _roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles about the fixed axes x, y, z; the first is zero if the second is ± 90°."""
    across = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], across)
    if across < 1e-9:
        return 0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])
    return np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])


def _set_rotor(whole: Element, joint: Joint) -> None:
    """State the rotor of a joint in Drake's form, as URDF itself has no entry for it."""
    if joint.kind not in ONE_AXIS:
        raise InputError(f"joint {joint.name!r} is {joint.kind}, and URDF has rotors of joints of one axis only")
    driving = [
        entry
        for entry in whole
        if name_of(entry) == "transmission" and joint.name in [part.get("name") for part in entry.findall("joint")]
    ]
    where = f"transmission of {joint.name}"
    transmission = driving[0] if driving else SubElement(whole, "transmission", name=where)
    if not driving:
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        SubElement(transmission, "joint", name=joint.name)
        SubElement(transmission, "actuator", name=f"motor of {joint.name}")
    motor = _part(transmission, "actuator")
    for part in list(motor):
        if name_of(part) == ROTOR:
            motor.remove(part)
    # The transmission states the rotor's turns per joint turn; the joint feels the inertia with the square of these.
    value = float(joint.armature / reduction(transmission, where) ** 2)
    SubElement(motor, f"{{{DRAKE}}}{ROTOR}", value=repr(value))


def _part(entry: Element, tag: str) -> Element:
    """The part of an entry, which is created if it is missing."""
    part = entry.find(tag)
    return SubElement(entry, tag) if part is None else part
