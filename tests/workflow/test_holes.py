"""A log with holes: verbs name them, tell errors with and without them, and are not decided by them unsaid."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant.models import Motion, advance, pendulum_chain
from covariant.observers import EKF, run
from covariant.scoring import find_holes
from covariant.signals import MOST_MISSING, Record, StepCode, acting_inputs, lag_inputs
from covariant.workflow import MisfitError
from covariant.workflow._inputs import _around_missing

pandas = pytest.importorskip("pandas")
MODEL = {
    "parameters.mass": [1.0],
    "parameters.length": [1.0],
    "parameters.viscous": [0.1],
    "columns.q": ["q"],
    "columns.u": ["u"],
    "columns.truth": ["v"],
    "measurement.std": 1e-3,
    "uncertainty.acceleration": 0.1,
}
HOLES = ((4.0, 4.25), (8.0, 8.25))


@functools.cache
def motion() -> Any:
    """A pendulum that is driven hard, every cell known."""
    t, rng = np.arange(0.0, 12.0, 0.01), np.random.default_rng(3)
    u = sum(3.0 * np.sin(2 * np.pi * f * t + p) for f, p in ((0.31, 0.4), (0.83, 2.0), (1.37, 4.0)))[:, None]
    model = pendulum_chain((1.0,), (1.0,), viscous=(0.1,))

    @jax.jit
    def go(u):
        def step(motion, u):
            later = advance(model, 0.0, Motion(*motion), u, 0.01, 4)
            return (later.q, later.v), motion

        return jax.lax.scan(step, (jnp.zeros(1), jnp.zeros(1)), u)[1]

    q, v = map(np.asarray, go(u))
    return pandas.DataFrame({"t": t, "q": q[:, 0] + 1e-3 * rng.normal(size=len(t)), "u": u[:, 0], "v": v[:, 0]})


def with_holes(cells: bool, readings_only: bool = False) -> Any:
    frame = motion().copy()
    rows = np.any([(frame.t > a + 1e-9) & (frame.t < b - 1e-9) for a, b in HOLES], axis=0)
    if not cells:
        return frame[~rows]
    frame.loc[rows, ["q"] if readings_only else ["q", "u"]] = np.nan
    return frame


def estimate(log, observer="intrinsic-kalman", **given: Any):
    return covariant.estimate("pendulum_chain", log, observer=observer, overrides=MODEL, engine="jax", **given)


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


def test_an_input_that_is_missing_alone_is_not_said_to_be_held_where_it_is_estimated():
    frame = motion().copy()
    frame.loc[(frame.t > 4) & (frame.t < 4.25), "u"] = np.nan
    assert "an input is not finite: the last finite one was held, or the filter estimated it" in str(estimate(frame))


def test_a_log_without_holes_says_nothing_of_them():
    result = estimate(motion())
    assert "holes" not in result.summary
    assert "hole" not in str(result)
    assert not hasattr(result.run.info, "missing_input")


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


@pytest.mark.long
def test_holes_that_decide_a_ranking_are_told():
    result = covariant.compare("pendulum_chain", with_holes(cells=True), overrides=MODEL)
    text, apart = str(result), result.ranking_without_holes
    assert apart is not None
    assert set(apart) == set(result.ranking)
    assert result.summary["without_holes"] == list(apart)
    assert "RMSE dq1/dt without holes [rad/s]" in text
    assert {"v1_median_error", "v1_rmse_without_holes"} <= set(result.columns)
    assert "Errors are those of 1078 of 1200 rows, from 1.01 to 11.78 s." in text
    assert any(", ".join(apart) in warning for warning in result.warnings)
    best = result.columns["v1_rmse_without_holes"]
    assert result.ranking[int(np.argmin(best))] == apart[0]


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


def test_inputs_may_be_missing_only_where_an_estimate_runs_over_them():
    with pytest.raises(ValueError, match="only positions may be missing"):
        covariant.check("pendulum_chain", with_holes(cells=True), overrides=MODEL)
    frame = with_holes(cells=True)
    frame["u"] = np.nan
    with pytest.raises((ValueError, MisfitError), match=r"fewer than two rows have all inputs|no number"):
        estimate(frame)


def test_inputs_that_are_late_or_lag_are_missing_a_while_longer():
    t = np.arange(0.0, 2.0, 0.01)
    u = np.sin(3 * t)[:, None]
    u[100:120] = np.nan
    record = Record(t, u, np.zeros_like(u))
    late = _around_missing(lambda each: acting_inputs(each, "held", 0.025), record)
    assert np.flatnonzero(np.isnan(late.u[:, 0])).tolist() == list(range(102, 123))
    lagged = _around_missing(lambda each: lag_inputs(each, 0.02), record, MOST_MISSING)
    absent = np.flatnonzero(np.isnan(lagged.u[:, 0]))
    # Of the lagged input less than a twentieth is missing after three time constants.
    assert absent[0] in (100, 101)
    assert absent[-1] == pytest.approx(119 + 6, abs=1)
    same = record._replace(u=np.nan_to_num(record.u))
    assert _around_missing(lambda each: each, same) is same


def test_stamps_that_jitter_make_no_holes():
    rng = np.random.default_rng(0)
    t = np.cumsum(0.01 * rng.uniform(0.5, 1.5, 5000))
    everywhere = np.ones(len(t), bool)
    assert len(find_holes(t, everywhere)) == 0
    kept = rng.uniform(size=len(t)) > 0.2
    assert len(find_holes(t, kept)) < 10
    kept[1000:1030] = False
    spans = find_holes(t, kept)
    assert any(begin <= t[1000] and end >= t[1029] for begin, end in spans)


def test_a_large_model_takes_missing_inputs_as_held_and_says_so(monkeypatch):
    """Two states for each of many inputs are too many to compile."""
    monkeypatch.setattr("covariant.workflow._design.MOST_STATES", 3)
    result = estimate(with_holes(cells=False))
    assert any("intrinsic-kalman takes the last input as held" in warning for warning in result.warnings)
