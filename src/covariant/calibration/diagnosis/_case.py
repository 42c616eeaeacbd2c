"""A log prepared for the comparison with its model: without outliers, smoothed, in corrected units."""

from typing import Any, NamedTuple

import numpy as np

from covariant.calibration.diagnosis import _sensor
from covariant.calibration.diagnosis._changes import Change, Names
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._readings import known_ticks
from covariant.calibration.diagnosis._residual import CLEAR, Residual, residual
from covariant.calibration.diagnosis._smooth import FEWEST, ORDER, Smooth, smooth
from covariant.models import MechanicalSystem, ModelFile
from covariant.signals import Record, acting_inputs, lag_inputs

SHORTEST = 6.0
"""Least length of a log that is compared with the model, in half windows."""
WINDOWS = (1.0, 2.0, 3.0)
"""Half windows to try, in those of the reference of the model file; the one that explains most is used."""
WIDER = (2.0, 4.0, 8.0, 16.0)
"""Half windows to try until accelerations exceed the noise, as in a slow motion only wide ones show."""


class Case(NamedTuple):
    """A record in coordinates, without outliers, the model to compare it with, and the ticks of its encoders."""

    file: ModelFile
    model: MechanicalSystem
    names: Names
    record: Record
    ticks: np.ndarray

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(np.asarray(self.record.t))))


def in_coordinates(file: ModelFile) -> bool:
    """Whether a model file has a mechanical system in coordinates, whose accelerations can be compared with a log."""
    return file.mechanical and file.model.manifold.commuting  # pyright: ignore[reportAttributeAccessIssue]


def busiest(record: Record, rows: int) -> Record:
    """Stretch of a record in which the positions move most.

    Args:
        record: The log, with positions (T, n).
        rows: Number of rows of the stretch.

    Returns:
        That many consecutive rows, or the whole record where it is shorter.
    """
    if len(record.t) <= rows:
        return record
    travel = np.nan_to_num(np.abs(np.diff(np.asarray(record.y), axis=0)))
    # Each coordinate counts in units of its fast steps; the floor is for one that stands still.
    travel = np.sum(travel / np.maximum(np.quantile(travel, 0.95, axis=0), 1e-300), axis=1)
    reached = np.append(0.0, np.cumsum(travel))  # from the first row to each
    start = int(np.argmax(reached[rows - 1 :] - reached[: len(reached) - rows + 1]))
    return Record(*(np.asarray(a)[start : start + rows] for a in record[:3]))


def names_of(file: ModelFile) -> Names:
    n = len(file.columns.q)
    units = file.model.units or ("",) * n
    angles = np.array([unit == "rad" or i in file.model.circles for i, unit in enumerate(units)])
    return Names(file.columns.t, file.columns.q, file.columns.u, units, angles, file.columns.units)


def case_without_outliers(
    file: ModelFile,
    record: Record,
    rows: _sensor.Rows | None = None,
    quantum: float | tuple[float, ...] | None = None,
) -> tuple[Case, list[Finding]]:
    """Record prepared for the comparison: outliers are set to NaN and reported.

    Args:
        file: The model file, of a mechanical system in coordinates.
        record: The log.
        rows: How messages name the rows; by default they count from 1.
        quantum: Ticks that the model file states, where `file` no longer has them.

    Returns:
        The case to compare, and a finding for each column with outliers.
    """
    model, names = file.need_mechanical(file.name, "accelerations are compared with those of"), names_of(file)
    t, y = np.asarray(record.t), np.asarray(record.y)
    ticks = known_ticks(record, model.circles, file.quantum if quantum is None else quantum)
    wrong, sizes = _sensor.outliers(t, y, model.circles, ticks)
    case = Case(file, model, names, Record(t, np.asarray(record.u), np.where(wrong, np.nan, y)), ticks)
    return case, _sensor.outlier_findings(wrong, sizes, names.q, names.units, rows or _sensor.Rows(t))


def smoothed(case: Case, half: float, delay: Any = 0.0) -> Smooth:
    late = delay + np.asarray(case.file.delay, float)
    return smooth(acting(case), half, case.model.circles, late, case.ticks)


def acting(case: Case) -> Record:
    """The record with the inputs that act in each step."""
    file = case.file
    return acting_inputs(lag_inputs(case.record, file.input_lag), file.input_between, file.input_delay)


def long_enough(case: Case, half: float) -> bool:
    """Whether the record can be smoothed over windows of ±`half` [s]."""
    t, y = np.asarray(case.record.t), np.asarray(case.record.y)
    enough = np.isfinite(y).sum(axis=0).min() > 10 * (ORDER + 1)
    return bool(enough and t[-1] - t[0] >= SHORTEST * max(half, FEWEST * case.spacing))


def clearly(case: Case) -> Smooth | None:
    """Smooth a record by the narrowest window whose accelerations exceed the noise, or else by the widest one.

    Args:
        case: The record.

    Returns:
        The smoothed log; None where the record is too short for any.
    """
    log = None
    for half in (w * case.file.reference_half for w in WIDER):
        if not long_enough(case, half):
            break
        log = smoothed(case, half)
        if np.any(np.mean(log.a[log.used] ** 2, axis=0) > CLEAR * log.a_noise**2) if log.used.any() else False:
            break
    return log


def compared(case: Case) -> Residual | None:
    """Residual accelerations of the record; None where it is too short to be smoothed."""
    log = clearly(case)
    return None if log is None else residual(case.model, log)


def best_window(case: Case) -> tuple[float, Residual] | None:
    """Half width of the smoothing window with which the model explains most.

    Args:
        case: The record and the model to compare.

    Returns:
        The half width [s] and the residual accelerations; None where the accelerations of no coordinate exceed noise.
    """
    halves = [half for half in (w * case.file.reference_half for w in WINDOWS) if long_enough(case, half)]
    tried = [(half, residual(case.model, smoothed(case, half))) for half in halves]
    if not any(left.told.any() for _, left in tried) and (log := clearly(case)) is not None:
        tried = [(log.half, residual(case.model, log))]
    known = [(half, left) for half, left in tried if left.told.any()]
    return min(known, key=lambda entry: entry[1].misfit) if known else None


def changed(case: Case, change: Change) -> Case:
    """A case after a change of its log.

    Args:
        case: The case.
        change: The change.
    """
    ticks = np.abs(change.position) * case.ticks[change.order]
    return case._replace(record=change.of_record(case.record), names=case.names.after(change), ticks=ticks)
