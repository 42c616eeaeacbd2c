"""`covariant simulate`: a log with the truth in it."""

import json
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant import logs, models, simulation
from covariant.cli._console import working
from covariant.cli._job import check_output


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
    """Simulate, measure, and write t, measured positions, inputs, and true_q…, true_v…."""
    check_output(out, ".csv", ".parquet")
    file = models.load(model, overrides)
    n, m = len(file.columns.q), len(file.columns.u)
    x0 = jnp.concatenate([_numbers("--q0", scenario.q0, n), _numbers("--v0", scenario.v0, n)])
    amplitude = _numbers("--amplitude", scenario.amplitude, m)
    sensor = simulation.Sensor(scenario.rate, scenario.noise, scenario.quantum, scenario.jitter, scenario.dropout)
    t = simulation.stamps(sensor, scenario.duration, scenario.seed)
    pace = 2 * jnp.pi * scenario.frequency * (1 + 0.37 * jnp.arange(m, dtype=float))  # no two inputs in step

    def push(s, x):
        return amplitude * jnp.sin(pace * s)

    with working("simulating", quiet=as_json):
        record = simulation.simulate(file.model, x0, jnp.asarray(t), push)
    x = np.asarray(record.x)
    if not np.isfinite(x).all():
        raise ValueError(f"{model}: the motion leaves the finite numbers; check initial state and inputs")
    y = simulation.sense(sensor, x[:, :n], scenario.seed)
    columns = {file.columns.t: t}
    columns |= dict(zip(file.columns.q, y.T, strict=True)) | dict(
        zip(file.columns.u, np.asarray(record.u).T, strict=True)
    )
    columns |= {f"true_{name}": column for name, column in zip(file.columns.q, x[:, :n].T, strict=True)}
    columns |= {f"true_v{i + 1}": column for i, column in enumerate(x[:, n:].T)}
    logs.write(out, columns)
    truth = ",".join(f"true_v{i + 1}" for i in range(n))
    result = {"model": model, "rows": len(t), "out": str(out), "truth_columns": truth}
    print(json.dumps(result) if as_json else f"wrote {out}: {len(t)} rows; score against --truth {truth}")


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
