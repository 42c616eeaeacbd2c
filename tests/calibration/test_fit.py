"""Fits to simulated logs: the truth is found, intervals cover it, and what a log does not determine is named.

The pendulum is simulated by its equation, written here a second time and without JAX.
"""

import numpy as np
import pytest

from covariant import models
from covariant.calibration import PredictionErrors
from covariant.calibration._least_squares import minimise_above_bounds
from covariant.calibration.identification import Unknowns, error_growth, gather, predicts_worse, window_errors
from covariant.signals import Record


def errors_over_a_second(t: np.ndarray, y: np.ndarray, stiffness: float) -> PredictionErrors:
    """Errors of predictions of the motion cos t over windows of a second."""
    unknowns = Unknowns.none(models.oscillator(stiffness=stiffness))
    record = Record(t, np.zeros((len(t), 1)), y[:, None])
    rows = gather(unknowns.manifold, [record], [-np.sin(t)[:, None]])
    return window_errors(unknowns, np.zeros(0), rows, 1.0, np.ones(len(rows.t), bool))


def test_outliers_do_not_hide_that_a_model_predicts_worse():
    t = np.arange(0, 12, 0.02)
    rng = np.random.default_rng(0)
    y = np.cos(t) + 1e-3 * rng.normal(size=len(t))
    y[rng.choice(len(t), 12, replace=False)] += 2.0
    before, after = (errors_over_a_second(t, y, stiffness) for stiffness in (1.0, 1.05))
    assert error_growth(before, after) > 1.5


def test_bursts_of_outliers_are_refused_in_the_errors_of_predictions():
    t = np.arange(0, 12, 0.02)
    rng = np.random.default_rng(0)
    clean = np.cos(t) + 1e-3 * rng.normal(size=len(t))
    y = clean.copy()
    for k in rng.choice(np.arange(5, len(t) - 5), 10, replace=False):
        y[k : k + 3] += 2.0
    right, spoiled = (errors_over_a_second(t, each, 1.05) for each in (clean, y))
    np.testing.assert_allclose(spoiled.position, right.position, rtol=0.1)
    np.testing.assert_allclose(spoiled.velocity, right.velocity, rtol=0.1)


def test_a_fit_that_predicts_one_coordinate_clearly_worse_is_worse():
    before, after = (PredictionErrors(*[np.array(size)] * 2) for size in ([0.1, 0.01], [0.01, 0.012]))
    assert error_growth(before, after) < 1
    assert predicts_worse(before, after)
    assert not predicts_worse(before, before)


def test_a_difference_below_a_tick_makes_no_fit_worse():
    before = PredictionErrors(*[np.array([0.02, 0.0006])] * 2)
    after = PredictionErrors(*[np.array([0.018, 0.0015])] * 2, resolution=0.001)
    assert not predicts_worse(before, after)
    assert error_growth(before, after) > 1.5, "what is said of the errors is what they are"
    assert predicts_worse(before, after._replace(resolution=0.0005))
    assert predicts_worse(before, after._replace(position=np.array([0.022, 0.0006])))


def test_what_may_be_chance_is_not_worse():
    """The second coordinate is worse by a tenth: in one of four windows by far, or in all of them alike."""
    rng = np.random.default_rng(0)
    old = np.stack([np.full(4, 0.01), np.full(4, 1e-4)], axis=1) * rng.uniform(0.99, 1.01, (4, 2))
    for more, worse in ((np.array([0.84, 0.0, 0.0, 0.0]), False), (np.full(4, 0.21), True)):
        new = old * np.stack([np.full(4, 0.1), 1 + more], axis=1)
        before, after = (PredictionErrors(*2 * [np.sqrt(np.mean(each, axis=0))], windows=each) for each in (old, new))
        assert predicts_worse(before, after) == worse


def test_a_log_that_stands_still_is_refused():
    t = np.arange(0.0, 20.0, 0.02)
    record = Record(t, y=np.sin(t)[:, None])
    with pytest.raises(ValueError, match="nothing moves"):
        gather(models.oscillator().manifold, [record], [np.zeros((len(t), 1))])


def test_a_log_with_few_positions_is_refused():
    t = np.arange(0.0, 20.0, 0.02)
    y = np.where(np.arange(len(t)) % 100 < 1, np.sin(t), np.nan)
    with pytest.raises(ValueError, match="fewer than 12 rows with positions"):
        gather(models.oscillator().manifold, [Record(t, y=y[:, None])], [np.cos(t)[:, None]])


def test_a_bounded_step_is_the_least_of_all_and_one_that_is_not_finite_ends_nothing():
    """Beside all choices of numbers at their bounds; a point beyond all numbers is refused by the search, not here."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        root, gradient, least = rng.normal(size=(4, 4)), rng.normal(size=4), -rng.uniform(0, 0.5, 4)
        matrix = root @ root.T + 0.1 * np.eye(4)
        step = minimise_above_bounds(matrix, gradient, least)
        slope = matrix @ step + gradient
        assert (step >= least - 1e-12).all()
        np.testing.assert_allclose(slope[step > least + 1e-9], 0.0, atol=1e-9)
        assert (slope > -1e-9).all()
    assert np.isnan(minimise_above_bounds(np.full((2, 2), np.nan), np.ones(2), np.zeros(2))).all()
