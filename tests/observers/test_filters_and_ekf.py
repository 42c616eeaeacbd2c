"""Baselines against the same thing written plainly: a textbook Kalman filter, and the filters of scipy."""

import jax.numpy as jnp
import numpy as np
from scipy import linalg, signal

from covariant import models
from covariant.observers import EKF, FilteredDerivative, SavitzkyGolay, run
from covariant.signals import Record

RANDOM = np.random.default_rng(0)
STAMPS = jnp.asarray(np.cumsum(np.concatenate([[0.0], RANDOM.uniform(1e-3, 4e-3, 300)])))


def test_ekf_is_the_textbook_filter_on_a_linear_system():
    stiffness, process, noise, dt = 4.0, 0.5, 1e-4, 0.01
    model = models.oscillator(stiffness=stiffness)
    t = jnp.arange(60.0) * dt
    y = jnp.sin(2 * t)[:, None] + 0.01 * jnp.asarray(RANDOM.normal(size=(60, 1)))
    observer = EKF(model, process * jnp.eye(1), noise * jnp.eye(1), substeps=20)
    found = np.asarray(run(observer, Record(t, jnp.zeros((60, 1)), y)).estimate)

    transition = linalg.expm(np.array([[0.0, 1.0], [-stiffness, 0.0]]) * dt)
    added = process * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    x, cov, output = np.array([float(y[0, 0]), 0.0]), np.diag([noise, 1.0]), np.array([[1.0, 0.0]])
    for k in range(1, 60):  # the first measurement is what the filter starts from
        x, cov = transition @ x, transition @ cov @ transition.T + added
        gain = cov @ output.T / (output @ cov @ output.T + noise)
        x, cov = x + (gain * (float(y[k, 0]) - x[0]))[:, 0], (np.eye(2) - gain @ output) @ cov
        assert np.allclose(found[k], x, atol=1e-8)


def test_filters_agree_with_scipy_on_regular_stamps():
    dt, w = 0.01, 25.0
    t = np.arange(80) * dt
    y = np.sin(3 * t)[:, None]
    record = Record(jnp.asarray(t), jnp.zeros((80, 0)), jnp.asarray(y))
    derivative = np.asarray(run(FilteredDerivative(w), record).estimate)[:, 1]
    k = 1 - np.exp(-w * dt)
    expected = signal.lfilter([k], [1, k - 1], np.diff(y[:, 0], prepend=y[0, 0]) / dt)
    assert np.allclose(derivative, expected, atol=1e-12)
    slope = np.asarray(run(SavitzkyGolay(11, 2), record).estimate)[:, 1]
    weights = signal.savgol_coeffs(11, 2, deriv=1, delta=dt, pos=10, use="dot")
    windows = np.lib.stride_tricks.sliding_window_view(y[:, 0], 11)
    assert np.allclose(slope[10:], windows @ weights, atol=1e-6)


def test_filters_are_exact_on_what_they_model_at_irregular_stamps():
    t = np.asarray(STAMPS)
    y = np.stack([2 * t + 1, -t], axis=1)
    y[5:200:7] = np.nan
    ramp = Record(STAMPS, jnp.zeros((len(t), 0)), jnp.asarray(y))
    assert np.allclose(run(FilteredDerivative(80.0), ramp).estimate[-1], [y[-1, 0], y[-1, 1], 2.0, -1.0], atol=1e-6)
    curve = ramp._replace(y=jnp.asarray(y**2))
    expected = [y[-1, 0] ** 2, y[-1, 1] ** 2, 4 * y[-1, 0], 2 * t[-1]]
    assert np.allclose(run(SavitzkyGolay(15, 2), curve).estimate[-1], expected, atol=1e-5)
