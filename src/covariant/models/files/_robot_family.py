"""A robot as a function of numbers that a log may show: friction, rotors, loads, inertias, gravity, constants, offsets.

Source: Rucker & Wensing 2022, Smooth Parameterization of Rigid-Body Inertia, IEEE Robotics and Automation Letters 7(2),
for the inertia of a link as the triangular factor of its pseudo-inertia, with the logarithms of the diagonal.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.models._names import refuse_unknown
from covariant.models._parameters import AnyArray
from covariant.models.files._file import document, finish, made
from covariant.models.files._model_file import ModelFile, named
from covariant.models.files._toml import Overrides
from covariant.models.robots import (
    OF_INERTIA,
    BodyInertia,
    Description,
    FrictionLaw,
    changed,
    inertia_of,
    numbers_of,
    read,
)

GROUPS = ("friction", "armature", "payload", "inertia", "gravity", "torque_constants", "offsets")
"""What may be open: `GROUP`, `GROUP.NAME` of a joint or link, by name or number, and `GROUP.NAME.NUMBER`."""
USUAL_FRICTION = ("viscous", "coulomb", "asymmetry")
"""Numbers of the friction law that `friction` opens; the others are opened by their names."""
OF_PAYLOAD: tuple[str, ...] = ("mass", "x", "y", "z")
LINEAR = ("mass", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Names of the ten numbers of a link in which torques are linear."""
FIRST_LOAD = 0.01
"""First mass of a payload that the model file does not have, relative to that of the robot: where it is shows only with
a mass."""
LEAST_INERTIA = 1e-6
"""Least eigenvalue of a link's pseudo-inertia, relative to the largest: a thinner body is thickened to it."""
LENGTH, ANGLE = 0.1, 0.1
"""Usual sizes of a distance [m] and of an encoder offset [rad or m]."""


