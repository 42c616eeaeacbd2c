"""Writes robots as MJCF files. Source: MuJoCo documentation, XML reference.

The file has links, joints and actuators, but no shapes, so there are no contacts. Joint positions are those of the log:
an encoder offset o becomes `ref = −o`, the position at which the bodies have the pose of the file.
"""

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from covariant._typing import Number
from covariant.models.robots._description import (
    NO_INERTIA,
    BodyInertia,
    Coupled,
    Description,
    Follows,
    Joint,
    Motor,
    Servo,
)
from covariant.models.robots._servos import drive_limit
from covariant.models.robots._write_xml import numbers_text, xml_text
from scalargraph.errors import InputError

KINDS = {"floating": "free", "ball": "ball", "prismatic": "slide", "revolute": "hinge", "continuous": "hinge"}
ONE_AXIS = ("prismatic", "revolute", "continuous")
STICKING = "0.999 0.999 0.001"
"""Impedance of dry friction; with MuJoCo's default a joint creeps under a load that friction could hold."""
ROUNDING = 1e-9
"""Fraction of a step that counts as rounding."""
MOST_COEFFICIENTS = 5
"""Largest number of coefficients of a polynomial between joints."""
SPARE_SAMPLES = 2
"""Additional samples of a delayed command: one because it is read before it is written, one for rounding."""


def mjcf_text(robot: Description, step: float, about: Sequence[str] = ()) -> str:
    """Text of the MJCF file of a robot; each of its joints moves, follows another one, or is fixed.

    `step` is the time step of the simulation [s]; `about` are lines of its head.
    """
    robot = gathered(robot)
    whole = Element("mujoco", model=robot.name)
    SubElement(whole, "compiler", angle="radian")
    # The damping of servos makes joints of small inertia stiff; this integrator treats it implicitly.
    gravity = numbers_text(robot.gravity)
    SubElement(whole, "option", gravity=gravity, timestep=repr(step), integrator="implicitfast")
    world = SubElement(whole, "worldbody")
    if robot.root != "world":
        world = _add_body(world, robot, robot.root, [], step)
    below: dict[str, list[Joint]] = {}
    for joint in robot.joints:
        below.setdefault(joint.parent, []).append(joint)
    _add_bodies(world, robot, robot.root, below, step)
    _add_equalities(whole, robot)
    _add_loops(whole, robot)
    _add_actuators(whole, robot, step)
    return xml_text(whole, about)


def gathered(robot: Description) -> Description:
    """The robot with the inertia of fixed links moved to the links that carry them, so that fixed frames have none."""
    links, frames = dict(robot.links), {robot.root: (robot.root, np.eye(3), np.zeros(3))}
    for joint in robot.joints:
        carrier, turned, shifted = frames[joint.parent]
        if joint.kind != "fixed":
            frames[joint.child] = joint.child, np.eye(3), np.zeros(3)
            continue
        rotation, place = turned @ joint.rotation, shifted + turned @ joint.place
        frames[joint.child] = carrier, rotation, place
        links[carrier] = links[carrier].joined(links[joint.child].moved(rotation, place))
        links[joint.child] = NO_INERTIA
    return robot._replace(links=links)


def _add_bodies(parent: Element, robot: Description, link: str, below: Mapping[str, list[Joint]], step: float) -> None:
    """Add the bodies that a link carries."""
    # Depth first without recursion, since a chain may be longer than Python's stack.
    stack = [(parent, joint, [joint]) for joint in reversed(below.get(link, []))]
    while stack:
        element, joint, chain = stack.pop()
        carried = below.get(joint.child, [])
        if len(carried) == 1 and _is_passed(robot.links[joint.child], chain, carried[0]):
            # MuJoCo refuses moving bodies without mass; instead, one body gets several joints.
            stack.append((element, carried[0], [*chain, carried[0]]))
            continue
        body = _add_body(element, robot, joint.child, chain, step)
        stack += [(body, each, [each]) for each in reversed(carried)]


def _is_passed(inertia: BodyInertia, chain: Sequence[Joint], after: Joint) -> bool:
    """Whether a massless link only passes on the motion of the joints before it."""
    massless = not inertia.mass and not np.any(inertia.second)
    return massless and chain[0].kind in ONE_AXIS and after.kind in (*ONE_AXIS, "fixed")


