"""Reads URDF files, the robot descriptions of ROS. Source: the specification of the ROS package `urdfdom`.

Ball joints, which standard URDF lacks, are called `spherical`, as in Bullet and MuJoCo, or `ball`, as in Drake.
"""

import math
from collections import Counter
from xml.etree.ElementTree import Element

import numpy as np

from covariant._door import MOST_LINKS, check_count
from covariant.models.robots._description import (
    NO_INERTIA,
    BodyInertia,
    Description,
    Follows,
    Joint,
    doubts_on,
    exact,
    in_order,
    limits_in_doubt,
)
from covariant.models.robots._transmission import with_rotors
from covariant.models.robots._xml import attribute, finite, name_of, number, unread, vector
from scalargraph.errors import InputError

KINDS = ("revolute", "continuous", "prismatic", "fixed", "planar", "floating", "ball", "spherical")
WITHOUT_AXIS = ("fixed", "floating", "ball")
OF_LINK = {"inertial"}
OF_JOINT = {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic"}
GRAVITY = np.array([0.0, 0.0, -9.81])


def read_urdf(robot: Element, name: str, motor_torques: bool = False) -> Description:
    """Read the robot that a URDF file describes; `robot` is its outermost tag, `name` is used if that has no name."""
    used, ignored, doubts = Counter(), Counter(), []
    links: dict[str, BodyInertia] = {}
    joints: list[Joint] = []
    for tag in ("link", "joint"):
        check_count(len(robot.findall(tag)), MOST_LINKS, f"{tag}s")
    for entry in robot:
        tag = name_of(entry)  # without the namespace, in which Drake has some joints
        if tag == "transmission":
            continue
        if tag not in ("link", "joint") or (tag == "joint" and "type" not in entry.attrib):
            ignored[tag] += 1
            continue
        used[tag] += 1
        for part in entry:
            known = part.tag in (OF_LINK if tag == "link" else OF_JOINT)
            (used if known else ignored)[f"{tag}/{name_of(part)}"] += 1
        entry_name = attribute(entry, "name", tag)
        if entry_name in (links if tag == "link" else {joint.name for joint in joints}):
            raise InputError(f"two {tag}s are called {entry_name!r}")
        if tag == "link":
            links[entry_name] = _inertia(entry, entry_name, doubts)
            doubts += doubts_on(entry_name, links[entry_name])
        else:
            joints.append(_joint(entry, entry_name))
            doubts += limits_in_doubt(joints[-1])
        known = [part for part in entry if part.tag in (OF_LINK if tag == "link" else OF_JOINT)]
        for part in (entry, *known, *(inner for each in known for inner in each)):
            what = tag if part is entry else f"{tag}/{name_of(part)}"
            ignored.update(f"{what} {key}" for key in unread(part))
    if not links:
        raise InputError("has no <link>")
    transmissions = [entry for entry in robot if name_of(entry) == "transmission"]
    joints = with_rotors(transmissions, joints, motor_torques, used, ignored)
    root, ordered = in_order(links, joints)
    return Description(
        robot.get("name", name),
        links,
        ordered,
        root,
        GRAVITY,
        dict(used),
        dict(ignored),
        tuple(doubts),
        motor_torques=motor_torques,
    )


def _inertia(link: Element, name: str, doubts: list[str]) -> BodyInertia:
    inertial = link.find("inertial")
    if inertial is None:
        return NO_INERTIA
    where = f"link {name!r}"
    rotation, centre = _origin(inertial, where)
    mass, moments = inertial.find("mass"), inertial.find("inertia")
    if mass is None or moments is None:
        raise InputError(f"{where}: <inertial> needs <mass> and <inertia>")
    xx, xy, xz, yy, yz, zz = (
        # The specification requires all moments, but files often leave out products that are zero.
        number(moments, key, where, 0.0 if key in ("ixy", "ixz", "iyz") else None)
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    for key, value in (("ixy", xy), ("ixz", xz), ("iyz", yz)):
        other = moments.attrib.get(f"i{key[2]}{key[1]}", "")
        if other and finite(other, f"{where}: i{key[2]}{key[1]}") != value:
            doubts.append(f"{where}: i{key[2]}{key[1]} = {other} is ignored, and differs from {key} = {value:g}")
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return BodyInertia.of(number(mass, "value", where), centre, rotation @ tensor @ rotation.T)


def _joint(entry: Element, name: str) -> Joint:
    where, kind = f"joint {name!r}", entry.get("type", "")
    if kind not in KINDS:
        raise InputError(f"{where}: unknown type {kind!r}; there are {', '.join(KINDS)}")
    kind = "ball" if kind == "spherical" else kind
    ends = {}
    for end in ("parent", "child"):
        tag = entry.find(end)
        if tag is None:
            raise InputError(f"{where}: <{end} link=…/> is missing")
        ends[end] = attribute(tag, "link", where)
    rotation, place = _origin(entry, where)
    # The specification's default axis is x.
    axis = vector(entry.find("axis"), "xyz", where, (1.0, 0.0, 0.0))
    length = np.linalg.norm(axis)
    if kind not in WITHOUT_AXIS and not length > 1e-9:
        raise InputError(f"{where}: the axis must have a direction; got {axis.tolist()}")
    dynamics, limit, mimic = entry.find("dynamics"), entry.find("limit"), entry.find("mimic")
    # In the specification 0 means a limit that is not stated, and a continuous joint has no limits.
    lower, upper = -np.inf, np.inf
    if limit is not None and kind not in ("continuous", *WITHOUT_AXIS):
        lower, upper = (number(limit, key, where, 0.0) for key in ("lower", "upper"))
    if lower > upper:
        raise InputError(f"{where}: the lower limit {lower:g} is above the upper one {upper:g}")
    losses = {key: 0.0 if dynamics is None else number(dynamics, key, where, 0.0) for key in ("damping", "friction")}
    for key, value in losses.items():
        if value < 0:
            raise InputError(f"{where}: {key} must not be negative; got {value:g}")
    follows = None
    if mimic is not None and kind == "ball":
        raise InputError(f"{where}: a ball joint cannot follow another one; remove <mimic>")
    if mimic is not None:
        numbers = (number(mimic, key, where, default) for key, default in (("multiplier", 1.0), ("offset", 0.0)))
        follows = Follows(attribute(mimic, "joint", where), *numbers)
    return Joint(
        name,
        kind,
        ends["parent"],
        ends["child"],
        rotation,
        place,
        exact(axis / length) if length > 0 else axis,
        damping=losses["damping"],
        friction=losses["friction"],
        lower=lower,
        upper=upper,
        velocity=np.inf if limit is None else number(limit, "velocity", where, np.inf),
        effort=np.inf if limit is None else number(limit, "effort", where, np.inf),
        follows=follows,
    )


def _origin(entry: Element, where: str) -> tuple[np.ndarray, np.ndarray]:
    origin = entry.find("origin")
    place = vector(origin, "xyz", where, (0.0, 0.0, 0.0))
    roll, pitch, yaw = vector(origin, "rpy", where, (0.0, 0.0, 0.0))
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return exact(about_z @ about_y @ about_x), place  # rpy are rotations about fixed axes: roll first, yaw last
