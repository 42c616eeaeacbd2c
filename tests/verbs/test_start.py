"""An estimate with constant gains starts at the motion of the first rows, and is as good after them as later."""

import numpy as np
import pytest

import covariant
from covariant.observers import run

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.02, "uncertainty.correlation_time": 0.05}
TOP = {"columns.quaternion_wxyz": ["qw", "qx", "qy", "qz"], "parameters.viscous": 0.05}
SHIP = NOISE | {"measurement.std": [1e-2, 1e-2, 5e-3], "uncertainty.acceleration": 1e-3}
CASES = {
    "oscillator": ("oscillator", {"q0": 0.4, "v0": -1.5}, NOISE, 100.0, 20.0),
    "chain": ("pendulum_chain", {"q0": [0.4, -0.7], "v0": [2.0, -3.0]}, NOISE, 200.0, 10.0),
    "top": ("heavy_top", {"v0": [0.5, 1.0, 6.0]}, NOISE | TOP, 100.0, 10.0),
    "ship": ("ship", {"v0": [1.5, -0.2, 0.1], "amplitude": [0.3, 300.0]}, SHIP, 5.0, 200.0),
}
OBSERVERS = ("intrinsic", "geodesic", "copy", "intrinsic-force")
CASES_AND_OBSERVERS = [(name, observer) for name in CASES for observer in OBSERVERS]


def estimate(name, observer):
    """A result of a simulated log, and the true velocities (T, n)."""
    model, motion, noise, rate, duration = CASES[name]
    settings = {"duration": duration, "rate": rate, "overrides": noise, "noise": noise["measurement.std"]}
    made = covariant.simulate(model, **settings, **motion)
    truth = made.summary["truth_columns"].split(",")
    result = covariant.estimate(model, made.to_pandas(), observer=observer, overrides=noise, columns={"truth": truth})
    return result, np.stack([made.columns[column] for column in truth], axis=1)


def size(error):
    return np.sqrt(np.mean(error**2, axis=0))


@pytest.mark.core(3)
@pytest.mark.parametrize(("name", "observer"), CASES_AND_OBSERVERS)
def test_errors_after_the_start_are_at_most_twice_those_of_the_rest(name, observer):
    result, truth = estimate(name, observer)
    start, error = result.outcome.start, result.velocity - truth
    assert 0 < start <= len(truth) // 3
    rest = size(error[2 * start :])
    assert (size(error[start : 2 * start]) <= 2 * rest).all()
    assert (size(error[:start]) <= 16 * rest).all()
    # From rest, as in a control loop, the same observer needs far longer.
    at_rest = run(result.outcome.driven.observer, result.loaded.record)
    slow = np.asarray(result.loaded.model.sought.of(at_rest.estimate)) - truth
    assert np.max(size(slow[:start]) / size(error[:start])) > 20
    assert result.summary["start_rows"] == start
    assert f"the first {result.t[start - 1] - result.t[0]:.3g} s determine the start" in str(result)


def test_a_filter_with_a_covariance_starts_at_rest():
    result, _ = estimate("oscillator", "intrinsic-kalman")
    assert result.outcome.start == 0
    assert "start" not in str(result)
