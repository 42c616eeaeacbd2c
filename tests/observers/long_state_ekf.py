"""What takes long of `test_state_ekf.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from plants import kalman, van_loan
from test_state_ekf import LINEAR, SPREAD, START, A, C, Q, R

from covariant.observers import StateEKF, run
from covariant.signals import Record, StepCode

FILTER = StateEKF(LINEAR, jnp.asarray(Q), jnp.asarray(R), jnp.asarray(START), jnp.asarray(SPREAD))


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.005, 0.015, 300))
    y = rng.multivariate_normal([0, 0], R, 300) + np.sin(2 * t)[:, None]
    y[40:45, 0] = np.nan
    y[100:110] = np.nan
    return Record(t, np.cos(t)[:, None], y)


def textbook(record):
    """Estimates and deviations of the Kalman filter with exact transition and noise of each step."""
    steps = []
    for h, u in zip(np.diff(record.t), record.u, strict=False):
        flow, added = van_loan(A, Q, h)
        held = np.linalg.solve(A, (flow - np.eye(2)) @ [0.0, 1.0])
        steps.append((flow, held * u[0], added))
    # Nothing is read before the first row.
    still = np.eye(2), np.zeros(2), np.zeros((2, 2))
    y = np.concatenate([np.full((1, 2), np.nan), record.y])
    means, covs = kalman(START, SPREAD, [still, *steps], y, C, R)
    return means[1:], np.sqrt(np.diagonal(covs[1:], axis1=1, axis2=2))


@pytest.mark.exhaustive
def test_it_is_the_kalman_filter_on_a_linear_system(record):
    done, (means, stds) = run(FILTER, record), textbook(record)
    np.testing.assert_allclose(done.estimate, means, rtol=0, atol=1e-4)
    np.testing.assert_allclose(done.info.state_std, stds, rtol=1e-4)
    codes = np.asarray(done.info.result)
    assert (codes[100:110] == StepCode.COASTED).all()
    assert (codes[110:] == StepCode.OK).all()
    assert 0.5 < np.mean(np.asarray(done.info.nis)[150:]) / 2 < 3.0


def test_an_outlier_is_refused_and_one_that_stays_is_believed(record):
    y = record.y.copy()
    y[200, 0] += 50.0
    clean, spoiled = run(FILTER, record), run(FILTER, record._replace(y=y))
    assert int(spoiled.info.result[200]) == StepCode.OUTLIER
    np.testing.assert_allclose(spoiled.estimate[200:], clean.estimate[200:], rtol=0, atol=0.1)
    y[200:, :] += [50.0, 25.0]
    assert StepCode.RESTARTED in np.asarray(run(FILTER, record._replace(y=y)).info.result)
