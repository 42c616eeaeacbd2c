"""Sensors of the usual kinds: encoders, tachometers, gyros, accelerometers, poses and positions of points on links."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Numbers, Vector
from covariant.geometry import AbstractSpace
from covariant.geometry.lie import SO3
from covariant.models.robots import RobotSpace
from covariant.observers.base import as_numbers, check_positive
from covariant.observers.sensors._sensors import Instant, Sensor
from covariant.observers.sensors._slow import Slow, SlowVector

STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
"""Gravity in the frame of the world [m/s²] of an accelerometer, by default."""


class _Components(eqx.Module):
    """Some entries of the configuration or of the velocity, times a reduction each, plus the bias."""

    field: str = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    reduction: Float[Array, "k"]

    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        value = getattr(now, self.field)[jnp.array(self.places)]
        return _biased(self.reduction.astype(value.dtype) * value, s)


class _OnLink(eqx.Module):
    """Where a sensor is on a link: the frame of the link, the axes of the sensor in it, and its place there."""

    space: RobotSpace
    link: str = eqx.field(static=True)
    axes: Float[Array, "3 3"]
    place: Float[Array, "3"]

    def pose(self, q: Array) -> tuple[Array, Array]:
        """Rotation (3, 3) and position (3,) of the sensor in the world."""
        pose = self.space.pose(q, self.link)
        rotation = pose[:3, :3]
        return rotation @ self.axes.astype(q.dtype), rotation @ self.place.astype(q.dtype) + pose[:3, 3]

    def twist(self, q: Array, v: Vector) -> tuple[Array, Array]:
        """Velocity (3,) of the place of the sensor, and angular velocity (3,), both in its axes."""
        speed, spin = jnp.split(self.space.jacobian(q, self.link) @ v, 2)
        axes = self.axes.astype(q.dtype)
        # x @ A is Aᵀ x: from the axes of the link to those of the sensor.
        return (speed + jnp.cross(spin, self.place.astype(q.dtype))) @ axes, spin @ axes


class _Gyro(_OnLink):
    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        return _biased(self.twist(now.q, now.v)[1], s)


class _Accelerometer(_OnLink):
    gravity: Float[Array, "3"]

    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        rates = self.space.manifold.tangent(now.q, now.v), now.acceleration()
        (speed, spin), (change, _) = jax.jvp(self.twist, (now.q, now.v), rates)
        # The velocity in axes that turn changes by ω × v less than in the world.
        felt = change + jnp.cross(spin, speed) - self.gravity.astype(speed.dtype) @ self.pose(now.q)[0]
        return _biased(felt, s)


class _Pose(_OnLink):
    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        rotation, place = self.pose(now.q)
        return jnp.concatenate([place, rotation.reshape(-1)])

    def difference(self, expected: Float[Array, "12"], reading: Float[Array, "12"]) -> Float[Array, "6"]:
        """Difference of the positions in the world, then the rotation vector from one attitude to the other."""
        turned = SO3.local(expected[3:].reshape(3, 3), reading[3:].reshape(3, 3))
        return jnp.concatenate([reading[:3] - expected[:3], turned])


class _Point(_OnLink):
    def __call__(self, now: Instant, s: SlowVector) -> Vector:
        return _biased(self.pose(now.q)[1], s)


def _biased(value: Vector, s: SlowVector) -> Vector:
    return value + s if s.shape[0] else value


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

    Args:
        places: Indices (k,) of the coordinates.
        std: Standard deviation of a reading, one number or (k,) [rad or m, of the motor where there is a reduction].
        reduction: Turns of the motor for one of the joint, one number or (k,); 1 (default) at the joint.
        period: Period of the readings, one number or (k,), as 2π where they are angles within a turn; 0 (default) for
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
    return _components("encoder", "q", places, std, reduction, name, (bias_std, bias_drift), period)


def tachometer(
    places: Sequence[int],
    std: Numbers,
    *,
    reduction: Numbers = 1.0,
    name: str = "tachometer",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Some components of the velocity: joint rates, and on a group the body's rates, as of a gyro on an aircraft.

    Args:
        places: Indices (k,) of the components, in the frame of the configuration space.
        std: Standard deviation of a reading, one number or (k,) [rad/s or m/s].
        reduction: Factor of the readings, one number or (k,), as the reduction of a gear; 1 by default.
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
    return _components("tachometer", "v", places, std, reduction, name, (bias_std, bias_drift), 0.0)


def gyro(
    space: AbstractSpace,
    link: str,
    std: Numbers,
    *,
    axes: Any = None,
    name: str = "gyro",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Angular velocity of a link of a robot, in the axes of the sensor.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        std: Standard deviation of a reading, one number or (3,) [rad/s].
        axes: Rotation (3, 3) from the axes of the sensor to those of the link; None (default) where they are the same.
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (3,), which is estimated [rad/s];
            None (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (3,); 0 by default.

    Returns:
        The sensor, of three numbers.

    Raises:
        ValueError: There is no such link, the axes are no rotation, or a number is out of its range.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> observers.gyro(arm.space, "lower", 0.01).count
        3
    """
    h = _Gyro(*_on_link("gyro", space, link, axes, (0.0, 0.0, 0.0)))
    return _sensor("gyro", name, h, _stds("gyro", "std", std, 3), (bias_std, bias_drift))


