"""`covariant simulate`: a log with the truth in it."""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant import logs, models, simulation
from covariant.cli._console import working
from covariant.cli._job import check_output, velocity_columns
from covariant.models import GroupSystem, Motion


class Scenario(NamedTuple):
    """Options of the command, as the user gave them."""

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
    """Simulate, measure, and write t, the measured configuration, inputs, and both true ones as true_…."""
    check_output(out, ".csv", ".parquet")
    file = models.load(model, overrides)
    names, n, m = _columns(file), file.dimension, len(file.columns.u)
    q0, v0 = _numbers("--q0", scenario.q0, n), _numbers("--v0", scenario.v0, n)
    amplitude = _numbers("--amplitude", scenario.amplitude, m)
    sensor = simulation.Sensor(scenario.rate, scenario.noise, scenario.quantum, scenario.jitter, scenario.dropout)
    if sensor.quantum and isinstance(file.model, GroupSystem):
        raise ValueError(f"--quantum: encoders step in coordinates, and {model} is on a group; use --noise")
    t = simulation.stamps(sensor, scenario.duration, scenario.seed)
    pace = 2 * jnp.pi * scenario.frequency * (1 + 0.37 * jnp.arange(m, dtype=float))  # no two inputs in step

    def push(s, x):
        return amplitude * jnp.sin(pace * s)

    with working("simulating", quiet=as_json):
        record = simulation.simulate(file.model, _start(file.model, q0, v0), jnp.asarray(t), push)
    q, v = record.x if isinstance(record.x, Motion) else np.split(np.asarray(record.x), 2, axis=1)
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise ValueError(f"{model}: the motion leaves the finite numbers; check initial state and inputs")
    columns = {names.t: t} | logs.to_columns(names, _sense(file.model, sensor, q, scenario.seed))
    columns |= dict(zip(names.u, np.asarray(record.u).T, strict=True))
    columns |= {f"true_{name}": column for name, column in logs.to_columns(names, np.asarray(q)).items()}
    velocities = [f"true_{name}" for name in velocity_columns(file)]
    columns |= dict(zip(velocities, np.asarray(v).T, strict=True))
    logs.write(out, columns)
    truth = ",".join(velocities)
    result = {"model": model, "rows": len(t), "out": str(out), "truth_columns": truth}
    print(json.dumps(result) if as_json else f"wrote {out}: {len(t)} rows; score against --truth {truth}")


def _columns(file: models.ModelFile) -> logs.Columns:
    """Where to write; an attitude goes into qw, qx, qy, qz unless the model file names another way."""
    return file.columns._replace(quaternion_wxyz=("qw", "qx", "qy", "qz")) if file.lacks_attitude else file.columns


def _start(model: models.Lagrangian | GroupSystem, q0: jax.Array, v0: jax.Array) -> jax.Array | Motion:
    return Motion(model.group.exp(q0), v0) if isinstance(model, GroupSystem) else jnp.concatenate([q0, v0])


def _sense(model: models.Lagrangian | GroupSystem, sensor: simulation.Sensor, q, seed: int) -> np.ndarray:
    """Measurements of the configurations q; on a group their errors are turns and shifts as seen from the body."""
    if not isinstance(model, GroupSystem):
        return simulation.sense(sensor, q, seed)
    error = simulation.sense(sensor, np.zeros((len(q), model.group.dimension)), seed)
    seen = np.asarray(jax.vmap(lambda g, e: g @ model.group.exp(e))(q, jnp.nan_to_num(error)))
    return np.where(np.isnan(error[:, :1, None]), np.nan, seen)


def _numbers(option: str, text: str | None, count: int):
    if text is None:
        return jnp.zeros(count)
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option}: {text!r} is not a list of numbers separated by commas") from None
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{option} needs {count} finite numbers separated by commas; got {text!r}")
    return jnp.array(values)
