"""A log with holes: verbs name them, tell errors with and without them, and are not decided by them unsaid."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant.models import Motion, advance, pendulum_chain
from covariant.scoring import find_holes
from covariant.signals import MOST_MISSING, Record, acting_inputs, lag_inputs
from covariant.verbs import MisfitError
from covariant.verbs.base.inputs import _around_missing

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
