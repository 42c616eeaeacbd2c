"""`covariant simulate`: a simulated log that contains the truth."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant import logs, models, simulation
from covariant._numbers import number
from covariant.cli._console import working
from covariant.models import Motion
from covariant.signals import Record
from covariant.workflow._inputs import check_output, sought_columns

DIGITS = 12
"""Decimals of a time [s] in a log: times that agree in all of them are one, whatever they were computed from."""


class Scenario(NamedTuple):
    """The options of the command, as the user gave them."""

    duration: float
    rate: float
    q0: str | None
    v0: str | None
    amplitude: str | None
    frequency: float
    noise: float
    quantum: float
    jitter: float
    dropout: float
    seed: int


def simulate(model: str, overrides: tuple[str, ...], out: Path, scenario: Scenario, as_json: bool) -> None:
    """Simulate and measure; write t, measured configurations or outputs, the inputs, and the true state as true_…."""
    check_output(out, *logs.WRITTEN)
    file = models.load(model, overrides)
    names, m = _columns(file), len(file.columns.u)
    x0 = _start(file, scenario)
    amplitude = _numbers("--amplitude", scenario.amplitude, m)
    sensor = simulation.Sensor(scenario.rate, scenario.noise, scenario.quantum, scenario.jitter, scenario.dropout)
    if sensor.quantum and not file.model.manifold.commuting:
        raise ValueError(f"--quantum: encoders step in coordinates, and {model} is on a group; use --noise")
    # The log begins when its latest reading tells of the start.
    delays = np.atleast_1d(np.asarray(file.delay, float))
    t = simulation.stamps(sensor, scenario.duration, scenario.seed) + delays.max()
    told_of = np.round([t, *(t - delay for delay in delays)], DIGITS)
    times, rows = np.unique(told_of, return_inverse=True)
    rows = rows.reshape(told_of.shape)
    pace = 2 * np.pi * scenario.frequency * (1 + 0.37 * np.arange(m))  # no two inputs in step

    def acting(s, x):
        return amplitude * _behind(pace, s - file.input_delay, file.input_lag)

    with working("simulating", quiet=as_json):
        record = simulation.simulate(file.model, x0, jnp.asarray(times), acting)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(record.x)):
        raise ValueError(f"{model}: the motion leaves the finite numbers; check initial state and inputs")
    y = np.asarray(record.y)
    read = y[rows[1]] if len(delays) == 1 else np.stack([y[row, i] for i, row in enumerate(rows[1:])], axis=1)
    columns = {names.t: t} | logs.to_columns(names, _sense(file.model, sensor, read, scenario.seed))
    record = jax.tree.map(lambda leaf: leaf[rows[0]], record)
    columns |= dict(zip(names.u, (np.asarray(amplitude) * np.sin(pace * t[:, None])).T, strict=True))
    configuration, hidden = _truth(file, names, record)
    columns |= {f"true_{name}": column for name, column in (configuration | hidden).items()}
    logs.write(out, _in_units(names, columns, tuple(hidden), out.suffix in logs.MESSAGES))
    truth = ",".join(f"true_{name}" for name in hidden)
    result = {"model": model, "rows": len(t), "out": str(out), "truth_columns": truth}
    use = "the true state is in" if not file.mechanical else "score against --truth"
    print(json.dumps(result) if as_json else f"wrote {out}: {len(t)} rows; {use} {truth}")


def _behind(pace: np.ndarray, s: jax.Array, lag: float) -> jax.Array:
    """What acts at a time s [s] of sin(pace s), 0 before s = 0, behind a first-order lag [s]."""
    s = jnp.maximum(s, 0.0)
    if lag == 0:
        return jnp.sin(pace * s)
    a = pace * lag
    return (jnp.sin(pace * s) - a * jnp.cos(pace * s) + a * jnp.exp(-s / lag)) / (1 + a**2)


def _columns(file: models.ModelFile) -> logs.Columns:
    """The columns to write; an attitude is written as qw, qx, qy, qz unless the model file names other columns, the
    second one as qw2, qx2, qy2, qz2."""
    count = file.unnamed_attitudes
    names = tuple(f"q{part}{k or ''}" for k in (0, *range(2, count + 1)) for part in "wxyz")
    return file.columns._replace(quaternion_wxyz=names) if count else file.columns


def _start(file: models.ModelFile, scenario: Scenario) -> jax.Array | Motion:
    """The initial state; for a state-space model --q0 holds all of it."""
    q0 = _numbers("--q0", scenario.q0, file.dimension)
    if not file.mechanical:
        if scenario.v0 is not None:
            raise ValueError("--v0: a state-space model has no velocities; give all its initial state by --q0")
        return q0
    v0 = _numbers("--v0", scenario.v0, file.dimension)
    model: Any = file.model
    manifold = model.manifold
    return model.state(Motion(manifold.retract(manifold.origin(), q0), v0))


def _truth(file: models.ModelFile, names: logs.Columns, record: Record) -> tuple[dict[str, Any], dict[str, Any]]:
    """Columns of the true configuration and velocities; for a state-space model none, and those of all its states."""
    model: Any = file.model
    x = record.x
    if not file.mechanical:
        return {}, dict(zip(file.model.coordinates, np.asarray(x).T, strict=True))
    velocities = dict(zip(sought_columns(file), np.asarray(model.motion(x).v).T, strict=True))
    return logs.to_columns(names, np.asarray(record.y)), velocities


def _in_units(
    names: logs.Columns, columns: dict[str, np.ndarray], hidden: tuple[str, ...], messages: bool
) -> dict[str, np.ndarray]:
    """The columns in the units that the model file gives its logs; messages of ROS have a clock of their own."""
    fields = {"t": () if messages else (names.t,), "q": names.q, "u": names.u}
    fields |= {"position": names.position, "angle": names.angle}
    units = {name: names.unit_of(field, i) for field, each in fields.items() for i, name in enumerate(each)}
    units |= {f"true_{name}": unit for name, unit in units.items()}
    units |= {f"true_{name}": names.unit_of("truth", i) for i, name in enumerate(hidden)}
    factors = {name: logs.unit_factor(unit) for name, unit in units.items() if unit is not None}
    return {name: column / factors[name] if name in factors else column for name, column in columns.items()}


def _sense(model: Any, sensor: simulation.Sensor, y: np.ndarray, seed: int) -> np.ndarray:
    """Measurements of outputs or configurations; on a group errors are rotations and translations in the body frame."""
    if model.manifold.commuting:
        return simulation.sense(sensor, y, seed)
    error = simulation.sense(sensor, np.zeros((len(y), len(model.velocities))), seed)
    measured = np.asarray(jax.vmap(model.manifold.retract)(y, jnp.nan_to_num(error)))
    return np.where(np.isnan(error).any(axis=1).reshape(-1, *(1,) * (measured.ndim - 1)), np.nan, measured)


def _numbers(option: str, text: str | None, count: int):
    if text is None:
        return jnp.zeros(count)
    try:
        values = [number(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option}: {text!r} is not a list of numbers separated by commas") from None
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{option} needs {count} finite numbers separated by commas; got {text!r}")
    return jnp.array(values)
