"""Transmissions of URDF: what the rotor of a motor is felt as at its joint.

An inertia J that turns n times as fast as the joint is felt there as n² J. Logged torques are those at the joints, so
that a reduction alone changes nothing. Source: `transmission_interface` of ROS for `mechanicalReduction`; the
documentation of Drake, reflected inertia, for `rotor_inertia` and `gear_ratio`.
"""

import math
from collections import Counter
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from covariant.models.robots._description import Joint
from covariant.models.robots._xml import attribute, name_of, number

REDUCTIONS = ("mechanicalReduction", "gear_ratio")
ROTOR = "rotor_inertia"
ONE_AXIS = ("revolute", "continuous", "prismatic")


def with_rotors(
    transmissions: Sequence[Element], joints: Sequence[Joint], used: Counter[str], ignored: Counter[str]
) -> list[Joint]:
    """The joints with the rotors that transmissions state; counts what was `used` of them, and `ignored`.

    Raises `ValueError` for a rotor whose joint is not one of one axis, or numbers that no gear has.
    """
    found = {joint.name: joint for joint in joints}
    for entry in transmissions:
        rotors = [part for part in entry.iter() if name_of(part) == ROTOR]
        _count(entry, bool(rotors), used, ignored)
        if not rotors:
            continue
        where = f"transmission {entry.get('name', '')!r}"
        driven = [attribute(part, "name", where) for part in entry.findall("joint")]
        if len(driven) != 1 or len(rotors) != 1:
            raise ValueError(
                f"{where}: {len(rotors)} rotors on {len(driven)} joints are not supported; one rotor drives one joint, "
                f"remove <{ROTOR}>"
            )
        joint = found.get(driven[0])
        if joint is None:
            raise ValueError(f"{where}: there is no joint {driven[0]!r}")
        if joint.kind not in ONE_AXIS:
            raise ValueError(f"{where}: joint {joint.name!r} is {joint.kind}, and a rotor needs one axis")
        inertia, reduction = _value(rotors[0], where), _reduction(entry, where)
        if inertia < 0:
            raise ValueError(f"{where}: {ROTOR} must not be negative; got {inertia:g} kg m²")
        found[joint.name] = joint._replace(armature=joint.armature + reduction**2 * inertia)
    return list(found.values())


def _reduction(entry: Element, where: str) -> float:
    """Turns of the motor for one of the joint, or for 1 m: 1 where nothing is stated."""
    stated = {name_of(part): _value(part, where) for part in entry.iter() if name_of(part) in REDUCTIONS}
    if len(set(stated.values())) > 1:
        raise ValueError(f"{where}: " + " and ".join(f"{k} {v:g}" for k, v in stated.items()) + " differ; keep one")
    reduction = next(iter(stated.values()), 1.0)
    if not reduction:
        raise ValueError(f"{where}: {next(iter(stated))} must not be 0")
    return reduction


def _value(entry: Element, where: str) -> float:
    """The number of a tag, its attribute `value` or its text."""
    if "value" in entry.attrib:
        return number(entry, "value", where)
    try:
        found = float(entry.text or "")
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise ValueError(f"{where}: <{name_of(entry)}> must be a finite number; got {(entry.text or '').strip()!r}")
    return found


def _count(entry: Element, with_rotor: bool, used: Counter[str], ignored: Counter[str], path: str = "") -> None:
    """Count a transmission and its tags: those that lead to an armature are used."""
    name = name_of(entry)
    path = f"{path}/{name}" if path else name
    needed = with_rotor and name in ("transmission", "joint", "actuator", ROTOR, *REDUCTIONS)
    (used if needed else ignored)[path] += 1
    for part in entry:
        _count(part, with_rotor, used, ignored, path)