class OpenNumber(NamedTuple):
    """A number of a robot that is open.

    Attributes:
        group: One of `GROUPS`.
        target: Name of its joint or link; "" for gravity.
        number: Which number of these; "" where there is one.
        first: Its first value.
        least: Its least value; −inf where it has none.
        unit: Its unit.
        size: Usual size of its change; for friction and rotors, in the units of the torque of a joint, of its speed and
            of its acceleration, as exponents in `powers`.
        joint: Index of the coordinate; −1 where there is none.
        powers: Exponents of torque, speed and acceleration of the joint in the size.
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

    @property
    def name(self) -> str:
        """Name as in `parameters` of `fit`, such as `friction.elbow.coulomb`."""
        return ".".join(part for part in (self.group, self.target, self.number) if part)


class RobotFamily(NamedTuple):
    """A robot as a function of open numbers.

    Coordinates x (p,) are zero at the first values. They are changes of the numbers, but those of an inertia are the
    entries α, d, s, t of the upper triangular `U(x)` of Rucker & Wensing, equation (11), in the pseudo-inertia
    `U₀ U(x) U(x)ᵀ U₀ᵀ`, where `U₀ U₀ᵀ` is the first one. So every x is a body that can exist.

    Attributes:
        file: The model file with the first values.
        document: Its content.
        numbers: The p open numbers.
        spec: Name or path of the model.
        resting: Speeds (n,) below which dry friction may hold each joint [rad/s or m/s]; 0 for one without.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> family = models.robot_family("double_pendulum", ["armature", "friction.elbow.coulomb"])
        >>> family.names
        ('armature.shoulder', 'armature.elbow', 'friction.elbow.coulomb')
        >>> family.with_values(np.array([0.0, 0.1, 0.2]))["parameters"]["armature"]
        {'shoulder': 0.0, 'elbow': 0.1}
    """

    file: ModelFile
    document: dict[str, Any]
    numbers: tuple[OpenNumber, ...]
    spec: str
    resting: tuple[float, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers (p,)."""
        return tuple(number.name for number in self.numbers)

    @property
    def first(self) -> Float[np.ndarray, "p"]:
        """First values (p,)."""
        return np.array([number.first for number in self.numbers])

    @property
    def least(self) -> Float[np.ndarray, "p"]:
        """Least coordinates x (p,)."""
        return np.array([number.least - number.first for number in self.numbers])

    def sizes(self, torque: Any, speed: Any, acceleration: Any) -> Float[np.ndarray, "p"]:
        """Usual sizes (p,) of the coordinates.

        Args:
            torque: Usual torques (n,) of the joints.
            speed: Usual speeds (n,).
            acceleration: Usual accelerations (n,).

        Returns:
            The sizes, such as that of a viscous friction which takes all the torque at the usual speed.
        """
        motion = np.stack([torque, speed, acceleration])
        return np.array(
            [n.size * float(np.prod(motion[:, n.joint] ** np.array(n.powers, float))) for n in self.numbers]
        )

    def values(self, x: Float[AnyArray, "p"]) -> Float[Array, "p"]:
        """Numbers (p,) at the coordinates x (p,), traced or not."""
        x = jnp.asarray(x)
        values = jnp.asarray(self.first) + x
        for start in self._inertias:
            block = slice(start, start + len(OF_INERTIA))
            values = values.at[block].set(_inertia_at(self.first[block], x[block]))
        return values

    def linear(self, x: Float[AnyArray, "p"]) -> Float[Array, "p"]:
        """The numbers (p,) with those of inertias in their linear form: mass, first moments, inertia about the origin
        of the link; so the torques are linear in them."""
        values = self.values(x)
        for start in self._inertias:
            block = slice(start, start + len(OF_INERTIA))
            body = inertia_of("", values[block])
            numbers = [jnp.asarray(body.mass)[None], jnp.asarray(body.first), _tensor_of(body.second)]
            values = values.at[block].set(jnp.concatenate(numbers))
        return values

    @property
    def linear_names(self) -> tuple[str, ...]:
        """Names of `linear`: `inertia.hand.mx` is a first moment, `inertia.hand.Ixx` is about the link's origin."""
        return tuple(
            n.name if n.group != "inertia" else ".".join([n.group, n.target, LINEAR[OF_INERTIA.index(n.number)]])
            for n in self.numbers
        )

    def make(self, x: Float[AnyArray, "p"]) -> Any:
        """The model at the coordinates x (p,), which JAX may trace."""
        return made(self.spec, self.with_values(self.values(x))).model

    def with_values(self, values: Any) -> dict[str, Any]:
        """Copy the document with other values of the open numbers.

        Args:
            values: Values (p,).

        Returns:
            Tables and keys of a model file.
        """
        content = copy.deepcopy(self.document)
        parameters = content.setdefault("parameters", {})
        entries = values.tolist() if isinstance(values, np.ndarray) else list(values)
        for number, value in zip(self.numbers, entries, strict=True):
            group, target = number.group, number.target
            if group == "gravity":
                old = parameters.get(group)
                parameters[group] = [entry / number.first * value for entry in old] if isinstance(old, list) else value
            elif group in ("payload", "inertia"):
                table = parameters.setdefault(group, {})
                kinds = OF_PAYLOAD if group == "payload" else OF_INERTIA
                table.setdefault(target, [0.0] * len(kinds))
                table[target] = [*table[target]]
                table[target][kinds.index(number.number)] = value
            elif number.number:
                parameters.setdefault(group, {}).setdefault(target, {})[number.number] = value
            else:
                parameters.setdefault(group, {})[target] = value
        return content

    @property
    def _inertias(self) -> list[int]:
        """Where the ten numbers of each open inertia begin."""
        return [i for i, n in enumerate(self.numbers) if n.group == "inertia" and n.number == OF_INERTIA[0]]


def is_robot_number(name: str) -> bool:
    """Whether a name is one of `GROUPS`, or of a number in one: `friction`, `friction.elbow`, `armature.3`."""
    return "[" not in name and name.strip().removeprefix("parameters.").split(".")[0] in GROUPS


def robot_family(spec: str, names: Sequence[str], overrides: Overrides = ()) -> RobotFamily:
    """Robot as a function of the named numbers.

    Args:
        spec: A model file of a robot, its URDF or MJCF file, or the name of a robot of the library.
        names: `friction`, `armature`, `payload`, `inertia`, `gravity`, `torque_constants` or `offsets`, for all joints
            or links; one of them, by its name or the number of the joint from 1: `armature.elbow`, `inertia.3`; or one
            number: `friction.elbow.stribeck`, `friction.stribeck`, `payload.hand.mass`.
        overrides: As for `load`; they may set first values.

    Returns:
        The family.

    Raises:
        ModelError: One line that names the spec and the first thing wrong.

    Example:
        >>> from covariant import models
        >>> models.robot_family("scara", ["payload"]).names
        ('payload.hand.mass', 'payload.hand.x', 'payload.hand.y', 'payload.hand.z')
    """
    with named(spec):
        return _family(spec, names, document(spec, overrides))


