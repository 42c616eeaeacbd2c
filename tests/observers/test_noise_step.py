"""Noise from the smoother: its step is the slope of the likelihood, and leads to the noise of a simulated log."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import Lagrangian
from covariant.observers import IntrinsicKalman, JointKalman, noise_step, tachometer
from covariant.signals import Record

ROWS, STEP = 1000, 0.02
PROCESS, MEASUREMENT = np.array([3.0, 9.0]) ** 2, np.array([0.01, 0.03]) ** 2
STIFFNESS = np.array([[30.0, -10.0], [-10.0, 20.0]])


@functools.cache
def masses() -> Lagrangian:
    return Lagrangian(lambda q: jnp.eye(2), lambda q: q @ jnp.asarray(STIFFNESS) @ q / 2)


@functools.cache
def log() -> Record:
    """A motion that is perturbed and read as the filter believes, with gaps of one reading or of both."""
    rng, h = np.random.default_rng(2), STEP
    rate = np.block([[np.zeros((2, 2)), np.eye(2)], [-STIFFNESS, np.zeros((2, 2))]])
    power, flow = np.eye(4), np.eye(4)
    for k in range(1, 5):  # one Runge–Kutta step
        power = power @ rate * h / k
        flow = flow + power
    states = [np.array([0.3, -0.2, 0.0, 0.0])]
    for _ in range(ROWS - 1):
        one, other = rng.normal(size=(2, 2)) * np.sqrt(h * PROCESS)
        states.append(flow @ states[-1] + np.concatenate([h * (one / 2 + other / 12**0.5), one]))
    y = np.array(states)[:, :2] + rng.normal(size=(ROWS, 2)) * np.sqrt(MEASUREMENT)
    y[100:110] = y[300:360:3, 0] = np.nan
    return Record(h * np.arange(ROWS), np.zeros((ROWS, 2)), y)


@pytest.mark.parametrize(
    ("observer", "words"),
    [
        (JointKalman(5.0, 0.1, 0.01), "JointKalman has no such noise"),
        (IntrinsicKalman(masses(), lambda q: jnp.eye(2), 1e-4, 1.0), "not functions"),
        (IntrinsicKalman(masses(), 1.0, 1e-6, 1.0, (), (0.01, 0.01)), "count ticks"),
        (IntrinsicKalman(masses(), 1.0, 1e-6, 1.0, sensors=tachometer([0], 0.1)), "sensors beside the positions"),
    ],
)
def test_what_has_no_such_noise_is_refused(observer, words):
    with pytest.raises(ValueError, match=words):
        noise_step(observer, log())
