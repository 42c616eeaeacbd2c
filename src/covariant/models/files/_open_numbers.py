"""Lists the numbers of a robot that logs can determine, and the names by which they are opened."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant._names import refuse_unknown
from covariant.models.files._model_file import ModelFile
from covariant.models.robots import (
    OF_GEAR,
    OF_INERTIA,
    OF_SERVO,
    BodyInertia,
    Description,
    FrictionLaw,
    Joint,
    numbers_of,
)
from scalargraph.errors import InputError

GROUPS = ("friction", "armature", "payload", "inertia", "gravity", "torque_constants", "offsets", "servo")
"""Groups of open numbers: `GROUP`, `GROUP.NAME` for a joint or link, by name or number, and `GROUP.NAME.NUMBER`."""
USUAL_FRICTION = ("viscous", "coulomb", "asymmetry")
"""Numbers of the friction law that `friction` opens; other numbers are opened only by name."""
NEVER_OPEN = ("gain", "sign", "supply", "pwm_limit", "backlash", "smoothing")
"""Keys of a servo that are settings, or that logs cannot determine."""
OF_PAYLOAD: tuple[str, ...] = ("mass", "x", "y", "z")
FIRST_LOAD = 0.01
"""First mass of a payload that the model file does not state, relative to the robot's: its position has an effect only
if the mass is not zero."""
LEAST_INERTIA = 1e-6
"""Least eigenvalue of a link's pseudo-inertia, relative to the largest; a thinner body is thickened to it."""
USUAL_DELAY = 0.05
"""Usual size of a delay [s]."""
LENGTH, ANGLE = 0.1, 0.1
"""Usual sizes of a distance [m] and of an encoder offset [rad or m]."""


class OpenNumber(NamedTuple):
    """A number of a robot that is open.

    Attributes:
        group: One of `GROUPS`.
        target: Name of its joint or link; "" for gravity.
        number: The number within the group; "" if there is only one.
        first: Its first value.
        least: Its least value; −inf for none.
        unit: Its unit.
        size: Usual size of its change. For friction and rotors it is in units of the joint's torque, speed and
            acceleration, with the exponents `powers`.
        joint: Index of the coordinate; −1 for none.
        powers: Exponents of torque, speed and acceleration of the joint in the size.
        machine: The machine to which it belongs; "" for a number that all machines share.
    """

    group: str
    target: str
    number: str
    first: float
    least: float
    unit: str
    size: float = 1.0
    joint: int = -1
    powers: tuple[int, int, int] = (0, 0, 0)
    machine: str = ""

    @property
    def name(self) -> str:
        """Name as in `parameters` of `fit`, such as `friction.elbow.coulomb`; `…@arm1` for a single machine."""
        plain = ".".join(part for part in (self.group, self.target, self.number) if part)
        return plain + f"@{self.machine}" * bool(self.machine)


