"""Defines the kinds of sensors: encoders, tachometers, gyros, accelerometers, poses and positions of points on links.

A kind is a final class with the output of a sensor as a function of the motion, the reading of its table in a model
file, and the properties that `check` needs. The function before the class creates a sensor of this kind, with noise and
bias. Model files are checked without observers, so the keys of each kind are in `models/files/_sensor_keys.py`.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Numbers, Vector
from covariant.geometry import AbstractSpace
from covariant.geometry.lie import SO3
from covariant.models import ModelFile
from covariant.models.robots import RobotSpace, robot_space
from covariant.observers.base import as_numbers, check_positive
from covariant.observers.sensors._sensors import Instant, Sensor
from covariant.observers.sensors._slow import SlowVariables, SlowVector
from scalargraph.errors import InputError

STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
"""Gravity in the frame of the world [m/s²] of an accelerometer, by default."""


class Checks(NamedTuple):
    """Properties of a kind of sensor that `check` needs to compare its readings with the positions.

    Attributes:
        derivative: Which derivative of the configuration it reads.
        coordinates: Whether it reads coordinates by name; a scale of its readings may then be a gear, its `reduction`.
        vector: Whether its numbers are components of one vector, for which signs, orders and rotations are tried;
            otherwise each number has its own scale.
        own_axes: Whether a vector is in the axes of the sensor, which its table states, and not in those of the world.
        offset: Whether a constant offset is a bias; for a sensor that measures gravity the constant part shows its
        axes.
    """

    derivative: int = 0
    coordinates: bool = False
    vector: bool = False
    own_axes: bool = False
    offset: bool = True


class AbstractSensorKind(eqx.Module):
    """A kind of sensor; an instance is the output `h` of one `Sensor`, with the bias s (k,), or (0,) without one."""

    kind: ClassVar[str]
    checks: ClassVar[Checks]

    @abc.abstractmethod
    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        """The reading (j,) at an instant."""

    @abc.abstractmethod
    def perturbed(self, reading: Vector, noise: Float[Array, "i"]) -> Vector:
        """A reading (j,) whose innovation, relative to the reading passed, is the noise (i,)."""

    @classmethod
    @abc.abstractmethod
    def from_table(cls, name: str, file: ModelFile, table: Mapping[str, Any]) -> tuple[Sensor, str]:
        """The sensor that a table of a model file describes, and the SI unit of its readings, "" if unknown."""


class _AbstractNumbers(AbstractSensorKind):
    """Sensors whose readings are numbers with independent noise and bias."""

    @abc.abstractmethod
    def value(self, now: Instant) -> Vector:
        """The reading (k,) without its bias."""

    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        value = self.value(now)
        return value + s if s.shape[0] else value

    def perturbed(self, reading: Vector, noise: Float[Array, "k"]) -> Vector:
        return reading + noise


class _AbstractComponents(_AbstractNumbers):
    """Sensors of some entries of the configuration or of the velocity, each times a reduction."""

    field: ClassVar[str]
    places: tuple[int, ...] = eqx.field(static=True)
    reduction: Float[Array, "k"]

    def value(self, now: Instant) -> Vector:
        value = getattr(now, self.field)[jnp.array(self.places)]
        return self.reduction.astype(value.dtype) * value


class _AbstractOnLink(AbstractSensorKind):
    """Sensors on a link: the link, the axes of the sensor in its frame, and the sensor's position there."""

    make: ClassVar[Callable[..., Sensor]]
    unit: ClassVar[str]
    space: RobotSpace
    link: str = eqx.field(static=True)
    axes: Float[Array, "3 3"]
    place: Float[Array, "3"]

    @classmethod
    def from_table(cls, name: str, file: ModelFile, table: Mapping[str, Any]) -> tuple[Sensor, str]:
        model: Any = file.model
        return cls.make(model.space, name=name, **table), cls.unit

    def pose(self, q: Array) -> tuple[Array, Array]:
        """Rotation (3, 3) and position (3,) of the sensor in the world."""
        pose = self.space.pose(q, self.link)
        rotation = pose[:3, :3]
        return rotation @ self.axes.astype(q.dtype), rotation @ self.place.astype(q.dtype) + pose[:3, 3]

    def twist(self, q: Array, v: Vector) -> tuple[Array, Array]:
        """Velocity (3,) of the sensor's position, and angular velocity (3,), both in the sensor's axes."""
        speed, spin = jnp.split(self.space.jacobian(q, self.link) @ v, 2)
        axes = self.axes.astype(q.dtype)
        # x @ A is Aᵀ x: it converts from the axes of the link to those of the sensor.
        return (speed + jnp.cross(spin, self.place.astype(q.dtype))) @ axes, spin @ axes


