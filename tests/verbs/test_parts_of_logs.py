"""A verb that reads a part of a log: what acts in its rows is known from all of it."""

import numpy as np
import pandas
import pytest

import covariant
from covariant.signals import acting_inputs, lag_inputs
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.inputs import Job, load

NOISE = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.05, "uncertainty.correlation_time": 0.01}


def table(**changes) -> pandas.DataFrame:
    settings = {"duration": 6.0, "rate": 500.0, "q0": [1.0], "amplitude": [5.0], "frequency": 2.0, "noise": 1e-4}
    return covariant.simulate("oscillator", **settings | changes).to_pandas()


LOG = table()


@pytest.mark.core(4)
@pytest.mark.parametrize("between", ["held", "linear"])
@pytest.mark.parametrize("part", [{"start": 2.03}, {"every": 7}, {"every": 5, "start": 1.0, "until": 3.0}])
@pytest.mark.parametrize("acts", [{}, {"inputs.delay": 0.15}, {"inputs.delay": 0.0305, "inputs.lag": 0.08}])
def test_inputs_before_and_between_the_rows_act_in_them(between, part, acts):
    overrides = NOISE | acts | {"inputs.between": between}
    whole = load(Job("oscillator", LOG, overrides, anyway=True), score=False).record
    loaded = load(Job("oscillator", LOG, overrides, anyway=True, **part), score=False)
    t, u = np.asarray(whole.t), np.asarray(whole.u)[:, 0]
    impulse = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
    at = np.searchsorted(t, loaded.record.t)
    np.testing.assert_allclose(
        np.asarray(loaded.record.u)[:-1, 0], np.diff(impulse[at]) / np.diff(t[at]), rtol=0, atol=1e-9
    )
    fitted = aligned(Job("oscillator", LOG, overrides, anyway=True, **part))
    np.testing.assert_allclose(fitted.loaded.record.u, loaded.record.u, rtol=0, atol=1e-12)


def test_rows_as_they_are_keep_their_inputs_to_the_last_bit():
    record = load(Job("oscillator", LOG, NOISE, anyway=True), score=False).record
    part = record._replace(t=record.t[100:300], u=record.u[100:300], y=record.y[100:300])
    assert np.array_equal(acting_inputs(record, rows=part).u, record.u[100:300])
    assert acting_inputs(record) is record
    assert lag_inputs(record, 0.0) is record


@pytest.mark.parametrize("part", [{"until": 1.0}, {"start": 1.0}, {"every": 3}, {}])
def test_units_of_each_input_and_a_part_of_the_log(part):
    t = np.arange(0.0, 3.0, 0.01)
    arm = pandas.DataFrame({"t": t, "q1": np.sin(t), "q2": np.cos(t), "u1": 1e3 * np.sin(t), "u2": np.cos(t)})
    job = Job("pendulum_chain", arm, {"units.u": ["mN m", "N m"]}, anyway=True, **part)
    loaded = load(job)
    rows = np.searchsorted(t, loaded.record.t)
    np.testing.assert_allclose(loaded.log.record.u, np.stack([np.sin(t), np.cos(t)], axis=1)[rows], atol=1e-12)
