"""Candidates for constant gains, which of them is taken, and forces that are forgotten."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from covariant.calibration import predict_sampled_errors
from covariant.calibration.identification._error_model import (
    forgotten,
)
from covariant.calibration.tuning._constant_gains import as_poles, chosen, sampled_design
from covariant.models import Motion
from covariant.observers import external_force
from covariant.observers.base._sampled import sampled_gains
from covariant.observers.sensors._slow import SlowStates
from covariant.signals import Record

T = 0.02 * np.arange(400)
RECORD = Record(T, np.zeros((400, 1)), np.cos(T)[:, None])
TRUE = Motion(jnp.cos(T)[:, None], -jnp.sin(T)[:, None])


@pytest.mark.parametrize("frequency", [0.5, 20.0, 60.0])
@pytest.mark.parametrize("damping", [0.3, 0.999, 1.0, 2.0])
def test_gains_of_a_sample_lead_back_to_frequency_and_damping(frequency, damping):
    k1, k2 = sampled_gains(2 * damping * frequency, frequency**2, 0.01)
    found = as_poles(float(k1), float(k2), 100.0)
    np.testing.assert_allclose(found, (frequency, damping), rtol=1e-4)


def stationary(std, density, rate):
    """Gains of the stationary Kalman filter of a double integrator, by a Riccati equation."""
    h, flow = 1 / rate, np.array([[1.0, 1 / rate], [0.0, 1.0]])
    white = density * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    cov = solve_discrete_are(flow.T, np.eye(2)[:, :1], white, np.full((1, 1), std**2))
    return cov[:, 0] / (cov[0, 0] + std**2)


@pytest.mark.parametrize(("std", "density", "rate"), [(1e-3, 0.1, 100.0), (2e-3, 0.01, 20.0), (1e-4, 1e-3, 1000.0)])
def test_the_sampled_design_is_the_stationary_kalman_filter(std, density, rate):
    frequency, damping = sampled_design(std, density, rate)
    k1, k2 = stationary(std, density, rate)
    best = as_poles(k1, k2, rate)
    np.testing.assert_allclose((frequency, damping), best, rtol=0.05)
    errors = [
        predict_sampled_errors(*_gains(each), rate, std, density).velocity_std for each in (best, (frequency, damping))
    ]
    assert errors[0] <= errors[1] < 1.001 * errors[0]


def _gains(poles):
    return 2 * poles[0] * poles[1], poles[0] ** 2


def taken(slack=1.0, **errors):
    """The source that is taken, by pairs of errors against later rows and against the smoother, with their scatter."""
    random, rows = np.random.default_rng(0), 4000
    shared = random.normal(size=rows)  # the error of the estimate from later rows
    squares = [
        [np.stack([(later * random.normal(size=rows) + shared) ** 2, np.full(rows, smooth**2)], axis=1)]
        for later, smooth in errors.values()
    ]
    names = {name.replace("_", " "): (1.0, 1.0, 0.0) for name in errors}
    return chosen(names, squares, slack)[1].source


def test_what_is_clearly_farther_from_what_later_rows_tell_is_never_taken():
    assert taken(model_file=(1.0, 1.0), rule=(1.5, 0.5), later_rows=(1.6, 0.5)) == "model file"
    assert taken(model_file=(2.0, 1.0), rule=(1.9, 1.0), later_rows=(1.0, 2.0)) == "later rows"


def test_equal_ones_are_ordered_by_the_smoother_and_then_the_model_file_comes_first():
    assert taken(model_file=(1.0, 1.1), rule=(1.0, 1.0), later_rows=(1.0, 1.2)) == "rule"
    assert taken(later_rows=(1.0, 1.0), rule=(1.0, 1.0), model_file=(1.0, 1.0)) == "model file"
    assert taken(later_rows=(1.0, 1.0), rule=(1.0, 1.0), sampled_design=(1.0, 1.0)) == "sampled design"


def test_within_the_slack_the_smoother_decides():
    assert taken(later_rows=(1.0, 1.1), rule=(1.1, 1.0)) == "later rows"
    assert taken(1.1, later_rows=(1.0, 1.1), rule=(1.1, 1.0)) == "rule"
    assert taken(1.1, later_rows=(1.0, 1.1), rule=(2.0, 1.0)) == "later rows"


@pytest.mark.parametrize("time", [0.05, 3.0])
def test_a_force_is_forgotten_as_by_the_observers(time):
    slow, h = SlowStates((external_force(std=2.0, time=time),)), jnp.asarray(0.02)
    mean, decay, added = forgotten(h, time)
    means, ends = slow.advanced(jnp.zeros(1), jnp.ones(1), h)
    np.testing.assert_allclose([mean, decay], [means[0], ends[0]], rtol=1e-12)
    assert float(4 * added) == pytest.approx(float(slow.walk_root(jnp.zeros(1), h)[0, 0] ** 2), rel=1e-9)


def test_a_force_without_a_time_is_a_random_walk():
    np.testing.assert_array_equal(forgotten(jnp.asarray(0.02), jnp.inf), (1.0, 1.0, 0.02))
    np.testing.assert_array_equal(forgotten(jnp.asarray(0.0), 1.0), (1.0, 1.0, 0.0))