class Scene(NamedTuple):
    """The robot whose numbers are opened, the group of these numbers, and the tables of its servos."""

    file: ModelFile
    robot: Description
    parameters: dict[str, Any]
    group: str
    servos: dict[str, dict[str, Any]]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that are coordinates."""
        names = {joint.name for joint in self.robot.joints}
        return tuple(name for name in self.file.model.coordinates if name in names)

    def of_joints(self, rest: list[str], kinds: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
        """Joints that the remaining parts of a name select, and the parts after them; a name may begin with a kind."""
        if not rest or rest[0] in kinds:
            return self.joints, rest
        return (self._one(rest[0], self.joints),), rest[1:]

    def of_links(self, rest: list[str], usual: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
        if not rest:
            return tuple(usual), rest
        return (self._one(rest[0], tuple(self.robot.links)),), rest[1:]

    def _one(self, name: str, known: tuple[str, ...]) -> str:
        if name.isdigit() and 1 <= int(name) <= len(self.joints):
            joint = self.joints[int(name) - 1]
            child = next(j.child for j in self.robot.joints if j.name == joint)
            name = child if known is not self.joints and known != self.joints else joint
        refuse_unknown(f"{'joint' if known == self.joints else 'link'} in {self.group}", name, known)
        return name

    def joint(self, name: str) -> Any:
        return next(joint for joint in self.robot.joints if joint.name == name)

    def place(self, name: str) -> int:
        return self.file.model.coordinates.index(name)

    def unit(self, name: str) -> str:
        return self.file.model.units[self.place(name)]

    @property
    def moving_links(self) -> list[str]:
        """Links with mass that at least one joint moves."""
        model: Any = self.file.model
        links = model.space.links
        return [n for n, body in zip(links.names, links.bodies, strict=True) if body >= 0 and self.robot.links[n].mass]


def _refuse_rest(rest: list[str], where: str, known: Sequence[str] = ()) -> None:
    if rest:
        raise InputError(
            f"{where} has no {'.'.join(rest)!r}; " + (f"there are {', '.join(known)}" if known else "drop it")
        )


def _friction(scene: Scene, rest: list[str]) -> list[OpenNumber]:
    fields = FrictionLaw._fields[:-1]
    joints, rest = scene.of_joints(rest, fields)
    kinds = USUAL_FRICTION if not rest else tuple(rest[:1])
    if kinds[0] not in fields:
        _refuse_rest(rest, f"friction.{joints[0]}", fields)
    _refuse_rest(rest[1:], f"friction.{kinds[0]}")
    opened = []
    for name in joints:
        joint, i, unit = scene.joint(name), scene.place(name), scene.unit(name)
        law = joint.law or FrictionLaw(viscous=joint.damping, coulomb=joint.friction)
        force = "N m" if unit == "rad" else "N"
        for kind in kinds:
            least = -np.inf if kind == "asymmetry" else 0.0
            if kind == "viscous":
                own = f"{force} s/{unit}", 1.0, i, (1, -1, 0)
            elif kind == "stribeck_velocity":
                own, least = (f"{unit}/s", 0.1, i, (0, 0, 0)), 1e-3
            else:
                own = force, 1.0, i, (1, 0, 0)
            opened.append(OpenNumber("friction", name, kind, float(getattr(law, kind)), least, *own))
    return opened


def _of_joint(attribute: str, least: float, size: float, unit: Callable[[str], str], powers=(0, 0, 0)):
    """Function that opens one number of each joint."""

    def opened(scene: Scene, rest: list[str]) -> list[OpenNumber]:
        joints, rest = scene.of_joints(rest, ())
        _refuse_rest(rest, f"{scene.group}.{joints[0]}")
        return [
            OpenNumber(
                *(scene.group, name, "", float(getattr(scene.joint(name), attribute)), least),
                *(unit(scene.unit(name)), size, scene.place(name), powers),
            )
            for name in joints
        ]

    return opened


def _payload(scene: Scene, rest: list[str]) -> list[OpenNumber]:
    known = scene.parameters.get("payload", {})
    last = scene.moving_links[-1:] or list(scene.robot.links)[-1:]
    links, rest = scene.of_links(rest, tuple(known) or tuple(last))
    if rest and rest[0] not in OF_PAYLOAD:
        _refuse_rest(rest, f"payload.{links[0]}", OF_PAYLOAD)
    kinds = OF_PAYLOAD if not rest else tuple(rest[:1])
    units = dict(zip(OF_PAYLOAD, ("kg", "m", "m", "m"), strict=True))
    sizes = {"mass": float(sum(body.mass for body in scene.robot.links.values()))}
    opened = []
    for link in links:
        first = dict(zip(OF_PAYLOAD, known.get(link) or first_load(scene.robot, link), strict=True))
        opened += [
            OpenNumber(
                *("payload", link, kind, float(first[kind]), 0.0 if kind == "mass" else -np.inf),
                *(units[kind], sizes.get(kind, LENGTH)),
            )
            for kind in kinds
        ]
    return opened


def first_load(robot: Description, link: str) -> list[float]:
    """First load on a link without one: a small mass at the link's centre."""
    body, whole = robot.links[link], float(sum(each.mass for each in robot.links.values()))
    centre = body.first / body.mass if body.mass else np.zeros(3)
    return [FIRST_LOAD * whole, *centre.tolist()]


def _inertia(scene: Scene, rest: list[str]) -> list[OpenNumber]:
    links, rest = scene.of_links(rest, scene.moving_links)
    if rest:
        raise InputError(f"inertia.{links[0]}: its ten numbers are fitted together; drop {'.'.join(rest)!r}")
    units = ("kg", *("m",) * 3, *("kg m^2",) * 6)
    opened = []
    for link in links:
        if link not in scene.moving_links:
            known = ", ".join(scene.moving_links)
            raise InputError(f"inertia.{link}: it has no mass, or does not move; there are {known}")
        numbers = zip(OF_INERTIA, numbers_of(_thick(scene.robot.links[link])), units, strict=True)
        opened += [OpenNumber("inertia", link, kind, float(value), -np.inf, unit) for kind, value, unit in numbers]
    return opened


def _gravity(scene: Scene, rest: list[str]) -> list[OpenNumber]:
    _refuse_rest(rest, "gravity")
    size = float(np.linalg.norm(scene.robot.gravity))
    if not size:
        raise InputError("gravity: its direction is not known where it is zero; give [parameters] gravity = [x, y, z]")
    return [OpenNumber("gravity", "", "", size, 0.0, "m/s^2", size)]