def _add_body(parent: Element, robot: Description, link: str, chain: Sequence[Joint], step: float) -> Element:
    """Add a link with the joints from its carrier to it."""
    rotations, places = [np.eye(3)], [np.zeros(3)]  # of the link's frame in the joints' frames, last joint first
    for joint in reversed(chain):
        rotations.append(joint.rotation @ rotations[-1])
        places.append(joint.place + joint.rotation @ places[-1])
    body = SubElement(parent, "body", name=link, pos=numbers_text(places[-1]))
    if not np.array_equal(rotations[-1], np.eye(3)):
        body.set("xyaxes", numbers_text(rotations[-1].T[:2].ravel()))
    for joint, rotation, place in zip(chain, reversed(rotations[:-1]), reversed(places[:-1]), strict=True):
        if joint.kind != "fixed":
            _add_joint(body, joint, rotation.T @ joint.axis, -rotation.T @ place, step)
    inertia = robot.links[link]
    if inertia.mass or np.any(inertia.second):
        centre = inertia.first / inertia.mass if inertia.mass else np.zeros(3)
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.about_centre
        tensor = numbers_text([xx, yy, zz, xy, xz, yz])
        mass = repr(float(inertia.mass))
        SubElement(body, "inertial", pos=numbers_text(centre), mass=mass, fullinertia=tensor)
    return body


def _add_joint(body: Element, joint: Joint, axis: np.ndarray, anchor: np.ndarray, step: float) -> None:
    if joint.kind not in KINDS:
        raise InputError(f"joint {joint.name!r} is {joint.kind}, and MJCF has no such joint; lock it")
    entry = SubElement(body, "joint", name=joint.name, type=KINDS[joint.kind])
    if joint.kind in ONE_AXIS:
        entry.set("axis", numbers_text(axis))
        if joint.encoder_offset:
            entry.set("ref", repr(-float(joint.encoder_offset)))
        if joint.stiffness:
            entry.set("springref", repr(float(joint.rest - joint.encoder_offset)))
        if joint.kind != "continuous" and -np.inf < joint.lower < joint.upper < np.inf:
            ends = np.array([joint.lower, joint.upper]) - joint.encoder_offset
            entry.set("range", numbers_text(ends))
    if joint.kind != "floating" and np.any(anchor):
        entry.set("pos", numbers_text(anchor))
    viscous, coulomb = plain_friction(joint)
    for key, value in {
        "stiffness": joint.stiffness,
        "damping": viscous,
        "frictionloss": coulomb,
        "armature": joint.armature,
    }.items():
        if value:
            entry.set(key, repr(float(value)))
    if coulomb:
        # Two steps are the shortest time constant that MuJoCo accepts.
        entry.attrib.update(solreffriction=numbers_text([2 * step, 1.0]), solimpfriction=STICKING)


def plain_friction(joint: Joint) -> tuple[Number, Number]:
    """Viscous and Coulomb friction of a joint, including a servo's damping that its limit does not affect."""
    viscous, coulomb = (joint.law.viscous, joint.law.coulomb) if joint.law else (joint.damping, joint.friction)
    return viscous + (drive_limit(joint.servo)[1] if joint.servo else 0.0), coulomb


def _add_equalities(whole: Element, robot: Description) -> None:
    """Add the constraints of joints that follow others, between deviations from `ref`, which are angles of the file."""
    followers = [(joint.name, joint.follows) for joint in robot.joints if joint.follows and joint.kind != "fixed"]
    if not followers and not robot.loops:
        return
    table = SubElement(whole, "equality")
    for name, follows in followers:
        entry = SubElement(table, "joint", joint1=name, polycoef=_polynomial(follows))
        if follows.joint:
            entry.set("joint2", follows.joint)


