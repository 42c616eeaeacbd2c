"""Noise from the smoother: its step is the slope of the likelihood, and leads to the noise of a simulated log."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import Lagrangian
from covariant.observers import EKF, IntrinsicKalman, JointKalman, noise_step, tachometer
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


def ekf(process=PROCESS, measurement=MEASUREMENT) -> EKF:
    return EKF(masses(), jnp.diag(jnp.asarray(process)), jnp.diag(jnp.asarray(measurement)), 1.0, gate=None, substeps=1)


@pytest.mark.exhaustive
def test_a_step_is_the_slope_of_the_likelihood():
    """Fisher's identity: `∂L/∂ log Q_j = K (s_j − 1)` with K steps, `∂L/∂ log R_i = N (s_i − 1)/2` with N readings."""
    first = ekf(0.5 * PROCESS, 2.0 * MEASUREMENT)
    stepped = noise_step(first, log()).observer
    readings = np.isfinite(log().y).sum(0)
    fields = {"process_cov": np.full(2, ROWS - 1.0), "measurement_cov": readings / 2}
    for name, count in fields.items():
        old, new = (np.diag(getattr(each, name)) for each in (first, stepped))
        for i in range(2):
            ends = []
            for change in (1e-3, -1e-3):
                cov = jnp.diag(jnp.asarray(old * np.exp(change * np.eye(2)[i])))
                moved = eqx.tree_at(lambda o, name=name: getattr(o, name), first, cov)
                ends.append(noise_step(moved, log()).log_likelihood)
            slope = (ends[0] - ends[1]) / 2e-3
            np.testing.assert_allclose(count[i] * (new[i] / old[i] - 1), slope, rtol=1e-4)


@pytest.mark.exhaustive
def test_steps_raise_the_likelihood_and_find_the_noise_of_a_log():
    observer, likelihoods = ekf(PROCESS * [4.0, 0.25], MEASUREMENT * [0.3, 3.0]), []
    for _ in range(40):
        observer, likelihood = noise_step(observer, log())
        likelihoods.append(likelihood)
    assert (np.diff(likelihoods) > 0).all()
    for cov, true in ((observer.process_cov, PROCESS), (observer.measurement_cov, MEASUREMENT)):
        np.testing.assert_allclose(np.sqrt(np.diag(cov) / true), 1.0, rtol=0, atol=0.2)


@pytest.mark.exhaustive
def test_a_number_is_scaled():
    """In the metric, and for all joints alike: both a size too small and one too large move towards the right one."""
    for factor in (0.25, 4.0):
        first = IntrinsicKalman(masses(), factor * 36.0, factor * 4e-4, 1.0, gate=None, substeps=1)
        new = noise_step(first, log()).observer
        for name in ("process_cov", "measurement_cov"):
            old, better = (float(getattr(each, name)) for each in (first, new))
            assert (better - old) * (1 - factor) > 0


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
