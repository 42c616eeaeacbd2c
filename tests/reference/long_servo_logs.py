"""A recorded servo with a weight: one set of numbers for all gains, against the best published model of it.

The logs belong to others and are not in this repository; the folder that holds them is named by `COVARIANT_DATA`.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import covariant
from covariant import logs, models
from covariant.calibration.identification import predict_servos

pytestmark = pytest.mark.data

XL330 = str(Path(__file__).parents[2] / "examples/xl330.toml")
FIRST = {
    "stiffness": 0.003,
    "limit": 0.8,
    "back_emf": 0.05,
    "viscous": 0.01,
    "coulomb": 0.01,
    "stribeck": 0.01,
    "load": 0.4,
    "armature": 0.002,
}
NAMES = [*(f"servo.servo.{key}" for key in FIRST), "offsets.servo"]
FITTED = ("kp100_lift_and_drop", "kp100_sin_sin", "kp400_lift_and_drop", "kp400_sin_sin")
M6 = {
    "kp200_sin_time_square": 36.8,
    "kp200_up_and_down": 131.0,
    "kp800_sin_time_square": 98.6,
    "kp800_up_and_down": 238.0,
}
"""Errors [mrad] of BAM's model M6 with its published numbers on logs at other gains, by `benchmarks/servo_fits.py`."""


def gain(log: str) -> float:
    return float(log.split("_")[0].removeprefix("kp"))


def fitted(folder: Path, names: tuple[str, ...]) -> Any:
    """The fit to logs of several gains, from rough first values; one more log is held out."""
    first = {f"servo.servo.{key}": value for key, value in FIRST.items()} | {"parameters.offsets": {"servo": 0.0}}
    names = (*names, "kp800_up_and_down")
    settings = [first | {"servo.servo.gain": gain(name)} for name in names]
    paths = [folder / "xl330" / f"{name}.csv" for name in names]
    return covariant.fit(XL330, paths, NAMES, overrides=settings)


@pytest.mark.exhaustive
def test_one_set_of_numbers_predicts_logs_at_other_gains(data_folder):
    result = fitted(data_folder, FITTED)
    assert result.better
    assert np.isfinite(result.standard_errors).all()
    found = dict(zip(NAMES, result.values, strict=True))
    overrides = tuple(f"{'parameters.' * name.startswith('offsets')}{name}={value}" for name, value in found.items())
    for name, bar in M6.items():
        family = models.robot_family(XL330, NAMES, (*overrides, f"servo.servo.gain={gain(name)}"))
        record = logs.read(data_folder / "xl330" / f"{name}.csv", family.file.columns).record
        measured = np.asarray(record.y)
        path = np.repeat(measured[:1], len(measured), axis=0)
        for _ in range(3):  # the weight is that along the prediction, so that no row but the first is looked at
            path = predict_servos(family, np.zeros(len(NAMES)), record._replace(y=path))
        assert 1e3 * np.sqrt(np.mean((path - measured) ** 2)) <= bar


@pytest.mark.exhaustive
def test_two_halves_of_the_logs_agree(data_folder):
    one, other = (fitted(data_folder, (FITTED[i], FITTED[j])) for i, j in ((0, 3), (1, 2)))
    errors = np.hypot(one.standard_errors, other.standard_errors)
    both = np.isfinite(errors)  # half of the logs need not determine every number by itself
    assert both.sum() >= 6
    assert (np.abs(one.values - other.values)[both] <= 4 * errors[both]).all()