def _add_loops(whole: Element, robot: Description) -> None:
    """Add constraints that close the loops, between sites, and a keyframe with closed loops, as qpos0 may be open."""
    table, world = whole.find("equality"), whole.find("worldbody")
    if not robot.loops or table is None or world is None:
        return
    bodies = {"world": world} | {body.get("name", ""): body for body in whole.iter("body")}
    for loop in robot.loops:
        if isinstance(loop, Coupled):
            if len(loop.polynomial) > MOST_COEFFICIENTS:
                raise InputError(f"loop {loop.name!r}: MJCF has polynomials of order {MOST_COEFFICIENTS - 1} at most")
            entry = SubElement(table, "joint", name=loop.name, joint1=loop.joints[0], joint2=loop.joints[1])
            entry.set("polycoef", numbers_text(np.pad(loop.polynomial, (0, MOST_COEFFICIENTS - len(loop.polynomial)))))
            continue
        entry = SubElement(table, "connect" if loop.rotation is None else "weld", name=loop.name)
        # If the frames coincide, the second link's frame is rotated relative to the first one by `rotation`.
        turns = np.eye(3) if loop.rotation is None else np.array(loop.rotation), np.eye(3)
        for number, (link, point, turn) in enumerate(zip(loop.links, loop.points, turns, strict=True), 1):
            body = bodies.get(link)
            if body is None:
                raise InputError(f"loop {loop.name!r} holds link {link!r}, which has no mass; give it some")
            site = SubElement(body, "site", name=f"{loop.name} {number}", pos=numbers_text(point))
            if not np.array_equal(turn, np.eye(3)):
                site.set("xyaxes", numbers_text(turn.T[:2].ravel()))
            entry.set(f"site{number}", f"{loop.name} {number}")
    if robot.assembly is not None:
        kinds = {joint.name: joint.kind for joint in robot.joints}
        pose: list[float] = []
        for entry in whole.iter("joint"):
            if "type" in entry.attrib:  # joints of bodies, in the order of qpos
                name = entry.get("name", "")
                still = {"floating": [0, 0, 0, 1, 0, 0, 0], "ball": [1, 0, 0, 0]}.get(kinds[name], 0.0)
                pose += np.ravel(robot.assembly.get(name, still)).tolist()
        SubElement(SubElement(whole, "keyframe"), "key", name="assembled", qpos=numbers_text(pose))


def _polynomial(follows: Follows) -> str:
    return numbers_text([follows.offset, follows.ratio if follows.joint else 0.0, 0.0, 0.0, 0.0])


def _add_actuators(whole: Element, robot: Description, step: float) -> None:
    if not robot.motors:
        return
    table, joints = SubElement(whole, "actuator"), {joint.name: joint for joint in robot.joints}
    for motor in robot.motors:
        servo = joints[motor.joint].servo
        if servo is not None:
            _add_servo(table, motor, servo, step)
            continue
        entry = SubElement(table, "general", name=motor.name, joint=motor.joint)
        entry.set("gainprm", repr(float(motor.gain)))
        if motor.constant or motor.stiffness or motor.damping:
            bias = numbers_text([motor.constant, -motor.stiffness, -motor.damping])
            entry.attrib.update(biastype="affine", biasprm=bias)
        if len(motor.direction) > 1:
            entry.set("gear", numbers_text(motor.direction))


def _add_servo(table: Element, motor: Motor, servo: Servo, step: float) -> None:
    """Add `k (c + offset − q) − damping v` within the limit, as MuJoCo's general actuator or position servo."""
    stiffness, (limit, _) = servo.gain * servo.stiffness, drive_limit(servo)
    plain = not servo.offset and servo.command_scale == 1
    entry = SubElement(table, "position" if plain else "general", name=motor.name, joint=motor.joint)
    if plain:
        entry.attrib.update(kp=repr(float(stiffness)), kv=repr(float(servo.damping)))
    else:
        bias = numbers_text([stiffness * servo.offset, -stiffness, -servo.damping])
        entry.attrib.update(gainprm=repr(float(stiffness * servo.command_scale)), biastype="affine", biasprm=bias)
    if np.isfinite(limit):
        entry.set("forcerange", numbers_text([-limit, limit]))
    delay = lasting_delay(servo)
    if delay:
        samples = math.ceil(delay / step - ROUNDING) + SPARE_SAMPLES
        entry.attrib.update(delay=repr(delay), nsample=str(samples), interp="zoh")


def lasting_delay(servo: Servo) -> float:
    """Delay [s] of the command, reduced by the feedforward, which to first order is a lead."""
    return max(float(servo.delay - servo.feedforward / (servo.gain * servo.stiffness)), 0.0)