def _servo(scene: Scene, rest: list[str]) -> list[OpenNumber]:
    """Numbers of servos: those that the tables state, or a single one by name."""
    tables = scene.servos
    if not tables:
        raise InputError("servo: the model has no [servo.JOINT] table, which states what each servo is")
    kinds = tuple(key for key in (*OF_SERVO, *OF_GEAR) if key not in NEVER_OPEN)
    joints, rest = scene.of_joints(rest, kinds)
    if rest and rest[0] not in kinds:
        _refuse_rest(rest, f"servo.{joints[0]}", kinds)
    _refuse_rest(rest[1:], f"servo.{'.'.join(rest[:1])}")
    opened = []
    for name in joints:
        if name not in tables:
            continue
        joint, unit = scene.joint(name), scene.unit(name)
        # A value inherited from another table by `like` is opened there, once for all tables that inherit it.
        if rest and "like" in tables[name] and rest[0] not in tables[name] and len(joints) > 1:
            continue
        for kind in rest or [kind for kind in kinds if kind in tables[name]]:
            first = _number_of_servo(joint, kind)
            if not np.isfinite(first):
                raise InputError(f"servo.{name}.{kind} has no first value; state one in [servo.{name}]")
            opened.append(
                OpenNumber(
                    *("servo", name, kind, first, -np.inf if kind in ("offset", "feedforward", "asymmetry") else 0.0),
                    *_sizes_of_servo(kind, "N m" if unit == "rad" else "N", unit, scene.place(name)),
                )
            )
    if not opened:
        raise InputError(f"servo: the model has no [servo.JOINT] of {', '.join(joints)}")
    return opened


def _number_of_servo(joint: Joint, kind: str) -> float:
    if kind == "armature":
        return float(joint.armature)
    return float(getattr(joint.law or FrictionLaw() if kind in FrictionLaw._fields else joint.servo, kind))


def _sizes_of_servo(kind: str, force: str, unit: str, place: int) -> tuple[str, float, int, tuple[int, int, int]]:
    """Unit, usual size, coordinate and powers of a number of a servo, as in `OpenNumber`."""
    rate = f"{force} s/{unit}"
    return {
        "stiffness": (f"{force}/{unit}", 10.0, place, (1, 0, 0)),
        "damping": (rate, 1.0, place, (1, -1, 0)),
        "feedforward": (rate, 1.0, place, (1, -1, 0)),
        "back_emf": (rate, 1.0, place, (1, -1, 0)),
        "viscous": (rate, 1.0, place, (1, -1, 0)),
        "delay": ("s", USUAL_DELAY, -1, (0, 0, 0)),
        "offset": (unit, ANGLE, -1, (0, 0, 0)),
        "dead_band": (unit, ANGLE, -1, (0, 0, 0)),
        "limit": (force, 1.0, place, (1, 0, 0)),
        "resistance": ("ohm", 1.0, -1, (0, 0, 0)),
        "torque_constant": (f"{force}/A", 1.0, place, (1, 0, 0)),
        "armature": ("kg m^2" if unit == "rad" else "kg", 1.0, place, (1, 0, -1)),
        "stribeck_velocity": (f"{unit}/s", 0.1, place, (0, 0, 0)),
        "load": ("1", 1.0, -1, (0, 0, 0)),
        "load_external": ("1", 1.0, -1, (0, 0, 0)),
    }.get(kind, (force, 1.0, place, (1, 0, 0)))


OPENED: dict[str, Callable[[Scene, list[str]], list[OpenNumber]]] = {
    "friction": _friction,
    "armature": _of_joint("armature", 0.0, 1.0, lambda unit: "kg m^2" if unit == "rad" else "kg", (1, 0, -1)),
    "payload": _payload,
    "inertia": _inertia,
    "gravity": _gravity,
    "torque_constants": _of_joint("torque_constant", 1e-6, 1.0, lambda unit: "1"),
    "servo": _servo,
    "offsets": _of_joint("encoder_offset", -np.inf, ANGLE, lambda unit: unit),
}


def _thick(inertia: BodyInertia) -> BodyInertia:
    """The nearest physically possible body, whose mass distribution is positive in all directions."""
    centre = inertia.first / inertia.mass
    central = inertia.second - inertia.mass * np.outer(centre, centre)
    moments, axes = np.linalg.eigh(central)
    floor = LEAST_INERTIA * max(moments[-1], inertia.mass * LENGTH**2 * LEAST_INERTIA)
    if moments[0] >= floor:
        return inertia
    central = axes @ np.diag(np.maximum(moments, floor)) @ axes.T
    return inertia._replace(second=central + inertia.mass * np.outer(centre, centre))
