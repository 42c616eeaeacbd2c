"""Fits to simulated logs: the truth is found, intervals cover it, and what a log does not determine is named.

The pendulum is simulated by its equation, written here a second time and without JAX.
"""

import numpy as np
import pytest

from covariant import models
from covariant.calibration import PredictionErrors, cut_windows
from covariant.calibration.identification import error_growth, machine_errors, predicts_worse
from covariant.signals import Record


def test_outliers_do_not_hide_that_a_model_predicts_worse():
    t = np.arange(0, 12, 0.02)
    rng = np.random.default_rng(0)
    y = np.cos(t) + 1e-3 * rng.normal(size=len(t))
    y[rng.choice(len(t), 12, replace=False)] += 2.0
    record = Record(t, np.zeros((len(t), 1)), y[:, None])
    pieces = cut_windows([record], [-np.sin(t)[:, None]], length=1.0)
    before, after = (machine_errors([models.oscillator(stiffness=k)], pieces) for k in (1.0, 1.05))
    assert error_growth(before, after) > 1.5


def test_bursts_of_outliers_are_refused_in_the_errors_of_predictions():
    t = np.arange(0, 12, 0.02)
    rng = np.random.default_rng(0)
    clean = np.cos(t) + 1e-3 * rng.normal(size=len(t))
    y = clean.copy()
    for k in rng.choice(np.arange(5, len(t) - 5), 10, replace=False):
        y[k : k + 3] += 2.0
    velocity = [-np.sin(t)[:, None]]
    logs = [cut_windows([Record(t, np.zeros((len(t), 1)), each[:, None])], velocity, 1.0) for each in (clean, y)]
    right, spoiled = (machine_errors([models.oscillator(stiffness=1.05)], pieces) for pieces in logs)
    np.testing.assert_allclose(spoiled.position, right.position, rtol=0.1)
    np.testing.assert_allclose(spoiled.one_step, right.one_step, rtol=0.1)


def test_a_fit_that_predicts_one_coordinate_clearly_worse_is_worse():
    before, after = (PredictionErrors(*[np.array(size)] * 3) for size in ([0.1, 0.01], [0.01, 0.012]))
    assert error_growth(before, after) < 1
    assert predicts_worse(before, after)
    assert not predicts_worse(before, before)


@pytest.mark.parametrize(("velocity", "message"), [(0.0, "nothing moves"), (np.nan, "windows of")])
def test_a_log_that_stands_still_is_told_from_one_whose_velocities_are_unknown(velocity, message):
    t = np.arange(0.0, 20.0, 0.02)
    record = Record(t, y=np.sin(t)[:, None])
    with pytest.raises(ValueError, match=message):
        cut_windows([record], [np.full((len(t), 1), velocity)], length=1.0)
