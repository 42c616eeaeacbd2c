"""The verb `smooth`: a table with the filter beside it, what it refuses, and what it prints: what takes long."""

import json

import numpy as np
import pytest
from commands import command
from test_smooth_verb import NOISE, smoothed, swing

import covariant


@pytest.mark.exhaustive
def test_it_is_nearer_to_the_truth_than_the_filter_and_says_so(smoothed):
    result, _ = smoothed
    table, summary = result.columns, result.summary
    assert list(table) == ["t", "q1", "v1", "v1_std", "q1_std", "v1_filtered", "v1_filtered_std"]
    assert result.units["q1_std"] == "m"
    assert result.units["v1_filtered_std"] == "m/s"
    assert summary["velocity_rmse"][0] < 0.8 * summary["filter"]["velocity_rmse"][0]
    assert summary["velocity_std"][0] < summary["filter"]["velocity_std"][0]
    assert (table["v1_std"] <= table["v1_filtered_std"]).all()
    assert json.dumps(summary)
    text = str(result)
    assert "smoothed from all rows" in text
    assert "velocity RMSE of the filter" in text


@pytest.mark.exhaustive
def test_the_page_shows_both(smoothed):
    page = smoothed[0]._page()
    assert list(page.estimates) == ["smoothed", "intrinsic-kalman"]
    after, before = page.rows
    assert list(after) == list(before) == ["estimator", "RMSE v1 [m/s]", "median std v1 [m/s]"]
    assert after["RMSE v1 [m/s]"] < before["RMSE v1 [m/s]"]
    assert after["median std v1 [m/s]"] < before["median std v1 [m/s]"]


@pytest.mark.exhaustive
def test_the_filter_beside_it_is_what_estimate_returns(smoothed):
    result, log = smoothed
    filtered = covariant.estimate("oscillator", log, observer="intrinsic-kalman", overrides=NOISE, engine="jax")
    np.testing.assert_allclose(result.filtered.velocity, filtered.velocity, rtol=0, atol=1e-10)
    np.testing.assert_allclose(result.filtered.velocity_std[1:], filtered.velocity_std[1:], rtol=1e-9)


@pytest.mark.exhaustive
def test_a_state_space_model_is_smoothed_by_its_filter():
    log = covariant.simulate("duffing", duration=2.0, rate=50.0, noise=1e-2, seed=2).record
    noise = {"measurement.std": 1e-2, "uncertainty.process": 0.1}
    result = covariant.smooth("duffing", log, overrides=noise, lag=0.2)
    assert result.smoothed.observer_name == "covariance-ekf"
    assert result.lag == 10
    assert "smoothed from 10 rows after each" in str(result)
    assert (result.velocity_std <= result.filtered.velocity_std + 1e-12).all()


@pytest.mark.exhaustive
def test_the_command_writes_the_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    swing().save("log.csv")
    options = [f"--set={key}={value}" for key, value in NOISE.items()]
    assert command("smooth", "oscillator", "log.csv", "-o", "s.csv", "--lag", "0.1", *options)["lag_rows"] == 10
    assert (tmp_path / "s.csv").read_text().splitlines()[0] == "t,q1,v1,v1_std,q1_std,v1_filtered,v1_filtered_std"
