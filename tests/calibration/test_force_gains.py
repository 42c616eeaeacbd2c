"""Gains with an unknown force: poles of the stationary Kalman filter, their limit, and the default observer."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from covariant import models
from covariant.calibration import DataSheet, gains, observer_gains, tuned_estimators
from covariant.models import oscillator
from covariant.observers import IntrinsicForce
from covariant.verbs.base.design import design

RATE = 1e4
NOISE = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
FORCE = {"uncertainty.external_force_std": 1.0, "uncertainty.external_force_time": 0.3}


def kalman(std, acceleration, time, force, forgotten):
    """Covariance and gains of the stationary Kalman filter of position, velocity and forgotten acceleration."""
    flow = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / forgotten]])
    density, noise = np.diag([0.0, 2 * acceleration**2 * time, 2 * force**2 / forgotten]), std**2 / RATE
    cov = solve_continuous_are(flow.T, np.eye(3)[:, :1], density, np.full((1, 1), noise))
    return cov, cov[:, 0] / noise


@pytest.mark.parametrize(("force", "forgotten"), [(1.0, 0.5), (5.0, 0.2), (0.02, 2.0), (50.0, 0.05)])
def test_the_poles_are_those_of_the_kalman_filter_on_a_force_that_stays(force, forgotten):
    _, gain = kalman(1e-2, 0.1, 0.5, force, forgotten)
    poles = np.roots([1.0, *gain])
    real = poles[np.argmin(np.abs(poles.imag))].real
    pair = np.delete(poles, np.argmin(np.abs(poles.imag)))
    frequency = abs(pair[0])
    design = gains(1e-2, RATE, 0.1, 0.5, -pair.real.mean() / frequency, force_std=force, force_time=forgotten)
    found = design.alpha, design.beta, design.force_rate
    np.testing.assert_allclose(found, (-pair.real.sum(), frequency**2, -real), rtol=1e-6)


@pytest.mark.parametrize(("force", "forgotten"), [(1.0, 0.5), (5.0, 0.2), (0.02, 2.0), (50.0, 0.05)])
def test_the_velocity_error_is_near_that_of_the_kalman_filter(force, forgotten):
    cov, _ = kalman(1e-2, 0.1, 0.5, force, forgotten)
    predicted = gains(1e-2, RATE, 0.1, 0.5, force_std=force, force_time=forgotten).velocity_std / cov[1, 1] ** 0.5
    assert 1.0 <= predicted < 1.05  # of a filter that forgets the force


def test_without_a_force_the_gains_are_those_of_two_poles():
    two, three = gains(1e-3, 100.0, 0.1, 0.5), gains(1e-3, 100.0, 0.1, 0.5, force_std=1e-9, force_time=0.5)
    assert two.force_rate == 0.0
    assert three.force_rate < 1e-12
    np.testing.assert_allclose(three[:4], two[:4], rtol=1e-9)


def test_a_walk_is_the_limit_of_a_force_that_is_hardly_forgotten():
    walk = gains(1e-3, 100.0, 0.1, 0.5, force_std=1.0)
    time = 1e6
    np.testing.assert_allclose(
        gains(1e-3, 100.0, 0.1, 0.5, force_std=(time / 2) ** 0.5, force_time=time), walk, rtol=1e-5
    )


def test_numbers_of_the_file_replace_those_of_the_design():
    sheet = DataSheet(1e-3, 0.1, 0.5, external_force_std=1.0, external_force_time=0.5, damping=1.0)
    space = models.Lagrangian(lambda q: 2 * jnp.eye(1), coordinates=("x",), units=("m",)).space
    designed = observer_gains(sheet, 100.0, space)
    assert designed == gains(1e-3, 100.0, 0.1, 0.5, 1.0, force_std=0.5, force_time=0.5)
    other = observer_gains(sheet._replace(natural_frequency=50.0), 100.0, space)
    assert other.beta == 2500.0
    assert other.force_rate / 50.0 == pytest.approx(designed.force_rate / designed.beta**0.5)
    observer = tuned_estimators(oscillator(), 1, sheet._replace(force_rate=7.0), 100.0, names=("intrinsic-force",))
    assert isinstance(observer["intrinsic-force"], IntrinsicForce)
    assert float(observer["intrinsic-force"].force_rate) == 7.0
    for wrong in ({"force_std": -1.0}, {"force_rate": np.nan}, {"force_std": 1.0, "force_time": 0.0}):
        with pytest.raises(ValueError, match="gains: force_"):
            gains(1e-3, 100.0, 0.1, **wrong)


@pytest.mark.parametrize(
    ("numbers", "name"),
    [
        ({}, "intrinsic"),
        (FORCE, "intrinsic-force"),
        (FORCE | {"design.force_rate": 0.0}, "intrinsic"),
        (FORCE | {"design.natural_frequency": 30.0}, "intrinsic"),
        ({"design.force_rate": 9.0, "design.natural_frequency": 30.0}, "intrinsic-force"),
    ],
)
def test_the_default_learns_a_force_where_the_file_tells_one(numbers, name):
    designed = design(models.load("oscillator", NOISE | numbers), rate=100.0)
    assert designed.name == name
    assert ("force rate" in designed.notes) == (name == "intrinsic-force")
    assert design(models.load("oscillator", NOISE | numbers), gains={"alpha": 20.0, "beta": 200.0}).name == "intrinsic"
