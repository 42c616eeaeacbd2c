"""What takes long of `test_holes.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_holes import MODEL, estimate, motion, with_holes

import covariant
from covariant.models import pendulum_chain
from covariant.observers import EKF, run
from covariant.signals import Record, StepCode


@pytest.mark.exhaustive
@pytest.mark.parametrize("cells", [True, False], ids=["cells", "rows"])
def test_a_hole_is_named_with_the_errors_with_and_without_it(cells):
    result = estimate(with_holes(cells))
    text, holes = str(result), result.summary["holes"]
    assert holes["count"] == 2
    assert holes["longest"] == pytest.approx(0.25)
    assert holes["total"] == pytest.approx(0.5)
    assert holes["share"] == pytest.approx(0.5 / 11.99, rel=1e-3)
    assert holes["rows_without_input"] == 48 * cells
    assert "2 holes without readings, the longest of 0.25 s (t = 4 to 4.25 s, 8 to 8.25 s), 0.5 s in all" in text
    assert "without the holes and 0.5 s after each" in text
    assert result.summary["velocity_rmse_without_holes"][0] < result.summary["velocity_rmse"][0]
    assert result.summary["velocity_rmse_in_holes"][0] > result.summary["velocity_rmse"][0]
    # No right reading is refused after a hole, and the errors are those that are told.
    assert "outlier" not in result.summary["results"]
    assert result.summary["nees"] < 3
    assert not any("NEES" in warning for warning in result.warnings)


@pytest.mark.exhaustive
def test_an_input_that_is_missing_alone_is_not_said_to_be_held_where_it_is_estimated():
    frame = motion().copy()
    frame.loc[(frame.t > 4) & (frame.t < 4.25), "u"] = np.nan
    assert "an input is not finite: the last finite one was held, or the filter estimated it" in str(estimate(frame))


@pytest.mark.exhaustive
def test_a_log_without_holes_says_nothing_of_them():
    result = estimate(motion())
    assert "holes" not in result.summary
    assert "hole" not in str(result)
    assert not hasattr(result.run.info, "missing_input")


@pytest.mark.exhaustive
def test_a_filter_that_takes_the_last_input_as_held_is_told():
    result = estimate(with_holes(cells=True), "ekf")
    assert any("ekf takes the last input as held" in warning for warning in result.warnings)
    warning = next(warning for warning in result.warnings if warning.startswith("NEES averages"))
    assert "standard deviations are too small by a factor of" in warning
    assert "in the holes of the log" in warning
    # Where only readings are lost the inputs are known, and there is nothing to say of them.
    known = estimate(with_holes(cells=True, readings_only=True), "ekf")
    assert known.summary["holes"]["count"] == 2
    assert not any("held" in warning or "NEES" in warning for warning in known.warnings)


def test_after_a_hole_readings_that_agree_are_believed():
    """A pendulum that was put elsewhere over the hole: its readings show no velocity, and agree with each other."""
    t = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(1.3, 2.0, 0.01)])
    y = np.where(t < 1.1, 0.0, 0.5)[:, None] + 1e-3 * np.random.default_rng(1).normal(size=(len(t), 1))
    # Without gravity it stays where it was put.
    model = pendulum_chain((1.0,), (1.0,), gravity=0.0)
    ekf = EKF(model, 1e-6 * jnp.eye(1), 1e-6 * jnp.eye(1), 4.0, substeps=1)
    code = StepCode
    codes = np.asarray(run(ekf, Record(t, 0 * y, y), ("result",)).info.result)
    assert codes[100:103].tolist() == [code.OUTLIER, code.OUTLIER, code.RESTARTED]
    assert (codes[103:] == code.OK).all()
    # Without a hole it is a jump, which has to stay for ten samples.
    jump = np.asarray(run(ekf, Record(0.01 * np.arange(len(t)), 0 * y, y), ("result",)).info.result)
    assert (jump[100:110] == code.OUTLIER).all()


@pytest.mark.exhaustive
def test_holes_that_decide_a_ranking_are_told():
    result = covariant.compare("pendulum_chain", with_holes(cells=True), overrides=MODEL)
    text, apart = str(result), result.ranking_without_holes
    assert apart is not None
    assert set(apart) == set(result.ranking)
    assert result.summary["without_holes"] == list(apart)
    assert "RMSE dq1/dt without holes [rad/s]" in text
    assert {"v1_median_error", "v1_rmse_without_holes"} <= set(result.columns)
    scored = result.loaded.reference.scored  # without the rows that tuned filters
    assert f"Errors are those of {scored.sum()} of 1200 rows, from " in text
    assert 500 < scored.sum() < 800
    assert any(", ".join(apart) in warning for warning in result.warnings)
    best = result.columns["v1_rmse_without_holes"]
    assert result.ranking[int(np.argmin(best))] == apart[0]


@pytest.mark.exhaustive
def test_an_innovation_is_one_of_used_rows():
    frame = motion().copy()
    frame.loc[300, "q"] += 2.0
    result = estimate(frame)
    assert result.summary["innovation_rms"][0] < 0.01
    assert result.summary["innovation_rms_refused"][0] == pytest.approx(2.0, abs=0.05)
    assert " of rows that were used, 2" in str(result)
    (refused,) = result.summary["refused"]
    assert (refused["name"], refused["rows"], refused["stayed"]) == ("q", 1, False)
    assert refused["read"] - refused["expected"] == pytest.approx(2.0, abs=0.05)
    assert f"1 reading of q at 3 s (read {refused['read']:.4g}, expected {refused['expected']:.4g} rad)" in str(result)


@pytest.mark.exhaustive
def test_a_large_model_takes_missing_inputs_as_held_and_says_so(monkeypatch):
    """Two states for each of many inputs are too many to compile."""
    monkeypatch.setattr("covariant.verbs.base.design.MOST_STATES", 3)
    result = estimate(with_holes(cells=False))
    assert any("intrinsic-kalman takes the last input as held" in warning for warning in result.warnings)
