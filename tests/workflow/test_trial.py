"""What rivals are tuned on: neither rest nor faults; and what they are ranked by."""

import numpy as np
import pytest

from covariant.workflow import compare, simulate
from covariant.workflow._trial import moving_part

T = 0.01 * np.arange(3000)
V = np.cos(3 * T)[:, None]
NONE, ALL = np.zeros(3000, bool), np.ones(3000, bool)
NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.5}


def begin(part):
    return T[part][0]


def test_the_first_third_is_taken_where_nothing_speaks_against_it():
    part = moving_part(T, V, ALL, NONE)
    assert begin(part) == 0.0
    assert T[part][-1] == pytest.approx(T[-1] / 3, abs=0.02)


def test_rest_is_passed_over():
    assert begin(moving_part(T, np.where(T[:, None] < 10.0, 0.0, V), ALL, NONE)) > 2.0


def test_faults_are_passed_over_and_the_fewest_taken_where_they_are_everywhere():
    faulty = (T < 9.0) & (np.arange(3000) % 50 == 0)
    assert begin(moving_part(T, V, ALL, faulty)) > 8.9
    everywhere = np.arange(3000) % np.where(T < 15.0, 50, 200) == 0
    assert begin(moving_part(T, V, ALL, everywhere)) > 14.9


def test_faults_of_the_reference_are_no_motion():
    v = np.where(T[:, None] < 12.0, 0.0, V)
    v[300] = 500.0
    assert begin(moving_part(T, v, ALL, NONE)) > 3.0


@pytest.fixture(scope="module")
def table():
    return simulate("oscillator", duration=18.0, rate=50.0, q0=1.0, noise=1e-3).to_pandas()


@pytest.mark.exhaustive
def test_without_truth_estimators_are_ranked_by_predictions_and_the_text_says_so(table):
    log = table[["t", "q", "u1"]].copy()
    log.loc[[40, 90, 140, 190, 240], "q"] += 0.8
    result = compare("oscillator", log, overrides=NOISE, engine="jax")
    assert "Ranked by the prediction of positions up to" in str(result)
    assert "behind a gate that refuses outliers" in result.design
    predicted = result.columns["predicted1_rmse"]
    assert (np.diff(predicted) >= 0).all()
    assert "predicted_rmse" in result.summary["ranking"][0]
    true = np.asarray(table["true_v1"])
    late = np.asarray(table["t"]) > 2.0
    errors = {name: np.std((outcome.velocity[:, 0] - true)[late]) for name, outcome in result.outcomes.items()}
    assert errors[result.ranking[0]] < 1.5 * min(errors.values())
    # The trial has none of the outliers, so the windows suit the noise.
    assert errors["savitzky-golay"] < 0.05