def accelerometer(
    space: AbstractSpace,
    link: str,
    std: Numbers,
    *,
    axes: Any = None,
    place: Numbers = (0.0, 0.0, 0.0),
    gravity: Numbers = STANDARD_GRAVITY,
    name: str = "accelerometer",
    bias_std: Numbers | None = None,
    bias_drift: Numbers = 0.0,
) -> Sensor:
    """Acceleration of a point on a link less gravity, in the axes of the sensor: what an accelerometer feels.

    The acceleration is that of the model with its estimated forces. White acceleration noise, `process_cov`, is not
    part of it: describe unknown forces by `external_force`, and give a `std` that covers what is left.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        std: Standard deviation of a reading, one number or (3,) [m/s²].
        axes: Rotation (3, 3) from the axes of the sensor to those of the link; None (default) where they are the same.
        place: Place of the sensor in the frame of the link [m]; its origin by default.
        gravity: Gravity in the frame of the world [m/s²].
        name: Name of the sensor.
        bias_std: Standard deviation of a constant offset at the start, one number or (3,), which is estimated [m/s²];
            None (default) for none.
        bias_drift: Standard deviation of its change in a second, one number or (3,); 0 by default.

    Returns:
        The sensor, of three numbers.

    Raises:
        ValueError: There is no such link, the axes are no rotation, or a number is out of its range.

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
    h = _Accelerometer(*where, jnp.asarray(as_numbers("accelerometer", "gravity", gravity, 3)))
    return _sensor("accelerometer", name, h, _stds("accelerometer", "std", std, 3), (bias_std, bias_drift))


def pose_sensor(
    space: AbstractSpace,
    link: str,
    position_std: Numbers,
    rotation_std: Numbers,
    *,
    axes: Any = None,
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
        axes: Rotation (3, 3) from the axes of the markers to those of the link; None (default) where they are the same.
        place: Their place in the frame of the link [m]; its origin by default.
        name: Name of the sensor.

    Returns:
        The sensor. A reading with a number missing is missing as a whole.

    Raises:
        ValueError: There is no such link, the axes are no rotation, or a number is out of its range.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> camera = observers.pose_sensor(arm.space, "lower", 1e-3, 1e-2, name="camera")
        >>> camera.count, len(camera.cov)
        (12, 6)
    """
    h = _Pose(*_on_link("pose_sensor", space, link, axes, place))
    stds = [_stds("pose_sensor", *each, 3) for each in (("position_std", position_std), ("rotation_std", rotation_std))]
    return Sensor(name, h, jnp.asarray(np.concatenate(stds) ** 2), None, h.difference, numbers=12)


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
    h = _Point(*_on_link("point_sensor", space, link, None, place))
    return _sensor("point_sensor", name, h, _stds("point_sensor", "std", std, 3), (bias_std, bias_drift))


def _components(
    whose: str,
    field: str,
    places: Sequence[int],
    std: Numbers,
    reduction: Numbers,
    name: str,
    bias: tuple[Numbers | None, Numbers],
    period: Numbers,
) -> Sensor:
    """Sensor of some entries of a field of `Instant`."""
    indices = [int(place) for place in places]
    k = len(indices)
    if not k or len(set(indices)) < k or min(indices) < 0:
        raise ValueError(f"{whose}: places must be different indices, 0 or more; got {list(places)}")
    factors, periods = (as_numbers(whose, *each, k) for each in (("reduction", reduction), ("period", period)))
    if not factors.all() or (periods < 0).any():
        raise ValueError(f"{whose}: reduction must not be zero, nor period negative; got {reduction} and {period}")
    h = _Components(field, tuple(indices), jnp.asarray(factors))
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
    """Sensor with independent noise, and the slow states of its bias where that has a standard deviation."""
    std, drift = bias
    slow = None
    if std is not None:
        k = len(stds)
        first, walk = (as_numbers(whose, *each, k, 0.0) for each in (("bias_std", std), ("bias_drift", drift)))
        check_positive(whose, bias_std=float(first.min()))
        names = tuple(f"{name}_bias{i + 1}" for i in range(k)) if k > 1 else (f"{name}_bias",)
        slow = Slow(names, jnp.zeros(k), jnp.diag(jnp.asarray(first**2)), jnp.diag(jnp.asarray(walk**2)))
    return Sensor(name, h, jnp.asarray(stds**2), slow, period=period)


def _on_link(
    whose: str, space: AbstractSpace, link: str, axes: Any, place: Numbers
) -> tuple[RobotSpace, str, Array, Array]:
    """The arguments of a sensor on a link, checked."""
    if not isinstance(space, RobotSpace):
        raise ValueError(f"{whose}: {type(space).__name__} has no links; give the space of a robot")
    try:
        space.links.of(link)
    except ValueError as error:
        raise ValueError(f"{whose}: {error}") from error
    try:
        rotation = np.eye(3) if axes is None else np.asarray(axes, float)
    except (TypeError, ValueError):
        rotation = np.zeros(0)
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6):
        raise ValueError(f"{whose}: axes must be a rotation matrix (3, 3); got {axes}")
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"{whose}: axes must be right-handed, of determinant 1; one axis of {axes} is reversed")
    return space, link, jnp.asarray(rotation), jnp.asarray(as_numbers(whose, "place", place, 3))


def _stds(whose: str, what: str, value: Numbers, count: int) -> np.ndarray:
    stds = as_numbers(whose, what, value, count, 0.0)
    if not (stds > 0).all():
        raise ValueError(f"{whose}: {what} must be positive; got {value}")
    return stds
