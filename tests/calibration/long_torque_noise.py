"""What takes long of `test_torque_noise.py`."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from test_torque_noise import FILE, TORQUES

import covariant
from covariant import models, observers
from covariant.calibration import DataSheet, tuned_estimators
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.inputs import Job, load


@pytest.fixture(scope="module")
def log():
    return covariant.simulate(
        "pendulum_chain", duration=1.0, rate=50.0, noise=1e-3, q0=[1.0, 2.0], overrides=FILE
    ).record


def by_hand(q):
    """The density of noise that is independent at each of 50 samples a second, std²/50, and the inertia by a matrix."""
    inverse = np.linalg.inv(np.asarray(models.pendulum_chain((1.0, 0.7), (0.5, 0.4)).metric(q)))
    return (0.1**2 * np.eye(2) + inverse @ np.diag(TORQUES**2) @ inverse) / 50.0


@pytest.mark.exhaustive
def test_a_model_file_is_the_same_as_a_function_by_hand(log):
    loaded = load(Job("pendulum_chain", log, FILE))
    tuned: dict[str, Any] = tuned_estimators(
        loaded.model, 2, log_sheet(loaded.file, loaded), loaded.rate, names=("intrinsic-kalman", "ukf")
    )
    for q in ([1.0, 2.0], [-0.5, 0.3]):
        for filter_ in tuned.values():
            np.testing.assert_allclose(filter_.process_cov(jnp.array(q)), by_hand(jnp.array(q)), rtol=1e-9)


@pytest.mark.exhaustive
def test_on_a_mass_it_is_an_acceleration():
    """σ on a mass of 2 kg is σ/2 of acceleration, and adds to it by squares, correlated over the same time."""
    mass = models.Lagrangian(lambda q: 2.0 * jnp.eye(1), coordinates=("x",), units=("m",))
    sheet = DataSheet(1e-3, 0.3, correlation_time=0.2, torque_std=0.8)
    one: Any = tuned_estimators(mass, 1, sheet, 100.0, names=("intrinsic-kalman",))["intrinsic-kalman"]
    density = np.array([[2 * 0.2 * (0.3**2 + 0.4**2)]])
    np.testing.assert_allclose(one.process_cov(jnp.zeros(1)), density)
    t = np.linspace(0.0, 0.5, 51)
    log = covariant.Record(t, np.zeros((51, 1)), 1e-3 * np.random.default_rng(0).normal(size=(51, 1)))
    other = observers.IntrinsicKalman(mass, jnp.asarray(density), one.measurement_cov, one.initial_velocity_cov)
    ours, theirs = (observers.run(each, log) for each in (one, other))
    np.testing.assert_allclose(ours.estimate, theirs.estimate, atol=1e-12)
    np.testing.assert_allclose(ours.info.velocity_std, theirs.info.velocity_std, rtol=1e-9)


@pytest.mark.exhaustive
def test_filters_with_constant_noise_say_that_they_do_not_use_it(log):
    result = covariant.estimate("pendulum_chain", log, observer="ekf", overrides=FILE, engine="jax")
    assert "It does not use the torque of [uncertainty]; intrinsic-kalman and ukf do." in str(result)
