"""What takes long of `test_constant_gains.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_constant_gains import RECORD, TRUE, T, _gains, stationary

from covariant.calibration import predict_sampled_errors
from covariant.calibration.identification import NoiseLevels, Unknowns, mean_square, stretch
from covariant.calibration.identification._error_model import ErrorModel, error_model, from_later, kalman, smoothed
from covariant.calibration.tuning._constant_gains import as_poles
from covariant.models import Motion, oscillator
from covariant.observers import Intrinsic, run
from covariant.signals import Record


def test_the_gain_of_the_error_filter_is_that_of_the_stationary_design():
    """Of a free mass both are the same Kalman filter."""
    mass = oscillator(stiffness=1e-9)
    record = Record(T, np.zeros((400, 1)), np.zeros((400, 1)))
    t, u, y = (jnp.asarray(each) for each in record[:3])
    rows = stretch(t, y, u, Motion(jnp.zeros((400, 1)), jnp.zeros((400, 1))))
    errors = error_model(Unknowns.none(mass), jnp.zeros(0), rows.start, rows, 1)
    noise = NoiseLevels(jnp.asarray(0.3), jnp.array([1e-3]), jnp.asarray(0.0))
    filtered = kalman(errors, noise, 1.0)
    np.testing.assert_allclose(filtered.gain[-1], stationary(1e-3, 0.09, 50.0), rtol=1e-4)
    k1, k2 = stationary(1e-3, 0.09, 50.0)
    best = predict_sampled_errors(*_gains(as_poles(k1, k2, 50.0)), 50.0, 1e-3, 0.09)
    assert float(filtered.velocity_std[-1, 0]) == pytest.approx(best.velocity_std, rel=1e-4)


def plainly_smoothed(system, noise, start):
    """The smoother of Rauch, Tung & Striebel as in textbooks, with inverses: estimates (T, 6) of a system of n = 2."""
    before, after, steps = [], [], []
    for k in range(len(system.dt)):
        whole, defect, added = _plain_step(system, noise, k)
        x, cov = np.zeros(6), start
        if not system.fresh[k]:
            x = whole @ after[-1][0] + defect
            cov = whole @ after[-1][1] @ whole.T + added
        before.append((x, cov))
        seen = np.flatnonzero(system.present[k])
        pick, variance = np.eye(6)[seen], np.diag(np.asarray(noise.measurement)[seen] ** 2)
        gain = cov @ pick.T @ np.linalg.inv(pick @ cov @ pick.T + variance)
        after.append((x + gain @ (np.asarray(system.residual[k])[seen] - pick @ x), cov - gain @ pick @ cov))
        steps.append(whole)
    smooth = [after[-1][0]]
    for k in reversed(range(len(after) - 1)):
        back = after[k][1] @ steps[k + 1].T @ np.linalg.inv(before[k + 1][1])
        missed = smooth[0] - before[k + 1][0]
        smooth.insert(0, after[k][0] + (0.0 if system.fresh[k + 1] else back @ missed))
    return np.array(smooth)


def test_the_smoother_of_errors_is_that_of_rauch_tung_and_striebel():
    rng, count = np.random.default_rng(0), 60
    present, fresh, dt = rng.random((count, 2)) < 0.8, np.isin(np.arange(count), (0, 25)), np.full(count, 0.1)
    system = ErrorModel(
        jnp.asarray(np.eye(4) + 0.1 * rng.normal(size=(count, 4, 4))),
        jnp.asarray(0.1 * rng.normal(size=(count, 4))),
        jnp.zeros((count, 4, 0)),
        jnp.asarray(np.pad(rng.normal(size=(count, 2, 2)), ((0, 0), (2, 0), (0, 0)))),
        *_driven(count),
        jnp.asarray(np.where(present, 0.3 * rng.normal(size=(count, 2)), 0.0)),
        jnp.asarray(present),
        jnp.asarray(dt),
        jnp.asarray(fresh),
    )
    noise = NoiseLevels(jnp.asarray(0.5), jnp.array([0.3, 0.4]), jnp.asarray(0.7))
    expected = plainly_smoothed(system, noise, np.diag([0.09, 0.16, 1.0, 1.0, 0.49, 0.49]))
    np.testing.assert_allclose(smoothed(system, noise, 1.0), expected, atol=1e-12)


def test_the_estimate_from_later_rows_is_that_of_least_squares():
    """Of position, velocity and force at a row, observed by the rows after it, with nothing known before."""
    system, noise = _random_system(12), NoiseLevels(jnp.asarray(0.5), jnp.array([0.3, 0.4]), jnp.asarray(0.7))
    at, count = 3, 12
    # x_k = A x_at + b + Σ added noise; all rows after `at` together have the covariance below.
    maps, offsets, covs = [np.eye(6)], [np.zeros(6)], [[np.zeros((6, 6))]]
    for k in range(at + 1, count):
        whole, defect, added = _plain_step(system, noise, k)
        maps.append(whole @ maps[-1])
        offsets.append(whole @ offsets[-1] + defect)
        crossed = [whole @ each for each in covs[-1]]  # cov(x_k, x_j)
        covs.append([*crossed, whole @ covs[-1][-1] @ whole.T + added])
    pick = np.eye(6)[:2]
    rows = range(1, len(maps))
    design = np.concatenate([pick @ maps[k] for k in rows])
    seen = np.concatenate([np.asarray(system.residual[at + k]) - offsets[k][:2] for k in rows])
    blocks = [[pick @ (covs[i][j] if j <= i else covs[j][i].T) @ pick.T for j in rows] for i in rows]
    cov = np.block(blocks) + np.kron(np.eye(len(rows)), np.diag(np.asarray(noise.measurement) ** 2))
    weighted = design.T @ np.linalg.inv(cov)
    expected_cov = np.linalg.inv(weighted @ design)
    expected = expected_cov @ weighted @ seen
    estimate, std = from_later(system, noise, 1e3)
    np.testing.assert_allclose(estimate[at], expected[:4], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(std[at], np.sqrt(np.diag(expected_cov))[2:4], rtol=1e-4)


def _driven(count):
    """Which errors a force drives, that none walks, and which readings show: velocities and positions of n = 2."""
    driven, shows = jnp.tile(jnp.arange(4) >= 2, (count, 1)), jnp.tile(jnp.eye(2, 4), (count, 1, 1))
    return driven, *jnp.zeros((2, count, 4)), shows, jnp.zeros((count, 2, 0))


def _random_system(count):
    rng = np.random.default_rng(1)
    return ErrorModel(
        jnp.asarray(np.eye(4) + 0.1 * rng.normal(size=(count, 4, 4)) + 0.3 * np.eye(4, k=2)),
        jnp.asarray(0.1 * rng.normal(size=(count, 4))),
        jnp.zeros((count, 4, 0)),
        jnp.asarray(np.pad(np.eye(2) + 0.3 * rng.normal(size=(count, 2, 2)), ((0, 0), (2, 0), (0, 0)))),
        *_driven(count),
        jnp.asarray(0.3 * rng.normal(size=(count, 2))),
        jnp.ones((count, 2), bool),
        jnp.full(count, 0.3),
        jnp.arange(count) == 0,
    )


def _plain_step(system, noise, k):
    """Transition, defect and added covariance of the step to row k, for a random walk of the force."""
    h, push, step = float(system.dt[k]), np.asarray(system.input_matrix[k]), np.asarray(system.transition[k])
    whole, added, driven = np.eye(6), np.zeros((6, 6)), np.diag([0.0, 0.0, 1.0, 1.0])
    whole[:4, :4], whole[:4, 4:] = step, h * (push + step @ push) / 2
    between = (np.eye(4) + step) / 2
    white = h / 6 * (driven + 4 * between @ driven @ between.T + step @ driven @ step.T)
    added[:4, :4], added[4:, 4:] = float(noise.acceleration) ** 2 * white, float(noise.force) ** 2 * h * np.eye(2)
    return whole, np.append(system.defect[k], [0.0, 0.0]), added
