"""Scores of velocities: error, lag, noise, band and worst tenth, on the rows that are judged.

Every coordinate counts by its own size: errors are fractions of the root mean square of its velocity, and the number of
a log is the root mean square over its coordinates.
"""

from typing import Any

import numpy as np

from benchmarks.velocity.cases import Case
from covariant.calibration import ErrorRatio

LAGS = np.arange(-5.0, 20.25, 0.25)
"""Lags that are tried [rows]."""
BLOCKS, WORST = 50, 0.1
"""Number of parts of the judged rows, and the fraction of them that are the worst ones."""
BAND = 1.959964
"""Half width of a 95 % band, in standard deviations."""


def relative_error(v: np.ndarray, true: np.ndarray, rows: np.ndarray) -> float:
    """Root mean square error in some rows as a fraction of the velocity; infinite if an estimate is not finite."""
    rows = rows & np.isfinite(true).all(axis=1)
    if not np.isfinite(v[rows]).all():
        return np.inf
    return float(np.sqrt(np.mean(np.mean((v - true)[rows] ** 2, axis=0) / np.mean(true[rows] ** 2, axis=0))))


def scores(case: Case, v: np.ndarray, std: np.ndarray | None) -> dict[str, Any]:
    """All scores of one estimate.

    `lag` [s] is the delay of the true velocities with which they are nearest to the estimate, and `noise` the standard
    deviation of white noise with the same second differences as the error, as a fraction of the velocity. `band` is the
    part of the velocities within the estimate's own 95 % band, and `worst_tenth` the error in the worst tenth of the
    rows, in parts of a fiftieth.
    """
    rows = case.judge & np.isfinite(case.v).all(axis=1)
    true, error = case.v[rows], (v - case.v)[rows]
    size = np.sqrt(np.mean(true**2, axis=0))
    parts = [np.mean((part / size) ** 2) for part in np.array_split(error, BLOCKS)]
    worst = np.sort(parts)[-max(1, round(WORST * BLOCKS)) :]
    found: dict[str, Any] = {
        "error": relative_error(v, case.v, case.judge),
        "rmse": np.sqrt(np.mean(error**2, axis=0)).tolist(),
        "lag": _lag(case, v, rows, size),
        "noise": float(np.sqrt(np.mean((np.diff(error, 2, axis=0) / size) ** 2) / 6)),
        "worst_tenth": float(np.sqrt(np.mean(worst))),
    }
    if std is not None:
        found["band"] = float(np.mean(np.abs(error) <= BAND * std[rows]))
    if case.second is not None:
        found["second"] = relative_error(v, case.second.v, case.judge)
    return found


def _lag(case: Case, v: np.ndarray, rows: np.ndarray, size: np.ndarray) -> float:
    t, known = case.t, np.isfinite(case.v).all(axis=1)
    row = float(np.median(np.diff(t)))

    def off(lag: float) -> float:
        late = np.stack([np.interp(t[rows] - lag * row, t[known], one[known]) for one in case.v.T], axis=1)
        return float(np.mean(((v[rows] - late) / size) ** 2))

    return float(row * min(LAGS, key=off))


def ratio(case: Case, v: np.ndarray, other: np.ndarray) -> list[float]:
    """Error of one estimate as a multiple of another's, and the interval of this ratio by a block bootstrap."""
    rows = case.judge & np.isfinite(case.v).all(axis=1)
    verdict = ErrorRatio.of_velocities([v[rows]], [other[rows]], [case.v[rows]])
    return [verdict.error / verdict.other, verdict.low, verdict.high]
