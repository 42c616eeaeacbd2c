"""An encoder that begins anew is read as one that goes on, by every verb and by the exported code: what takes long."""

import importlib
import sys

import numpy as np
import pytest
from test_period import MODEL, whole

import covariant
from covariant.observers import FilteredDerivative, Unwrapped, run
from covariant.signals import Record

PERIOD = 2 * np.pi / 10


STATED = MODEL | {"measurement.period": PERIOD}


@pytest.fixture(scope="module")
def wrapped(whole):
    return whole._replace(y=np.asarray(whole.y) % PERIOD)


@pytest.mark.exhaustive
@pytest.mark.parametrize("part", [{}, {"every": 8}, {"start": 1.0, "until": 3.0}])
def test_estimates_are_those_of_the_unwrapped_log(whole, wrapped, part):
    whole = whole._replace(y=whole.y + (wrapped.y - whole.y)[:1])
    for verb in (covariant.estimate, covariant.smooth):
        arguments = {"observer": "joint-kalman", "anyway": True, **part}
        one = verb("pendulum_chain", whole, overrides=MODEL, **arguments)
        other = verb("pendulum_chain", wrapped, overrides=STATED, **arguments)
        np.testing.assert_allclose(other.velocity, one.velocity, atol=1e-9)


@pytest.mark.exhaustive
def test_check_asks_for_the_period_and_for_nothing_once_it_is_stated(whole, wrapped):
    # The angle in which gravity acts is that of the first reading.
    log = wrapped._replace(y=(whole.y - whole.y[0] + 0.3) % PERIOD)
    bare = MODEL | {"parameters.gravity": 0.0, "uncertainty.acceleration": 50.0}
    found = covariant.check("pendulum_chain", log, overrides=bare)
    assert found.findings[0].line == "[measurement] period = 0.628318531"
    stated = covariant.check("pendulum_chain", log, overrides=bare | {"measurement.period": PERIOD})
    assert "period" not in [each.what for each in stated.findings]


def test_exported_code_follows_the_readings_as_they_are(wrapped, tmp_path, monkeypatch):
    arguments = {"observer": "intrinsic", "overrides": STATED, "rate": 250.0}
    covariant.export("pendulum_chain", tmp_path / "c", python=True, name="geared", **arguments)
    monkeypatch.syspath_prepend(str(tmp_path / "c" / "python"))
    module = importlib.import_module("geared")
    velocities = np.asarray(module.run(wrapped.t, wrapped.y, wrapped.u).v)[:, 0]
    sys.modules.pop("geared")
    expected = covariant.estimate("pendulum_chain", wrapped, observer="intrinsic", overrides=STATED, anyway=True)
    np.testing.assert_allclose(velocities[100:], np.asarray(expected.velocity)[100:, 0], atol=1e-2)


def test_a_reading_counts_as_the_one_nearest_to_the_prediction():
    t = np.arange(0.0, 2.0, 0.01)
    ramp = np.stack([3.0 * t, 0.5 - 2.0 * t], axis=1)
    ramp[40:44] = np.nan  # a hole in which the first one goes on by less than half a period
    readings = np.stack([ramp[:, 0] % 0.5, ramp[:, 1]], axis=1)
    one = run(FilteredDerivative(50.0), Record(t, y=ramp)).estimate
    other = run(Unwrapped(FilteredDerivative(50.0), (0.5, 0.0)), Record(t, y=readings)).estimate
    np.testing.assert_allclose(other, one, atol=1e-9)
    with pytest.raises(ValueError, match="periods must be finite"):
        Unwrapped(FilteredDerivative(50.0), (-1.0,))
