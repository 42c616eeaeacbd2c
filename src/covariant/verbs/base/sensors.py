"""The sensors of a model file, their readings in a log, and what they read of a simulated motion."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant import logs
from covariant.models import MechanicalSystem, ModelFile, Motion, acceleration, input_count
from covariant.observers import AbstractObserver, Instant, Sensor
from covariant.observers.sensors import SENSOR_KINDS
from covariant.verbs.base.arguments import Amounts
from scalargraph.errors import InputError

LOGGED = ("kind", "columns", "units", "delay", "attitude")
"""Keys of a table that say how readings are logged; the others are settings of the sensor."""


class FileSensor(NamedTuple):
    """A sensor of a model file.

    Attributes:
        sensor: The sensor.
        columns: Its columns in a log.
        delay: Time [s] from when a reading is true to its stamp.
        unit: SI unit of its readings, of a pose of its position; "" where it is not known.
    """

    sensor: Sensor
    columns: logs.Columns
    delay: float
    unit: str

    def to_columns(self, readings: Float[np.ndarray, "T k"]) -> dict[str, np.ndarray]:
        """Columns of readings (T, k), in SI units and radians."""
        if self.columns.q:
            return dict(zip(self.columns.q, readings.T, strict=True))
        poses = np.tile(np.eye(4), (len(readings), 1, 1))
        poses[:, :3, 3], poses[:, :3, :3] = readings[:, :3], readings[:, 3:].reshape(-1, 3, 3)
        return logs.to_columns(self.columns, poses)

    @property
    def signals(self) -> tuple[str, ...]:
        """Name and SI unit of each number of a reading; an attitude is read as a matrix, whatever the log has."""
        named = self.columns.q + self.columns.position
        rotation = self.columns.matrix or tuple(f"{self.sensor.name} R{i}{j}" for i in "123" for j in "123")
        names = tuple(f"{name} [{self.unit}]" if self.unit else name for name in named)
        return names + (rotation if self.columns.position else ())

    @property
    def units(self) -> dict[str, str | None]:
        """Units of the columns in a log, None where they are in SI units."""
        return {name: self.columns.unit_of("q", i) for i, name in enumerate(self.columns.q)}

    @property
    def si_units(self) -> dict[str, str]:
        """SI units of the columns, as far as they are known; an attitude has none."""
        return {name: self.unit for name in self.columns.q + self.columns.position if self.unit}


def file_sensors(file: ModelFile) -> tuple[FileSensor, ...]:
    """The sensors of a model file."""
    if not file.sensors:
        return ()
    file.need_mechanical(file.name, "sensors are those of")
    found = []
    for name, content in file.sensors.items():
        try:
            found.append(_sensor(name, file, content))
        except (InputError, TypeError) as error:
            raise InputError(f"{file.name}: [sensors.{name}]: {error}") from error
    names = [column for each in found for column in each.columns.measured]
    taken = {file.columns.t, *file.columns.measured, *file.columns.u}
    twice = next((column for column in names if names.count(column) > 1 or column in taken), None)
    if twice is not None:
        raise InputError(f"{file.name}: [sensors]: column {twice!r} is named twice; give each sensor its own columns")
    return tuple(found)


def _sensor(name: str, file: ModelFile, content: Mapping[str, Any]) -> FileSensor:
    settings = {"bias_std" if key == "bias" else key: content[key] for key in content if key not in LOGGED}
    sensor, unit = SENSOR_KINDS[content["kind"]].from_table(name, file, settings)
    names, units, attitude = tuple(content["columns"]), content.get("units", ()), content.get("attitude")
    texts = (units,) if isinstance(units, str) else tuple(units)
    columns, needed = logs.Columns(t=file.columns.t, q=names, units={"q": texts} if texts else {}), sensor.count
    if attitude is not None:
        if texts:
            raise InputError("a pose has no units: its position is in m")
        columns = columns._replace(q=(), position=names[:3], **{attitude: names[3:]})
        needed = 3 + logs.ATTITUDES[attitude]
    if len(names) != needed or len(set(names)) < needed:
        raise InputError(f"columns must be {needed} different names; got {', '.join(names)}")
    if len(texts) not in (0, 1, needed):
        raise InputError(f"units lists {len(texts)} units; give {needed}, or one without brackets")
    for text in texts:
        logs.check_unit(text, unit)
    return FileSensor(sensor, columns, float(content.get("delay", 0.0)), unit)


def readings(parts: Sequence[FileSensor], log: logs.Log) -> tuple[Float[np.ndarray, "T K"] | None, str]:
    """Readings of all sensors in the rows of a log."""
    absent = [part.sensor.name for part, each in zip(parts, log.readings, strict=True) if each is None]
    note = f" The log has no column of {' or '.join(absent)}: the filter does without." if absent else ""
    if len(absent) == len(parts):
        return None, note
    filled = [
        np.full((len(log.record.t), part.sensor.count), np.nan) if each is None else each
        for part, each in zip(parts, log.readings, strict=True)
    ]
    return np.concatenate(filled, axis=1), note


def reading_delays(observer: AbstractObserver, delay: Amounts, parts: Sequence[FileSensor], y: np.ndarray) -> Any:
    """Delay [s] of a measurement of an observer: one for all, or with sensors one for each of its entries."""
    if not observer.sensors:
        return delay
    late = [np.full(part.sensor.count, part.delay) for part in parts]
    size = len(y) - sum(map(len, late))
    return np.concatenate([np.broadcast_to(delay, size), *late]).tolist()


class SensorCount(NamedTuple):
    """How a sensor did in a run.

    Attributes:
        readings: Number of rows with a reading, without the first row, which starts the estimate.
        refused: Number of those of which a number was refused.
        nis: Mean of the squared innovations over their predicted variances; 1 is expected. NaN where none was used.
    """

    readings: int
    refused: int
    nis: float


def sensor_counts(parts: Sequence[FileSensor], readings: np.ndarray, info: Any) -> dict[str, SensorCount]:
    """Count what a run used of the readings of each sensor."""
    innovation, std, used = (np.asarray(field)[1:] for field in info)
    found, at, i = {}, 0, 0
    for part in parts:
        k, n = part.sensor.count, len(part.sensor.cov)
        there = np.isfinite(readings[1:, at : at + k])
        off, size, taken = (each[:, i : i + n] for each in (innovation, std, used))
        # What was true before the start, of a sensor that is late, was compared with nothing.
        refused = there.all(axis=1) & ((off != 0) & ~taken).any(axis=1)
        nis = float(np.mean((off[taken] / size[taken]) ** 2)) if taken.any() else float("nan")
        found[part.sensor.name] = SensorCount(int(there.any(axis=1).sum()), int(refused.sum()), nis)
        at, i = at + k, i + n
    return found


def sensed(
    model: MechanicalSystem,
    part: FileSensor,
    x: Any,
    u: Float[np.ndarray, "T m"],
    t: Float[np.ndarray, "T"],
    seed: Sequence[int],
) -> Float[np.ndarray, "T k"]:
    """What a sensor reads of a motion, with noise and a constant bias that are drawn as the model file says."""
    sensor, rng, motion = part.sensor, np.random.default_rng(seed), model.motion(x)
    kind: Any = sensor.h
    first = np.zeros((0, 0)) if sensor.slow is None else np.asarray(sensor.slow.first_cov)
    bias = jnp.asarray(rng.normal(size=len(first)) * np.sqrt(np.diag(first)))

    def output(q, v, u, t):
        return kind(Instant(q, v, lambda: acceleration(model, t, q, v, u), u, t), bias)

    exact = np.asarray(jax.jit(jax.vmap(output))(*map(jnp.asarray, (motion.q, motion.v, u, t))))
    noise = rng.normal(size=(len(t), len(sensor.cov))) @ np.linalg.cholesky(np.asarray(sensor.cov)).T
    return np.asarray(jax.vmap(kind.perturbed)(jnp.asarray(exact), jnp.asarray(noise)))


def with_readings(file: ModelFile, parts: Sequence[FileSensor], y: np.ndarray) -> np.ndarray:
    """Measurements of a filter with sensors, from configurations at rest and what the sensors read there."""
    model = file.need_mechanical(file.name, "sensors are those of")
    x = model.state(Motion(jnp.asarray(y), jnp.zeros((len(y), file.dimension))))
    u, t = np.zeros((len(y), input_count(model, file.dimension))), np.zeros(len(y))
    read = [sensed(model, part, x, u, t, (0, i)) for i, part in enumerate(parts)]
    return np.concatenate([y.reshape(len(y), -1), *read], axis=1)
