"""The damper between constant gains and sensors of the velocity: it never expands, it is a tensor, it finds offsets."""

import jax.numpy as jnp
import numpy as np
import pytest
from plants import body, sphere_pendulum

from covariant import observers
from covariant.geometry.lie import SO3
from covariant.models import robots
from covariant.observers import Damped, Intrinsic, Sensor, damping_margin


def oblique() -> Sensor:
    """A sensor that mixes the velocities, and reads something of the position besides."""
    return Sensor("oblique", lambda now, s: now.q[:1] + now.v[:1] - 0.4 * now.q[1:] * now.v[1:], 1.0)


@pytest.fixture(scope="module")
def systems():
    """A system on each kind of space, a configuration, and its sensors."""
    arm = robots.load("double_pendulum")
    return {
        "chart": (sphere_pendulum(), jnp.array([0.9, 0.4]), (oblique(), observers.tachometer([1], 0.1, reduction=3.0))),
        "SO(3)": (body(), SO3.exp(jnp.array([0.4, -0.3, 0.8])), observers.tachometer([2, 0], 0.1)),
        "robot": (arm, jnp.array([0.4, -0.7]), observers.gyro(arm.space, "lower", 0.01)),
    }


def measurement(observer, q, readings=None):
    """Measurement of a configuration, or of none, and of readings, or of none."""
    count = observer._sensors.size
    return observer._sensors.joined(q, jnp.full(count, jnp.nan) if readings is None else readings)


def test_the_margin_is_positive_where_the_quadratic_form_decreases():
    """Against the eigenvalues of QA + AᵀQ, at random gains."""
    rng = np.random.default_rng(1)
    signs = []
    for _ in range(500):
        alpha, beta, kappa = 10 ** rng.uniform(-1, 1, 3) * [1, 1, rng.integers(2)]
        cross = rng.uniform(0, alpha)
        a, q = np.array([[-alpha, 1.0], [-beta, -kappa]]), np.array([[beta, -cross], [-cross, 1.0]])
        decreases = np.linalg.eigvalsh(q @ a + a.T @ q).max() < 0
        assert decreases == (damping_margin(alpha, beta, kappa, cross) > 0)
        assert not decreases or np.linalg.eigvalsh(q).min() > 0
        signs.append(decreases)
    assert 0.2 < np.mean(signs) < 0.8


def test_sensors_and_gains_that_make_no_sense_are_named(systems):
    model, q, _ = systems["robot"]
    inner, rate = Intrinsic(model, 4.0, 8.0), observers.tachometer([0], 0.1)
    space = model.space
    cases = [
        (lambda: Damped(observers.FilteredDerivative(5.0), rate, 1.0), "observer must be Intrinsic"),
        (lambda: Damped(inner, (), 1.0), "got none"),
        (lambda: Damped(inner, "gyro", 1.0), "one Sensor or several"),
        (lambda: Damped(inner, rate, -1.0), "damping must be a positive"),
        (lambda: Damped(inner, rate, 1.0, -1.0), "bias_gain must be a finite number, 0 or more"),
        (lambda: Damped(inner, rate, [1.0, 2.0]), "damping must be one number or 1"),
        (lambda: Damped(inner, observers.tachometer([0], 0.1, bias_std=1.0), 1.0), "leave out bias_std"),
        (lambda: Damped(inner, observers.pose_sensor(space, "lower", 1.0, 1.0), 1.0), "pose is not linear"),
    ]
    for make, words in cases:
        with pytest.raises(ValueError, match=words):
            make()
    others = [
        (observers.encoder([0], 0.1), "encoder must be linear"),
        (Sensor("square", lambda now, s: now.v[:1] ** 2, 1.0), "square must be linear"),
        (observers.accelerometer(space, "lower", 0.1), "accelerometer reads an acceleration"),
    ]
    for sensor, words in others:
        observer = Damped(inner, sensor, 1.0)
        with pytest.raises(ValueError, match=words):
            observer.init(measurement(observer, q))
    with pytest.raises(ValueError, match="then the 1 readings of tachometer"):
        Damped(inner, rate, 1.0).init(q)
