"""Defines further sensors besides the measured configuration: functions of the motion, with their noise, gate and rate.

A filter with sensors is corrected by the whole content of a row: the configuration, and the readings of its sensors. A
number that was not read in a row is NaN, so that sensors with different rates share one log, whose rows are the stamps
of all of them. A measurement y is one vector: the entries of the configuration, on a group row by row, followed by the
readings of each sensor, in the filter's order; `Sensors.joined` creates it.

With the output h(q, v, u, s), the derivative with respect to the filter's error is `H = [h_q  h_v  h_s] · (A ⊕ I)`,
where A converts the error (ε, ν) in the parallel frame to differences in the frame, and h_q is the derivative along
the frame.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact

from covariant._functional import Functional
from covariant._typing import Numbers, Scalar, Vector
from covariant.geometry import Coordinates
from covariant.models import MechanicalSystem, acceleration
from covariant.observers.base import Gate, GateMemory, Sample, Velocity, check_covariance, diagonal, judged, updated
from covariant.observers.sensors._slow import SlowVariables, SlowVector
from covariant.signals import AnyArray
from scalargraph.errors import InputError

Readings = Float[Array, "K"]
"""Readings of all sensors, one after the other; NaN for missing ones."""


class Instant(NamedTuple):
    """The motion at one instant, the first argument of a sensor's output function.

    The second argument of the function of a `Sensor` is the sensor's slow states. Write that function in JAX, since
    filters differentiate it. Call `acceleration` only if the sensor depends on it, because each call evaluates the
    dynamics.

    Attributes:
        q: Configuration: coordinates (n,), or on a group a matrix (N, N).
        v: Velocity (n,), in the frame of the configuration space [rad/s or m/s].
        acceleration: Function without arguments that computes the rate of change (n,) of v, by the equations of motion
            with the estimated forces [rad/s² or m/s²].
        u: Input (m,) that acted before it.
        t: Time [s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import observers
        >>> strain = observers.Sensor("strain", lambda now, s: 2.0 * now.q[:1], 1e-6)
        >>> zero = jnp.zeros(1)
        >>> strain.h(observers.Instant(jnp.array([0.1]), zero, lambda: zero, zero, 0.0), zero[:0]).tolist()
        [0.2]
    """

    q: Inexact[Array, "..."]
    v: Vector
    acceleration: Callable[[], Vector]
    u: Float[Array, "m"]
    t: Scalar


def _as_matrix(cov: Numbers) -> Float[Array, "k k"]:
    """A covariance, from a variance, variances (k,), or a matrix (k, k)."""
    cov = jnp.atleast_1d(jnp.asarray(cov, float))
    return jnp.diag(cov) if cov.ndim == 1 else cov


class Sensor(Functional):
    """A sensor whose readings are a function of the motion, with white noise.

    The ready ones are `encoder`, `tachometer`, `gyro`, `accelerometer`, `pose_sensor` and `point_sensor`.

    Use it for a sensor that the ready ones do not cover, such as a strain gauge or a laser range finder: write its
    output as a function in JAX. Pass it as `sensors` of `IntrinsicKalman`; its readings follow the configuration in a
    measurement, NaN where there is none. Give its bias as `slow`.

    Attributes:
        name: Name of the sensor.
        h: Output `(now, s) -> (j,)`, the reading expected at an `Instant` with the sensor's own slow states s (k,).
        cov: Covariance (i, i) of the noise of the innovation: a matrix, variances, or one variance.
        slow: Slow states of this sensor, such as its bias; None (default) if it has none, and s is empty.
        difference: `(expected, reading) -> (i,)`, the innovation, if it is not `reading − expected`; None (default)
            otherwise.
        period: Period of the readings (i,), such as 2π for angles: differences are taken modulo the period; zero for a
            number without one. None (default) for no period at all.
        numbers: Number j of entries in a reading, if a `difference` changes their number; None (default) for i. If one
            of them is missing, the whole reading is.
        gate: Gate that refuses numbers as outliers; None refuses nothing. See `Gate`; a sensor causes no restart, so
            readings that were refused for `patience` samples are used.

    Raises:
        ValueError: The covariance is invalid or singular, a period does not fit it, or the name is empty.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> speed = observers.Sensor("speed", lambda now, s: now.v, 1e-4)
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1e-3, 1e-2, 1.0, sensors=speed, substeps=1)
        >>> y = np.array([[1.0, np.nan], [np.nan, -0.1]])  # the position once, then its rate of change
        >>> run = observers.run(kalman, Record(np.array([0.0, 0.1]), np.zeros((2, 1)), y))
        >>> run.estimate[1].round(2).tolist(), run.info.sensors.used[1].tolist()
        ([0.99, -0.1], [True])
    """

    name: str = eqx.field(static=True)
    h: Callable[[Instant, SlowVector], Vector]
    cov: Float[Array, "i i"] = eqx.field(converter=_as_matrix)
    slow: SlowVariables | None = None
    difference: Callable[[Vector, Vector], Vector] | None = None
    period: tuple[float, ...] | None = eqx.field(default=None, static=True)
    numbers: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        if not self.name:
            raise InputError("Sensor: name must not be empty")
        check_covariance(f"Sensor {self.name}", "cov", self.cov, positive=True)
        if self.period is not None and len(self.period) != len(self.cov):
            raise InputError(
                f"Sensor {self.name}: period has {len(self.period)} entries, and the innovation {len(self.cov)}"
            )

    @property
    def count(self) -> int:
        """Numbers in a reading."""
        return len(self.cov) if self.numbers is None else self.numbers

    def innovation(self, expected: Float[Array, "j"], reading: Float[Array, "j"]) -> Float[Array, "i"]:
        """Difference from an expected reading to a reading.

        Args:
            expected: Expected reading (j,).
            reading: Reading (j,), without NaN.

        Returns:
            Innovation (i,).
        """
        apart = reading - expected if self.difference is None else self.difference(expected, reading)
        if self.period is None:
            return apart
        period = jnp.asarray(self.period, apart.dtype)
        turn = jnp.where(period > 0, period, 1.0)
        return apart - jnp.where(period > 0, period * jnp.round(apart / turn), 0.0)

    def present(self, reading: Float[Array, "j"]) -> Bool[Array, "i"]:
        """Which numbers of the innovation (i,) a reading (j,) determines; NaN is missing."""
        return self.marked(~jnp.isnan(reading))

    def marked(self, flags: Bool[Array, "j"]) -> Bool[Array, "i"]:
        """Flags (i,) of the innovation, from those (j,) of a reading; with a `difference`, all or none are set."""
        return flags if self.numbers is None else jnp.broadcast_to(jnp.all(flags), len(self.cov))


class SensorInfo(NamedTuple):
    """Diagnostics of all sensors in a step, one sensor after the other.

    Attributes:
        innovation: Innovations (I,) before the correction, 0 where nothing was read.
        std: Their predicted standard deviations (I,).
        used: Which of them (I,) corrected the estimate: those that were read and not refused.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.sensors import SensorInfo
        >>> SensorInfo(jnp.array([0.2]), jnp.array([0.1]), jnp.array([True]))._fields
        ('innovation', 'std', 'used')
    """

    innovation: Float[Array, "I"]
    std: Float[Array, "I"]
    used: Bool[Array, "I"]


class Sensed(NamedTuple):
    """The readings of all sensors together with their prediction, before a correction.

    Attributes:
        slope: Derivative (I, N) of the readings with respect to the error of the filter.
        cov: Covariance (I, I) of their noise; sensors do not share any.
        info: Innovations, and which are to be used.
        refused: Whether the gate of a sensor refused a number.
        read: Whether any number was read.
        gates: Memories of the gates after their verdicts.
    """

    slope: Float[Array, "I N"]
    cov: Float[Array, "I I"]
    info: SensorInfo
    refused: Bool[Array, ""]
    read: Bool[Array, ""]
    gates: tuple[GateMemory, ...]

    def posterior(self, error: Float[Array, "N"], root: Float[Array, "N N"]) -> tuple[Array, Array]:
        """Mean error and square root of its covariance, after the readings."""
        gain, root = updated(root, self.slope @ root, self.cov, self.info.used)
        left = jnp.where(self.info.used, self.info.innovation - self.slope @ error, 0.0)
        return error + gain @ left, root


class Sensors(NamedTuple):
    """All sensors of a filter, one after the other.

    Attributes:
        each: The sensors.
    """

    each: tuple[Sensor, ...]

    def check(self, whose: str) -> None:
        """Check that there are sensors, each with its own name."""
        for sensor in self.each:
            if not isinstance(sensor, Sensor):
                raise InputError(f"{whose}: sensors must be one Sensor or several, such as gyro(...); got {sensor!r}")
        names = [sensor.name for sensor in self.each]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"{whose}: two sensors are called {twice!r}; give each its own name")

    @property
    def size(self) -> int:
        """Numbers K in a row of readings."""
        return sum(sensor.count for sensor in self.each)

    @property
    def slow(self) -> tuple[SlowVariables, ...]:
        """The slow states of all sensors, a group for each sensor that has some."""
        return tuple(sensor.slow for sensor in self.each if sensor.slow is not None)

    def split(self, y: Any, shape: tuple[int | None, ...]) -> tuple[Any, Any]:
        """Measured configuration and readings of a measurement y."""
        if not self.each:
            return y, y.reshape(-1)[:0]
        size = (y.shape[0] if y.ndim == 1 else 0) - self.size
        needed = size if None in shape else math.prod(n or 0 for n in shape)
        if y.ndim != 1 or size < 1 or size != needed:
            raise InputError(
                f"a measurement must be one vector, the configuration ({'n' if None in shape else needed} numbers) and "
                f"then the {self.size} readings of {', '.join(sensor.name for sensor in self.each)}; got {y.shape}"
            )
        configuration = y[:size]
        return (configuration if None in shape else configuration.reshape(shape)), y[size:]

    def joined(self, configuration: AnyArray, readings: AnyArray) -> Any:
        """Measurements y of configurations and readings: the inverse of `split`, for one row or for all."""
        if not self.each:
            return configuration
        rows = readings.shape[:-1]
        xnp = jnp if isinstance(configuration, jax.Array) or isinstance(readings, jax.Array) else np
        return xnp.concatenate([configuration.reshape(*rows, -1), readings], axis=-1)

    def of(self, flags: Bool[Array, "K"]) -> Bool[Array, "I"]:
        """Flags (I,) of innovations whose readings (K,) are flagged."""
        parts = jnp.split(flags, np.cumsum([sensor.count for sensor in self.each])[:-1].tolist())
        return jnp.concatenate([sensor.marked(part) for sensor, part in zip(self.each, parts, strict=True)])

    def at_start(self, like: Vector) -> tuple[GateMemory, ...]:
        """Memories of the gates of all sensors before any reading, in the precision of `like`."""
        return tuple(GateMemory.at_start(jnp.zeros(len(sensor.cov), like.dtype)) for sensor in self.each)

    def sensed(
        self,
        model: MechanicalSystem,
        state: Any,
        u: Float[Array, "m"],
        frame: Float[Array, "N N"],
        readings: Readings,
        with_slow: Callable[[SlowVector], MechanicalSystem],
    ) -> Sensed:
        """Compare readings with their prediction by the estimate."""
        n, first = state.v.shape[0], state.slow.shape[0] - sum(len(group.names) for group in self.slow)
        parts = jnp.split(readings, np.cumsum([sensor.count for sensor in self.each])[:-1].tolist())

        def outputs(change):
            q, v = model.manifold.nudged(state.q, change[:n]), state.v + change[n : 2 * n]
            s = state.slow + change[2 * n :]
            moved = Instant(q, v, lambda: acceleration(with_slow(s), state.t, q, v, u), u, state.t)
            values, at = [], first
            for sensor in self.each:
                k = 0 if sensor.slow is None else len(sensor.slow.names)
                values.append(sensor.h(moved, s[at : at + k]))
                at += k
            return values

        zero = jnp.zeros(frame.shape[0], state.v.dtype)
        expected = outputs(zero)

        def apart(change):
            pairs = zip(self.each, expected, outputs(change), strict=True)
            return jnp.concatenate([sensor.innovation(jax.lax.stop_gradient(was), is_) for sensor, was, is_ in pairs])

        slope = jax.jacfwd(apart)(zero) @ frame
        cov = functools.reduce(diagonal, [sensor.cov.astype(state.v.dtype) for sensor in self.each])
        spread = slope @ state.root
        total = spread @ spread.T + cov
        innovations, used, far, present, memories, at = [], [], [], [], [], 0
        for sensor, value, reading, memory in zip(self.each, expected, parts, state.sensor_gates, strict=True):
            there = sensor.present(reading)
            filled: Any = jnp.where(jnp.isnan(reading), value, reading)
            innovation: Any = jnp.where(there, sensor.innovation(value, filled), 0.0)
            block = slice(at, at := at + len(innovation))
            sample = Sample(innovation, total[block, block], cov[block, block], there)
            nothing = Velocity(jnp.zeros_like(innovation), jnp.zeros((0, 0)))
            verdict = judged(sensor.gate, Coordinates(), sample, memory, nothing, None)
            # Readings that were refused for a long time are used: then the fault is not in the sensor.
            accepted = there & (~verdict.far | (memory.refused >= _patience(sensor)))
            innovations.append(innovation)
            used.append(accepted)
            far.append(verdict.far & ~accepted)
            present.append(there)
            memories.append(verdict.memory.used(accepted, jnp.zeros_like(innovation)))
        info = SensorInfo(jnp.concatenate(innovations), jnp.sqrt(jnp.diag(total)), jnp.concatenate(used))
        refused, read = jnp.any(jnp.concatenate(far)), jnp.any(jnp.concatenate(present))
        return Sensed(slope, cov, info, refused, read, tuple(memories))


def _patience(sensor: Sensor) -> int:
    return 0 if sensor.gate is None else sensor.gate.patience
