"""What rivals are tuned on: neither rest nor faults; and what they are ranked by: what takes long."""

import numpy as np
import pytest

from covariant.verbs import compare, simulate

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.5}


@pytest.fixture(scope="module")
def table():
    return simulate("oscillator", duration=18.0, rate=50.0, q0=1.0, noise=1e-3).to_pandas()


@pytest.mark.exhaustive
def test_without_truth_estimators_are_ranked_by_the_reference_of_the_judge_on_rows_that_tuned_none(table):
    log = table[["t", "q", "u1"]].copy()
    log.loc[[40, 90, 140, 190, 240], "q"] += 0.8
    result = compare("oscillator", log, overrides=NOISE, engine="jax")
    assert result.without_model in str(result)
    assert "behind a gate that refuses outliers" in result.design
    assert (np.diff(result.columns["v1_rmse"]) >= 0).all()
    true = np.asarray(table["true_v1"])
    late = np.asarray(table["t"]) > 2.0
    errors = {name: np.std((outcome.velocity[:, 0] - true)[late]) for name, outcome in result.outcomes.items()}
    assert errors[result.ranking[0]] < 1.5 * min(errors.values())
    # The trial has none of the outliers, so the windows suit the noise.
    assert errors["savitzky-golay"] < 0.05
