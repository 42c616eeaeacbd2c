"""Reads transmissions of URDF files: rotor inertias and reductions, reflected to the joints.

An inertia J that turns n times as fast as the joint acts there as n² J, and a torque τ of the motor as n τ. Logged
torques are those at the joints, so a reduction alone changes nothing, unless the user says that motor torques are
logged.
Source: `transmission_interface` of ROS for `mechanicalReduction`; the documentation of Drake, reflected inertia, for
`rotor_inertia` and `gear_ratio`.
"""

from collections import Counter
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from covariant.models.robots._description import Joint
from covariant.models.robots._xml import attribute, finite, name_of, number
from scalargraph.errors import InputError

REDUCTIONS = ("mechanicalReduction", "gear_ratio")
ROTOR = "rotor_inertia"
ONE_AXIS = ("revolute", "continuous", "prismatic")


def with_rotors(
    transmissions: Sequence[Element],
    joints: Sequence[Joint],
    motor_torques: bool,
    used: Counter[str],
    ignored: Counter[str],
) -> list[Joint]:
    """Joints with the armatures and reductions of transmissions; their entries are counted in `used` and `ignored`."""
    by_name = {joint.name: joint for joint in joints}
    for entry in transmissions:
        rotors = [part for part in entry.iter() if name_of(part) == ROTOR]
        geared = motor_torques and any(name_of(part) in REDUCTIONS for part in entry.iter())
        _count(entry, geared or bool(rotors), used, ignored)
        if not (geared or rotors):
            continue
        where = f"transmission {entry.get('name', '')!r}"
        driven = [attribute(part, "name", where) for part in entry if name_of(part) == "joint"]
        if len(driven) != 1 or len(rotors) > 1:
            what = f"{len(rotors)} rotors on" if rotors else "a reduction of"
            remedy = f"remove <{ROTOR}>" if rotors else "log the torques of the joints"
            raise InputError(
                f"{where}: {what} {len(driven)} joints are not supported; one motor drives one joint, {remedy}"
            )
        joint = by_name.get(driven[0])
        if joint is None:
            raise InputError(f"{where}: there is no joint {driven[0]!r}")
        if joint.kind not in ONE_AXIS:
            raise InputError(f"{where}: joint {joint.name!r} is {joint.kind}, and a motor needs one axis")
        inertia, turns = sum(_value(rotor, where) for rotor in rotors), reduction(entry, where)
        if inertia < 0:
            raise InputError(f"{where}: {ROTOR} must not be negative; got {inertia:g} kg m²")
        by_name[joint.name] = joint._replace(
            # The energy ½J(n q')² equals that of an inertia n²J at the joint.
            armature=joint.armature + turns**2 * inertia,
            reductions=(*joint.reductions, turns) if geared else joint.reductions,
        )
    return list(by_name.values())


def reduction(entry: Element, where: str) -> float:
    """Turns of the motor per turn of the joint, or per 1 m; 1 if nothing is stated."""
    stated = [(name_of(part), _value(part, where)) for part in entry.iter() if name_of(part) in REDUCTIONS]
    # Joint and actuator may both state the reduction, by either name, but the numbers must agree.
    if len({value for _, value in stated}) > 1:
        both = " and ".join(f"{name} {value:g}" for name, value in stated)
        raise InputError(f"{where}: {both} differ; keep one")
    name, turns = stated[0] if stated else ("", 1.0)
    if not turns:
        raise InputError(f"{where}: {name} must not be 0")
    return turns


def _value(entry: Element, where: str) -> float:
    """The number of a tag, from its attribute `value` or its text."""
    if "value" in entry.attrib:
        return number(entry, "value", where)
    return finite((entry.text or "").strip(), f"{where}: <{name_of(entry)}>")


def _count(entry: Element, needed_here: bool, used: Counter[str], ignored: Counter[str], path: str = "") -> None:
    """Count a transmission and its tags; tags that contribute to an armature or a reduction count as used."""
    name = name_of(entry)
    path = f"{path}/{name}" if path else name
    needed = needed_here and name in ("transmission", "joint", "actuator", ROTOR, *REDUCTIONS)
    (used if needed else ignored)[path] += 1
    for part in entry:
        _count(part, needed_here, used, ignored, path)
