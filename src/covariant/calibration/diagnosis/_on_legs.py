"""Whether the encoders of a robot on legs are late against its IMU."""

from typing import Any

import numpy as np

from covariant.calibration._state_noise import state_noise
from covariant.calibration.diagnosis._finding import Finding
from covariant.models import ModelFile
from covariant.observers import legged_base, run
from covariant.signals import Record

MOST_ROWS = 4000
"""Largest number of rows that are compared."""
SETTLED = 1.0
"""Time [s] that the first estimate is given to settle."""
SHIFTS = np.arange(-3, 6)
"""Shifts of the encoders that are tried, in steps of `LEAST_STEP` or one sample, whichever is longer."""
LEAST_STEP = 0.002
"""Shortest step of a shift [s]."""
CLEARLY = 1.25
"""A delay is reported if the squared innovations at the stated delay are at least so many times the smallest ones."""
FEWEST = 100
"""Smallest number of readings from feet that stand at every shift; with fewer there is no verdict."""


def late_encoders(file: ModelFile, record: Record) -> list[Finding] | None:
    """Findings on encoders that are late, or early, against the IMU; None where the log does not show it.

    Feet that stand are off their anchors by what the velocity changed within the delay, so that their innovations are
    smallest at the right shift. Only readings count of feet that stand at every shift: which feet stand depends on it.
    """
    t, u, y = (np.asarray(part, float)[:MOST_ROWS] for part in record[:3])
    model: Any = file.model
    if file.measurement_std is None or file.process_std is None or not np.isfinite(y[0, : model.f.joints]).all():
        return None
    usual = float(np.median(np.diff(t)))
    step = max(LEAST_STEP, usual)
    observer = legged_base(model, state_noise(file, 1 / usual))
    known = float(np.max(file.delay))
    standing, off = [], []
    for shift in SHIFTS:
        moved = np.stack([np.interp(t + known + shift * step, t, column) for column in y.T], axis=1)
        moved[np.isnan(y)] = np.nan
        moved[0] = y[0]
        info = run(observer, Record(t, u, moved), ("standing", "squares")).info
        standing.append(np.asarray(info.standing)[t > t[0] + SETTLED])
        off.append(np.asarray(info.squares)[t > t[0] + SETTLED])
    always = np.all(standing, axis=0)
    if always.sum() < FEWEST:
        return None
    squares = np.array([each[always].mean() for each in off])
    best = int(np.clip(np.argmin(squares), 1, len(SHIFTS) - 2))
    before, least, after = squares[best - 1 : best + 2]
    # The vertex of the parabola through the least and its neighbours.
    vertex = np.clip((before - after) / (2 * (before - 2 * least + after)), -1.0, 1.0)
    worse = float(squares[SHIFTS == 0][0] / least)
    if worse < CLEARLY:
        return []
    delay = round(known + float(step * (SHIFTS[best] + vertex)), 4)
    more = " or more" * (np.argmin(squares) in (0, len(SHIFTS) - 1))
    evidence = (
        f"the feet that stand fit the IMU best if the encoders are read {1e3 * abs(delay):.3g} ms{more} "
        f"{'late' if delay > 0 else 'early'}: squared innovations are {worse:.2g} times as large as then"
    )
    line = f"[measurement] delay = {delay:.4g}"
    if delay < 0:
        line = f"the IMU is late: shift its columns by {-1e3 * delay:.3g} ms to earlier stamps"
    return [Finding("delay", "encoders", evidence, line, True, {"delay": delay})]
