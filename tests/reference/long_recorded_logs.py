"""Recorded logs: the intrinsic observer, with gains from the rule alone, against figures that must not get worse.

The logs belong to others and are not in this repository; the folder that holds them is named by `COVARIANT_DATA`.
"""

from pathlib import Path

import numpy as np
import pytest

from covariant import logs, models, scoring
from covariant.calibration import DataSheet, tuned_estimators
from covariant.observers import run
from covariant.signals import lag_inputs

EXAMPLES = Path(__file__).parents[2] / "examples"
DOUBLE, SIMPLE = "dfki_double_pendulum", "dfki_simple_pendulum"
CASES = [
    (DOUBLE, f"{DOUBLE}/A0_sysid_00.csv", 1, None, (0.040, 0.070)),
    (DOUBLE, f"{DOUBLE}/A0_sysid_05.csv", 1, None, (0.052, 0.070)),
    (DOUBLE, f"{DOUBLE}/A0_sysid_12.csv", 1, None, (0.042, 0.065)),
    ("multiarm_double", "multiarm_pendulum/double.csv", 5, 20.2, (0.006, 0.008)),
    (SIMPLE, f"{SIMPLE}/dircol.csv", 1, None, (0.060,)),
    (f"{SIMPLE}_dircol", f"{SIMPLE}/ddp.csv", 1, None, (0.045,)),
]
"""Model file, log, each k-th row, until [s], and the velocity RMSE [rad/s] that must be reached."""


@pytest.mark.exhaustive("dfki_double_pendulum/A0_sysid_00.csv", "multiarm_pendulum/double.csv")
@pytest.mark.data
@pytest.mark.parametrize(("model", "log", "every", "until", "bars"), CASES, ids=[case[1] for case in CASES])
def test_velocity_error_on_a_recorded_log(data_folder, model, log, every, until, bars):
    file = models.load(str(EXAMPLES / f"{model}.toml"))
    full = logs.read(data_folder / log, file.columns).record
    record = lag_inputs(logs.read(data_folder / log, file.columns, every, until).record, file.input_lag)
    sheet = DataSheet(file.measurement_std, file.acceleration_std, file.correlation_time, damping=file.damping)
    t = np.asarray(record.t)
    observer = tuned_estimators(file.model, len(bars), sheet, 1 / float(np.median(np.diff(t))))["intrinsic"]
    estimate = np.asarray(run(observer, record).estimate)
    reference = scoring.zero_phase_velocity(full.t, full.y, t, file.reference_half, int(file.reference_order))
    scored = scoring.scored_window(t)
    error = scoring.rmse(estimate[scored, len(bars) :], reference[scored])
    assert (error <= bars).all(), f"{error} exceeds {bars}"
