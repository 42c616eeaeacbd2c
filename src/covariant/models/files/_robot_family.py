"""Represents a robot as a function of numbers that a log can determine, such as friction, rotors, loads and inertias.

Source: Rucker & Wensing 2022, Smooth Parameterization of Rigid-Body Inertia, IEEE Robotics and Automation Letters 7(2):
the inertia of a link as the triangular factor of its pseudo-inertia, with logarithms on the diagonal.
"""

import copy
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant._names import refuse_unknown
from covariant.models._parameters import AnyArray
from covariant.models.files._file import document, finish, made, parameters_of
from covariant.models.files._model_file import ModelFile, named
from covariant.models.files._open_numbers import GROUPS, OF_PAYLOAD, OPENED, OpenNumber, Scene, first_load
from covariant.models.files._toml import Overrides
from covariant.models.robots import OF_INERTIA, BodyInertia, Description, FrictionLaw, changed, inertia_of, read
from scalargraph.errors import InputError

LINEAR = ("mass", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Names of the ten numbers of a link in which torques are linear."""


class RobotFamily(NamedTuple):
    """A robot as a function of open numbers.

    Coordinates x (p,) are zero at the first values. They are changes of the numbers, except for inertias: there they
    are the entries α, d, s, t of the upper triangular `U(x)` of Rucker & Wensing, equation (11), in the pseudo-inertia
    `U₀ U(x) U(x)ᵀ U₀ᵀ`, where `U₀ U₀ᵀ` is the first one. So every x describes a body that is physically possible.

    Attributes:
        file: The model file with the first values.
        document: Its content.
        numbers: The p open numbers.
        spec: Name or path of the model.
        resting: Speed (n,) below which dry friction may hold each joint [rad/s or m/s]; 0 for a joint without it.
        parts: Indices (M, k) in `numbers` of the k numbers of each of M machines; for a single machine, all p.

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
    parts: Int[np.ndarray, "M k"]

    @property
    def one(self) -> "RobotFamily":
        """The family of one machine, without the numbers of others."""
        numbers = tuple(self.numbers[k]._replace(machine="") for k in self.parts[0])
        return self._replace(numbers=numbers, parts=np.arange(len(numbers))[None])

    def of_machines(self, machines: Sequence[str], own: Collection[str]) -> "RobotFamily":
        """Family of several machines that share their numbers, except some that differ between machines.

        Args:
            machines: Names of the M machines.
            own: Names of the numbers that differ between machines; `gravity@arm1` is the one of `arm1`.

        Returns:
            The family with the p numbers of all machines, the shared ones first.

        Example:
            >>> from covariant import models
            >>> family = models.robot_family("double_pendulum", ["armature"])
            >>> family.of_machines(["arm1", "arm2"], ["armature.elbow"]).names
            ('armature.shoulder', 'armature.elbow@arm1', 'armature.elbow@arm2')
        """
        is_own = np.array([number.name in own for number in self.numbers])
        shared, each = np.flatnonzero(~is_own), np.flatnonzero(is_own)
        numbers = [self.numbers[k] for k in shared]
        parts = np.zeros((len(machines), len(is_own)), int)
        parts[:, shared] = np.arange(len(shared))
        # The numbers of a machine are adjacent, as those of an inertia must be.
        for m, machine in enumerate(machines):
            parts[m, each] = len(numbers) + np.arange(len(each))
            numbers += [self.numbers[k]._replace(machine=machine) for k in each]
        return self._replace(numbers=tuple(numbers), parts=parts)

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

    def sizes(self, torque: np.ndarray, speed: np.ndarray, acceleration: np.ndarray) -> Float[np.ndarray, "p"]:
        """Usual sizes (p,) of the coordinates.

        Args:
            torque: Usual torques (n,) of the joints.
            speed: Usual speeds (n,).
            acceleration: Usual accelerations (n,).

        Returns:
            The sizes; for example, a viscous friction that accounts for all the torque at the usual speed.
        """
        motion = np.stack([torque, speed, acceleration])
        products = [float(np.prod(motion[:, n.joint] ** np.array(n.powers, float))) for n in self.numbers]
        return np.array([n.size * product for n, product in zip(self.numbers, products, strict=True)])

    def values(self, x: Float[AnyArray, "p"]) -> Float[Array, "p"]:
        """The numbers (p,) at the coordinates x (p,), which may be traced."""
        x = jnp.asarray(x)
        values = jnp.asarray(self.first) + x
        for start in self._inertias:
            block = slice(start, start + len(OF_INERTIA))
            values = values.at[block].set(_inertia_at(self.first[block], x[block]))
        return values

    def linear(self, x: Float[AnyArray, "p"]) -> Float[Array, "p"]:
        """The numbers (p,) in which torques are linear: for inertias, mass, first moments, and inertia about the
        origin of the link."""
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
            n.name
            if n.group != "inertia"
            else ".".join([n.group, n.target, LINEAR[OF_INERTIA.index(n.number)]]) + f"@{n.machine}" * bool(n.machine)
            for n in self.numbers
        )

    def make(self, x: Float[AnyArray, "k"]) -> Any:
        """The model of one machine at the coordinates x (k,); JAX can trace it."""
        return made(self.spec, self.with_values(self.one.values(x))).model

    def with_values(self, values: AnyArray) -> dict[str, Any]:
        """Copy the document with other values of the open numbers.

        Args:
            values: Values (k,) of one machine.

        Returns:
            Tables and keys of a model file.
        """
        content = copy.deepcopy(self.document)
        servos = content.get("servo", {})
        parameters = content.setdefault("parameters", {})
        entries = values.tolist() if isinstance(values, np.ndarray) else list(values)
        for number, value in zip(self.one.numbers, entries, strict=True):
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
            elif group == "servo":
                servos[target][number.number] = value
            elif number.number:
                parameters.setdefault(group, {}).setdefault(target, {})[number.number] = value
            else:
                parameters.setdefault(group, {})[target] = value
        return content

    @property
    def _inertias(self) -> list[int]:
        """Indices at which the ten numbers of each open inertia begin."""
        return [i for i, n in enumerate(self.numbers) if n.group == "inertia" and n.number == OF_INERTIA[0]]


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
        ModelError: One line that names the spec and the first fault.

    Example:
        >>> from covariant import models
        >>> models.robot_family("scara", ["payload"]).names
        ('payload.hand.mass', 'payload.hand.x', 'payload.hand.y', 'payload.hand.z')
    """
    with named(spec):
        return _family(spec, names, document(spec, overrides))


def _family(spec: str, names: Sequence[str], content: dict[str, Any]) -> RobotFamily:
    if content.get("system") != "robot":
        raise InputError(
            f"{', '.join(names)} are numbers of a robot, and this model is {content.get('system', spec)!r}"
        )
    file = finish(spec, content)
    if not file.model.manifold.commuting:
        raise InputError("a robot is fitted in joint coordinates: its base must stand still; lock its ball joints")
    if file.model.manifold.redundant:
        raise InputError(
            "numbers of a robot with closed loops are not fitted: each joint feels the forces in the loops; "
            "fit its parts with the loops open"
        )
    parameters = parameters_of(content)
    robot = read(parameters["path"], motor_torques=parameters.get("motor_torques", False))
    tables = {key: parameters[key] for key in (*GROUPS, "servos") if key in parameters and key != "payload"}
    robot = changed(robot, **tables)
    if not names:
        raise InputError(f"no number is named; name some of {', '.join(GROUPS)}")
    numbers: list[OpenNumber] = []
    for name in names:
        group, *rest = name.strip().removeprefix("parameters.").split(".")
        refuse_unknown("group of numbers", group, GROUPS)
        numbers += OPENED[group](Scene(file, robot, parameters, group, content.get("servo", {})), rest)
    for number in numbers:
        if [other.name for other in numbers].count(number.name) > 1:
            raise InputError(f"{number.name} is named twice; name it once")
    resting = _resting(robot, numbers)
    at = tuple(resting.get(name, 0.0) for name in file.model.coordinates)
    content, parts = _fill_laws(content, robot, numbers), np.arange(len(numbers))[None]
    family = RobotFamily(file, content, tuple(numbers), spec, at, parts)
    return family._replace(document=family.with_values(family.first))


def _resting(robot: Description, numbers: list[OpenNumber]) -> dict[str, float]:
    """Smoothing speed of the dry friction of each joint that has, or may get, dry friction."""
    opened = {n.target for n in numbers if n.group in ("friction", "servo") and n.number in ("coulomb", "stribeck")}
    laws = {joint.name: joint.law or FrictionLaw(coulomb=joint.friction) for joint in robot.joints}
    return {name: float(law.smoothing) for name, law in laws.items() if name in opened or law.coulomb or law.stribeck}


def _fill_laws(content: dict[str, Any], robot: Description, numbers: list[OpenNumber]) -> dict[str, Any]:
    """The document with all numbers of each opened friction law; a law replaces damping and friction of the file."""
    content = copy.deepcopy(content)
    for joint in robot.joints:
        if joint.law is None and any(n.group == "friction" and n.target == joint.name for n in numbers):
            first = {"viscous": joint.damping, "coulomb": joint.friction}
            content["parameters"].setdefault("friction", {})[joint.name] = first
    for link in {n.target for n in numbers if n.group == "payload"} - content["parameters"].get("payload", {}).keys():
        content["parameters"].setdefault("payload", {})[link] = first_load(robot, link)
    return content


def _pseudo_inertia(inertia: BodyInertia) -> np.ndarray:
    """The pseudo-inertia (4, 4): second moment, first moment and mass of a body."""
    side = np.asarray(inertia.first)[:, None]
    return np.block([[np.asarray(inertia.second), side], [side.T, np.array([[inertia.mass]])]])


def _inertia_at(first: Float[np.ndarray, "10"], x: Array) -> Array:
    """The ten numbers at coordinates x = (α, d1, d2, d3, s12, s23, s13, t1, t2, t3)."""
    pseudo = _pseudo_inertia(inertia_of("", first))
    # An upper triangular factor is the Cholesky factor of the matrix with rows and columns reversed, reversed back.
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


def _tensor_of(second: AnyArray) -> Array:
    """The six numbers ixx, iyy, izz, ixy, ixz, iyz of the inertia tensor tr(S) 1 − S of a second moment S."""
    xx, yy, zz = jnp.diagonal(second)
    return jnp.stack([yy + zz, zz + xx, xx + yy, -second[0, 1], -second[0, 2], -second[1, 2]])
