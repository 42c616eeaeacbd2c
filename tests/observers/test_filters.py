"""Baselines against the same thing written plainly: a textbook Kalman filter, and the filters of scipy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from covariant.observers import FilteredDerivative, SavitzkyGolay, run
from covariant.signals import Record

RANDOM = np.random.default_rng(0)
STAMPS = jnp.asarray(np.cumsum(np.concatenate([[0.0], RANDOM.uniform(1e-3, 4e-3, 300)])))


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


def test_a_filtered_derivative_finds_a_ramp_at_its_own_pace_whatever_the_stamps():
    """From rest, the velocity after a step of the slope is (1 − exp(−ωt)) times it, at every measurement."""
    t = np.asarray(STAMPS)
    y = 3.0 * t[:, None] - 1
    y[4:200:5] = np.nan
    v = np.asarray(run(FilteredDerivative(40.0), Record(t, np.zeros((len(t), 0)), y)).estimate)[:, 1]
    seen = np.isfinite(y[:, 0])
    np.testing.assert_allclose(v[seen], 3.0 * -np.expm1(-40.0 * t[seen]), rtol=0, atol=1e-10)
    assert (v[~seen] == v[np.flatnonzero(~seen) - 1]).all()


@pytest.mark.parametrize(("window", "order"), [(4, 1), (7, 3), (25, 3)])
def test_polynomials_of_its_order_are_exact_once_the_window_is_full(window, order):
    t = np.asarray(STAMPS) * 10
    shape = np.polynomial.Polynomial(np.random.default_rng(order).normal(size=order + 1))
    x = np.asarray(run(SavitzkyGolay(window, order), Record(t, np.zeros((len(t), 0)), shape(t)[:, None])).estimate)
    full = slice(window, None)
    scale = np.abs(shape.deriv()(t)).max()
    np.testing.assert_allclose(x[full, 0], shape(t)[full], rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(x[full, 1], shape.deriv()(t)[full], rtol=0, atol=1e-4 * scale)


@pytest.mark.parametrize(("window", "order"), [(3, 3), (2, 2), (5, 0)])
def test_a_window_must_be_longer_than_the_order(window, order):
    with pytest.raises(ValueError, match=f"window {window} must exceed order {order}"):
        SavitzkyGolay(window, order)