def encoder(
    places: Sequence[int],
    std: Numbers,
    *,
    reduction: Numbers = 1.0,
    period: Numbers = 0.0,
    name: str = "encoder",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Positions of some coordinates, at the joint or, with a reduction, at the motor.

    The measured configuration of a record needs no sensor. Add an encoder if a second one reads the same joint, such as
    one at the motor side of a gear, or if some joints are read at another rate. A reading is `reduction` times the
    coordinate, and `std` is in the unit of the reading. It is for systems in coordinates; use `pose_sensor` for the
    pose of a link.

    Args:
        places: Indices (k,) of the coordinates.
        std: Standard deviation of a reading, one number or (k,) [rad or m; at the motor if there is a reduction].
        reduction: Turns of the motor per turn of the joint, one number or (k,); 1 (default) at the joint.
        period: Period of the readings, one number or (k,), such as 2π for angles within a turn; 0 (default) for
            readings that count turns.
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset of the readings at the start, one number or (k,), which is
            estimated; None (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (k,); 0 by default.

    Returns:
        The sensor, for systems in coordinates.

    Raises:
        ValueError: A number is out of its range, or there are too many.

    Example:
        >>> from covariant import observers
        >>> motor = observers.encoder([0], 1e-3, reduction=100.0, name="motor")
        >>> motor.count, motor.name
        (1, 'motor')
    """
    return _components(Encoder, places, std, reduction, name, (bias_std, bias_drift), period)


class Encoder(_AbstractComponents):
    kind, field = "encoder", "q"
    checks = Checks(coordinates=True)

    @classmethod
    def from_table(cls, name: str, file: ModelFile, table: Mapping[str, Any]) -> tuple[Sensor, str]:
        model: Any = file.model
        if not model.manifold.commuting:
            raise InputError("an encoder is of coordinates, and the model is on a group; give a pose or a point")
        places, settings = _resolve_names(table, model.coordinates, file.columns.q)
        reduction = np.abs(np.broadcast_to(np.asarray(table.get("reduction", 1.0), float), len(places)))
        # A reading at the joint is an angle within a turn; a reading behind a gear counts turns.
        period = np.where(np.isin(places, model.circles) & (reduction == 1), 2 * np.pi, 0.0)
        unit = model.units[places[0]] if model.units else ""
        return encoder(places, name=name, period=period, **settings), unit


def tachometer(
    places: Sequence[int],
    std: Numbers,
    *,
    reduction: Numbers = 1.0,
    name: str = "tachometer",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Some components of the velocity: joint rates or, on a group, body rates, as from a gyro on an aircraft.

    A reading contains the velocity directly, and reduces lag and noise. Use `gyro` for a sensor that is mounted on a
    link of a robot and has its own axes.

    Args:
        places: Indices (k,) of the components, in the frame of the configuration space.
        std: Standard deviation of a reading, one number or (k,) [rad/s or m/s].
        reduction: Factor of the readings, one number or (k,), such as the reduction of a gear; 1 by default.
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (k,), which is estimated; None
            (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (k,); 0 by default.

    Returns:
        The sensor.

    Raises:
        ValueError: A number is out of its range, or there are too many.

    Example:
        >>> from covariant import observers
        >>> gyro = observers.tachometer([0, 1, 2], 0.01, name="gyro", bias_std=0.1)
        >>> gyro.slow.names
        ('gyro_bias1', 'gyro_bias2', 'gyro_bias3')
    """
    return _components(Tachometer, places, std, reduction, name, (bias_std, bias_drift), 0.0)


class Tachometer(_AbstractComponents):
    kind, field = "tachometer", "v"
    checks = Checks(derivative=1, coordinates=True)

    @classmethod
    def from_table(cls, name: str, file: ModelFile, table: Mapping[str, Any]) -> tuple[Sensor, str]:
        model: Any = file.model
        charted = model.manifold.commuting
        joints = (model.coordinates, file.columns.q) if charted else ()
        places, settings = _resolve_names(table, *joints, model.velocities)
        units = model.units if charted else model.velocity_units
        unit = units[places[0]] if units else ""
        return tachometer(places, name=name, **settings), f"{unit}/s" if charted and unit else unit


def gyro(
    space: AbstractSpace,
    link: str,
    std: Numbers,
    *,
    axes: Numbers | None = None,
    name: str = "gyro",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Angular velocity of a link of a robot, in the axes of the sensor.

    Use it on any link of a robot. It measures velocity without differentiation, and reduces the noise and lag of
    velocities from positions alone. State `bias_std` for a low-cost sensor, whose offset is then estimated. For a body
    whose configuration is itself an attitude, use `tachometer`.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        std: Standard deviation of a reading, one number or (3,) [rad/s].
        axes: Rotation (3, 3) from the axes of the sensor to those of the link; None (default) if they are the same.
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (3,), which is estimated [rad/s];
            None (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (3,); 0 by default.

    Returns:
        The sensor, of three numbers.

    Raises:
        ValueError: There is no such link, the axes are not a rotation, or a number is out of its range.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> observers.gyro(arm.space, "lower", 0.01).count
        3
    """
    h = Gyro(*_on_link("gyro", space, link, axes, (0.0, 0.0, 0.0)))
    return _sensor("gyro", name, h, _stds("gyro", "std", std, 3), (bias_std, bias_drift))


class Gyro(_AbstractOnLink, _AbstractNumbers):
    kind, unit, make = "gyro", "rad/s", staticmethod(gyro)
    checks = Checks(derivative=1, vector=True, own_axes=True)

    def value(self, now: Instant) -> Vector:
        return self.twist(now.q, now.v)[1]


def accelerometer(
    space: AbstractSpace,
    link: str,
    std: Numbers,
    *,
    axes: Numbers | None = None,
    place: Numbers = (0.0, 0.0, 0.0),
    gravity: Numbers = STANDARD_GRAVITY,
    name: str = "accelerometer",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Acceleration of a point on a link minus gravity, in the axes of the sensor: the specific force.

    The acceleration is that of the model with its estimated forces. White acceleration noise, `process_cov`, is not
    part of it: describe unknown forces by `external_force`, and choose a `std` that covers the rest.

    At rest it reads gravity with the opposite sign, so a sensor whose z axis points up reads +9.81 m/s². Use it
    together with `gyro` for an inertial unit on a link.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        std: Standard deviation of a reading, one number or (3,) [m/s²].
        axes: Rotation (3, 3) from the axes of the sensor to those of the link; None (default) if they are the same.
        place: Place of the sensor in the frame of the link [m]; its origin by default.
        gravity: Gravity in the frame of the world [m/s²].
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (3,), which is estimated [m/s²];
            None (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (3,); 0 by default.

    Returns:
        The sensor, of three numbers.

    Raises:
        ValueError: There is no such link, the axes are not a rotation, or a number is out of its range.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> imu = observers.accelerometer(arm.space, "lower", 0.1)
        >>> zero = jnp.zeros(2)  # hanging at rest it feels what holds it
        >>> imu.h(observers.Instant(zero, zero, lambda: zero, zero, 0.0), zero[:0]).round(3).tolist()
        [0.0, 0.0, 9.807]
    """
    where = _on_link("accelerometer", space, link, axes, place)
    h = Accelerometer(*where, jnp.asarray(as_numbers("accelerometer", "gravity", gravity, 3)))
    return _sensor("accelerometer", name, h, _stds("accelerometer", "std", std, 3), (bias_std, bias_drift))


class Accelerometer(_AbstractOnLink, _AbstractNumbers):
    kind, unit, make = "accelerometer", "m/s^2", staticmethod(accelerometer)
    checks = Checks(derivative=2, vector=True, own_axes=True, offset=False)
    gravity: Float[Array, "3"]

    def value(self, now: Instant) -> Vector:
        rates = self.space.manifold.tangent(now.q, now.v), now.acceleration()
        (speed, spin), (change, _) = jax.jvp(self.twist, (now.q, now.v), rates)
        # In rotating axes, the velocity changes by ω × v less than in the world.
        return change + jnp.cross(spin, speed) - self.gravity.astype(speed.dtype) @ self.pose(now.q)[0]


def pose_sensor(
    space: AbstractSpace,
    link: str,
    position_std: Numbers,
    rotation_std: Numbers,
    *,
    axes: Numbers | None = None,
    place: Numbers = (0.0, 0.0, 0.0),
    name: str = "pose",
) -> Sensor:
    """Pose of a link of a robot in the world, as from a camera or motion capture.

    A reading is the position (3,) and then the rotation R_world_sensor (3, 3), row by row, twelve numbers. Its
    innovation is the difference of the positions, and the rotation vector `log(R̂ᵀR)` in the axes of the sensor.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        position_std: Standard deviation of a position, one number or (3,) [m].
        rotation_std: Standard deviation of a rotation vector, one number or (3,) [rad].
        axes: Rotation (3, 3) from the axes of the markers to those of the link; None (default) if they are the same.
        place: Position of the markers in the frame of the link [m]; its origin by default.
        name: Name of the sensor.

    Returns:
        The sensor. A reading with a missing number is missing as a whole.

    Raises:
        ValueError: There is no such link, the axes are not a rotation, or a number is out of its range.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> camera = observers.pose_sensor(arm.space, "lower", 1e-3, 1e-2, name="camera")
        >>> camera.count, len(camera.cov)
        (12, 6)
    """
    h = Pose(*_on_link("pose_sensor", space, link, axes, place))
    stds = [_stds("pose_sensor", *each, 3) for each in (("position_std", position_std), ("rotation_std", rotation_std))]
    return Sensor(name, h, jnp.asarray(np.concatenate(stds) ** 2), None, h.difference, numbers=12)


class Pose(_AbstractOnLink):
    kind, unit, make = "pose", "m", staticmethod(pose_sensor)
    checks = Checks(vector=True)

    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        rotation, place = self.pose(now.q)
        return jnp.concatenate([place, rotation.reshape(-1)])

    def difference(self, expected: Float[Array, "12"], reading: Float[Array, "12"]) -> Float[Array, "6"]:
        """Difference of the positions in the world, then the rotation vector from one attitude to the other."""
        turned = SO3.local(expected[3:].reshape(3, 3), reading[3:].reshape(3, 3))
        return jnp.concatenate([reading[:3] - expected[:3], turned])

    def perturbed(self, reading: Float[Array, "12"], noise: Float[Array, "6"]) -> Float[Array, "12"]:
        turned = reading[3:].reshape(3, 3) @ SO3.exp(noise[3:])
        return jnp.concatenate([reading[:3] + noise[:3], turned.reshape(-1)])


def point_sensor(
    space: AbstractSpace,
    link: str,
    std: Numbers,
    *,
    place: Numbers = (0.0, 0.0, 0.0),
    name: str = "point",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Position in the world of a point on a link of a robot, as from a marker or a tracker.

    A reading is three numbers in metres, in the axes of the world. It does not show a rotation of the link about the
    point; if the attitude is measured too, use `pose_sensor`.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        std: Standard deviation of a reading, one number or (3,) [m].
        place: The point in the frame of the link [m]; its origin by default.
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (3,), which is estimated [m]; None
            (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (3,); 0 by default.

    Returns:
        The sensor, of three numbers.

    Raises:
        ValueError: There is no such link, or a number is out of its range.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> observers.point_sensor(arm.space, "lower", 1e-3, place=[0.0, 0.0, -1.0]).count
        3
    """
    h = Point(*_on_link("point_sensor", space, link, None, place))
    return _sensor("point_sensor", name, h, _stds("point_sensor", "std", std, 3), (bias_std, bias_drift))


class Point(_AbstractOnLink, _AbstractNumbers):
    kind, unit, make = "point", "m", staticmethod(point_sensor)
    checks = Checks(vector=True)

    def value(self, now: Instant) -> Vector:
        return self.pose(now.q)[1]


SENSOR_KINDS = {each.kind: each for each in (Encoder, Tachometer, Gyro, Accelerometer, Pose, Point)}
"""The kinds of sensors of a model file, by their names in its tables."""


def _resolve_names(table: Mapping[str, Any], *lists: Sequence[str]) -> tuple[list[int], dict[str, Any]]:
    """Indices of the names in `of`, each in the first list that has it, and the other settings of the table."""
    places = []
    for each in table["of"]:
        holding = [names for names in lists if each in names]
        if not holding:
            known = dict.fromkeys(known for names in lists for known in names)
            raise InputError(f"of: there is no {each!r}; there are: {', '.join(known)}")
        places.append(holding[0].index(each))
    return places, {key: value for key, value in table.items() if key != "of"}


def _components(
    kind: type[_AbstractComponents],
    places: Sequence[int],
    std: Numbers,
    reduction: Numbers,
    name: str,
    bias: tuple[Numbers | None, Numbers],
    period: Numbers,
) -> Sensor:
    """Sensor of some entries of the configuration or of the velocity."""
    whose, indices = kind.kind, [int(place) for place in places]
    k = len(indices)
    if not k or len(set(indices)) < k or min(indices) < 0:
        raise InputError(f"{whose}: places must be different indices, 0 or more; got {list(places)}")
    factors, periods = (as_numbers(whose, *each, k) for each in (("reduction", reduction), ("period", period)))
    if not factors.all() or (periods < 0).any():
        raise InputError(f"{whose}: reduction must not be zero, nor period negative; got {reduction} and {period}")
    h = kind(tuple(indices), jnp.asarray(factors))
    turns = tuple(periods.tolist()) if periods.any() else None
    return _sensor(whose, name, h, _stds(whose, "std", std, k), bias, turns)


def _sensor(
    whose: str,
    name: str,
    h: Any,
    stds: np.ndarray,
    bias: tuple[Numbers | None, Numbers],
    period: tuple[float, ...] | None = None,
) -> Sensor:
    """Sensor with independent noise and, if its bias has a standard deviation, slow states of this bias."""
    std, drift = bias
    slow = None
    if std is not None:
        k = len(stds)
        first, walk = (as_numbers(whose, *each, k, 0.0) for each in (("bias_std", std), ("bias_drift", drift)))
        check_positive(whose, bias_std=float(first.min()))
        names = tuple(f"{name}_bias{i + 1}" for i in range(k)) if k > 1 else (f"{name}_bias",)
        slow = SlowVariables(names, jnp.zeros(k), jnp.diag(jnp.asarray(first**2)), jnp.diag(jnp.asarray(walk**2)))
    return Sensor(name, h, jnp.asarray(stds**2), slow, period=period)


def _on_link(
    whose: str, space: AbstractSpace, link: str, axes: Numbers | None, place: Numbers
) -> tuple[RobotSpace, str, Array, Array]:
    """The arguments of a sensor on a link, checked."""
    tree = robot_space(space)
    if tree is None:
        raise InputError(f"{whose}: {type(space).__name__} has no links; give the space of a robot")
    try:
        tree.links.of(link)
    except InputError as error:
        raise InputError(f"{whose}: {error}") from error
    try:
        rotation = np.eye(3) if axes is None else np.asarray(axes, float)
    except (TypeError, ValueError):
        rotation = np.zeros(0)
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6):
        raise InputError(f"{whose}: axes must be a rotation matrix (3, 3); got {axes}")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{whose}: axes must be right-handed, of determinant 1; one axis of {axes} is reversed")
    return tree, link, jnp.asarray(rotation), jnp.asarray(as_numbers(whose, "place", place, 3))


def _stds(whose: str, what: str, value: Numbers, count: int) -> np.ndarray:
    stds = as_numbers(whose, what, value, count, 0.0)
    if not (stds > 0).all():
        raise InputError(f"{whose}: {what} must be positive; got {value}")
    return stds
