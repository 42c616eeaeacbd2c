"""`export` of mechanical models: the observer that `estimate` runs, and measurements for its self-test."""

import functools
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.calibration import DataSheet, estimators, observer_gains, usual_speeds
from covariant.codegen import ROWS
from covariant.models import MechanicalSystem, ModelFile
from covariant.observers import REGISTRY
from covariant.workflow._chosen import build_observer, explain_gate, without_gate
from covariant.workflow._exported import UNGATED, Exported
from covariant.workflow._inputs import Loaded, data_sheet
from covariant.workflow._sensors import FileSensor, file_sensors, with_readings

CENTRE, SWING = 0.7, 0.2
"""Where positions of the self-test are, and how far they swing, in units of the coordinates; circles start at π."""
OUTLIER_ROW, OUTLIER = 23, 1.5
"""The row of the self-test that a gate has to refuse, and how far it is off [rad or m]."""


def mechanical_observer(
    name: str,
    file: ModelFile,
    observer: str | None,
    gains: tuple[float, float] | None,
    rate: float,
    metric: str | Path | None,
    gate: bool,
    logged: Loaded | None,
) -> Exported:
    """Build an observer of a mechanical model for export, as `estimate` builds it.

    Args:
        name: The model, by its path or name, for messages.
        file: The model file.
        observer: Name of the observer; by default the first that fits the model.
        gains: Gains α [1/s] and β [1/s²] in place of the designed ones.
        rate: Sampling rate [Hz].
        metric: For state-space models only.
        gate: Whether the gate of the observer is written.
        logged: A log and the model, for the usual speed and the sensors that were read.

    Returns:
        The observer, with measurements for its self-test.

    Raises:
        ValueError: The observer does not fit the model, or the model file lacks numbers.
    """
    if metric is not None:
        raise ValueError(f"metric is for the observer riccati of a state-space model; {name} is a mechanical one")
    model: Any = file.model
    kind = observer or estimators(model)[0]
    sheet = functools.cache(lambda: _sheet(file, logged))
    chosen = build_observer(name, file, kind, rate, gains, sheet)
    told, warning = explain_gate(chosen, file, logged is not None) if gate else (UNGATED, "")
    chosen = chosen if gate else without_gate(chosen)
    pace = math.inf if getattr(chosen, "gate", None) is None else float(np.min(sheet().speeds)) / rate
    measured = _measured(model, file.dimension, pace)
    if getattr(chosen, "sensors", ()):
        measured = with_readings(file, sensors_of(file, logged), measured)
    if gains is not None:
        design = f"Given gains: alpha = {gains[0]:g} 1/s, beta = {gains[1]:g} 1/s^2."
        return Exported(kind, chosen, design, measured, told, warning)
    by_gains = next(entry for entry in REGISTRY if entry.name == kind).tuned_by == "gains"
    designed = observer_gains(sheet(), rate).summary.replace("²", "^2")
    design = f"Designed {designed}." if by_gains else "Tuned from its data sheet."
    return Exported(kind, chosen, design, measured, told, warning)


def sensors_of(file: ModelFile, logged: Loaded | None) -> tuple[FileSensor, ...]:
    """The sensors of a model file, without those that a log has no columns of.

    Args:
        file: The model file.
        logged: A log and the model, or None.
    """
    known = None if logged is None else {part.sensor.name for part in logged.sensors}
    return tuple(part for part in file_sensors(file) if known is None or part.sensor.name in known)


def _sheet(file: ModelFile, logged: Loaded | None) -> DataSheet:
    """The data sheet by which `estimate` designs, with the usual speeds of a log where there is one."""
    speed = (0.0,) * file.dimension if logged is None else usual_speeds(logged.model, logged.record)
    return data_sheet(file)._replace(speed=speed, sensors=tuple(part.sensor for part in sensors_of(file, logged)))


def _measured(model: MechanicalSystem, n: int, pace: float) -> np.ndarray:
    """Measurements (ROWS + 1, *n) for the self-test: a swing of every coordinate; circles are crossed at π.

    It moves by no more than `pace` from row to row. Where that is finite, a gate judges, and one row is an outlier.
    """
    k = np.arange(ROWS + 1)[:, None]
    # Each coordinate has another period and phase, so that no two are alike.
    swing = min(SWING, 4.0 * pace) * np.sin(k / (4.0 + np.arange(n)) + np.arange(n))
    if math.isfinite(pace):
        swing[OUTLIER_ROW, 0] += OUTLIER
    manifold = model.manifold
    if manifold.commuting:
        return swing + np.where(np.isin(np.arange(n), manifold.circles), np.pi, CENTRE)
    return np.stack([np.asarray(manifold.retract(manifold.origin(), jnp.asarray(s))) for s in swing])