def _family(spec: str, names: Sequence[str], content: dict[str, Any]) -> RobotFamily:
    if content.get("system") != "robot":
        raise ValueError(
            f"{', '.join(names)} are numbers of a robot, and this model is {content.get('system', spec)!r}"
        )
    file = finish(spec, content)
    if not file.model.manifold.commuting:
        raise ValueError("a robot is fitted in joint coordinates: its base must stand still; lock its ball joints")
    parameters = content.get("parameters", {})
    robot = read(parameters["path"], motor_torques=parameters.get("motor_torques", False))
    tables = {key: parameters[key] for key in GROUPS if key in parameters and key != "payload"}
    robot = changed(robot, **tables)
    if not names:
        raise ValueError(f"no number is named; name some of {', '.join(GROUPS)}")
    numbers: list[OpenNumber] = []
    for name in names:
        group, *rest = name.strip().removeprefix("parameters.").split(".")
        refuse_unknown("group of numbers", group, GROUPS)
        numbers += _OPENED[group](_Scene(file, robot, parameters, group), rest)
    for number in numbers:
        if [other.name for other in numbers].count(number.name) > 1:
            raise ValueError(f"{number.name} is named twice; name it once")
    resting = _resting(robot, numbers)
    at = tuple(resting.get(name, 0.0) for name in file.model.coordinates)
    family = RobotFamily(file, _fill_laws(content, robot, numbers), tuple(numbers), spec, at)
    return family._replace(document=family.with_values(family.first))


def _resting(robot: Description, numbers: list[OpenNumber]) -> dict[str, float]:
    """Speed at which dry friction is smoothed, of each joint that has some by its law or its file, or may get some."""
    opened = {n.target for n in numbers if n.group == "friction" and n.number in ("coulomb", "stribeck")}
    laws = {joint.name: joint.law or FrictionLaw(coulomb=joint.friction) for joint in robot.joints}
    return {name: float(law.smoothing) for name, law in laws.items() if name in opened or law.coulomb or law.stribeck}


def _fill_laws(content: dict[str, Any], robot: Description, numbers: list[OpenNumber]) -> dict[str, Any]:
    """The document with all numbers of each law that is opened: in it a law takes the place of damping and friction."""
    content = copy.deepcopy(content)
    for joint in robot.joints:
        if joint.law is None and any(n.group == "friction" and n.target == joint.name for n in numbers):
            first = {"viscous": joint.damping, "coulomb": joint.friction}
            content["parameters"].setdefault("friction", {})[joint.name] = first
    for link in {n.target for n in numbers if n.group == "payload"} - content["parameters"].get("payload", {}).keys():
        content["parameters"].setdefault("payload", {})[link] = _first_load(robot, link)
    return content


class _Scene(NamedTuple):
    """The robot of which numbers are opened, and the group that they are in."""

    file: ModelFile
    robot: Description
    parameters: dict[str, Any]
    group: str

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that are coordinates."""
        names = {joint.name for joint in self.robot.joints}
        return tuple(name for name in self.file.model.coordinates if name in names)

    def of_joints(self, rest: list[str], kinds: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
        """Joints that the rest of a name selects, and what remains of it; a name may begin with a kind."""
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
        """Links with a mass that some joint moves."""
        model: Any = self.file.model
        links = model.space.links
        return [n for n, body in zip(links.names, links.bodies, strict=True) if body >= 0 and self.robot.links[n].mass]


def _refuse_rest(rest: list[str], where: str, known: Sequence[str] = ()) -> None:
    if rest:
        raise ValueError(
            f"{where} has no {'.'.join(rest)!r}; " + (f"there are {', '.join(known)}" if known else "drop it")
        )


def _friction(scene: _Scene, rest: list[str]) -> list[OpenNumber]:
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

    def opened(scene: _Scene, rest: list[str]) -> list[OpenNumber]:
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


def _payload(scene: _Scene, rest: list[str]) -> list[OpenNumber]:
    known = scene.parameters.get("payload", {})
    last = scene.moving_links[-1:] or list(scene.robot.links)[-1:]
    links, rest = scene.of_links(rest, tuple(known) or tuple(last))
    if rest and rest[0] not in OF_PAYLOAD:
        _refuse_rest(rest, f"payload.{links[0]}", OF_PAYLOAD)
    kinds = OF_PAYLOAD if not rest else tuple(rest[:1])
    units, sizes = (
        dict(zip(OF_PAYLOAD, ("kg", "m", "m", "m"), strict=True)),
        {"mass": sum(body.mass for body in scene.robot.links.values())},
    )
    opened = []
    for link in links:
        first = dict(zip(OF_PAYLOAD, known.get(link) or _first_load(scene.robot, link), strict=True))
        opened += [
            OpenNumber(
                *("payload", link, kind, float(first[kind]), 0.0 if kind == "mass" else -np.inf),
                *(units[kind], sizes.get(kind, LENGTH)),
            )
            for kind in kinds
        ]
    return opened


def _first_load(robot: Description, link: str) -> list[float]:
    """First load on a link without one: a small mass in the centre of the link."""
    body, whole = robot.links[link], sum(each.mass for each in robot.links.values())
    centre = body.first / body.mass if body.mass else np.zeros(3)
    return [FIRST_LOAD * whole, *centre.tolist()]


def _inertia(scene: _Scene, rest: list[str]) -> list[OpenNumber]:
    links, rest = scene.of_links(rest, scene.moving_links)
    if rest:
        raise ValueError(f"inertia.{links[0]}: its ten numbers are fitted together; drop {'.'.join(rest)!r}")
    units = ("kg", *("m",) * 3, *("kg m^2",) * 6)
    opened = []
    for link in links:
        if link not in scene.moving_links:
            raise ValueError(
                f"inertia.{link}: it has no mass, or does not move; there are {', '.join(scene.moving_links)}"
            )
        first = numbers_of(_thick(scene.robot.links[link]))
        opened += [
            OpenNumber("inertia", link, kind, float(value), -np.inf, unit)
            for kind, value, unit in zip(OF_INERTIA, first, units, strict=True)
        ]
    return opened


def _gravity(scene: _Scene, rest: list[str]) -> list[OpenNumber]:
    _refuse_rest(rest, "gravity")
    size = float(np.linalg.norm(scene.robot.gravity))
    if not size:
        raise ValueError("gravity: its direction is not known where it is zero; give [parameters] gravity = [x, y, z]")
    return [OpenNumber("gravity", "", "", size, 0.0, "m/s^2", size)]


_OPENED: dict[str, Callable[[_Scene, list[str]], list[OpenNumber]]] = {
    "friction": _friction,
    "armature": _of_joint("armature", 0.0, 1.0, lambda unit: "kg m^2" if unit == "rad" else "kg", (1, 0, -1)),
    "payload": _payload,
    "inertia": _inertia,
    "gravity": _gravity,
    "torque_constants": _of_joint("torque_constant", 1e-6, 1.0, lambda unit: "1"),
    "offsets": _of_joint("encoder_offset", -np.inf, ANGLE, lambda unit: unit),
}


def _pseudo_inertia(inertia: BodyInertia) -> np.ndarray:
    """The pseudo-inertia (4, 4): second moment, first moment and mass of a body."""
    side = np.asarray(inertia.first)[:, None]
    return np.block([[np.asarray(inertia.second), side], [side.T, np.array([[inertia.mass]])]])


def _thick(inertia: BodyInertia) -> BodyInertia:
    """The body nearest to one that can exist: with a mass distribution that is positive in all directions."""
    centre = inertia.first / inertia.mass
    central = inertia.second - inertia.mass * np.outer(centre, centre)
    moments, axes = np.linalg.eigh(central)
    floor = LEAST_INERTIA * max(moments[-1], inertia.mass * LENGTH**2 * LEAST_INERTIA)
    if moments[0] >= floor:
        return inertia
    central = axes @ np.diag(np.maximum(moments, floor)) @ axes.T
    return inertia._replace(second=central + inertia.mass * np.outer(centre, centre))


def _inertia_at(first: Float[np.ndarray, "10"], x: Array) -> Array:
    """The ten numbers at coordinates x = (α, d1, d2, d3, s12, s23, s13, t1, t2, t3)."""
    pseudo = _pseudo_inertia(inertia_of("", first))
    # An upper triangular factor: that of the Cholesky factor of the matrix with rows and columns reversed.
    upper = np.linalg.cholesky(pseudo[::-1, ::-1])[::-1, ::-1]
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = x
    zero, one = jnp.zeros_like(alpha), jnp.ones_like(alpha)
    rows = [
        [jnp.exp(d1), s12, s13, t1],
        [zero, jnp.exp(d2), s23, t2],
        [zero, zero, jnp.exp(d3), t3],
        [zero, zero, zero, one],
    ]
    factor = jnp.asarray(upper) @ (jnp.exp(alpha) * jnp.stack([jnp.stack(row) for row in rows]))
    p = factor @ factor.T
    mass, moment, second = p[3, 3], p[:3, 3], p[:3, :3]
    central = second - jnp.outer(moment, moment) / mass
    return jnp.concatenate([jnp.stack([mass, *(moment / mass)]), _tensor_of(central)])


def _tensor_of(second: Any) -> Array:
    """The six numbers ixx, iyy, izz, ixy, ixz, iyz of the inertia tensor of a second moment S: tr(S) 1 − S."""
    xx, yy, zz = jnp.diagonal(second)
    return jnp.stack([yy + zz, zz + xx, xx + yy, -second[0, 1], -second[0, 2], -second[1, 2]])
