"""Kalman filters of a linear machine against the textbook's: inputs, damping, gaps of both positions and of one."""

import jax.numpy as jnp
import numpy as np
import pytest
from plants import FIRST_COV, MEASUREMENT, POSITIONS, PROCESS, SPEED, kalman, masses, masses_steps

from covariant.observers import EKF, UKF, IntrinsicKalman
from covariant.signals import StepCode

ROWS = 120
RNG = np.random.default_rng(0)
T = np.cumsum(RNG.uniform(0.002, 0.02, ROWS))
Y, U = 0.1 * np.cumsum(RNG.normal(size=(ROWS, 2)), 0), RNG.normal(size=(ROWS, 2))
Y[20:30] = Y[40:50, 0] = Y[60:80:2, 1] = np.nan
NOISE = jnp.asarray(PROCESS), jnp.asarray(MEASUREMENT)
FILTERS = {
    "ekf": EKF(masses(), *NOISE, SPEED, substeps=1, gate=None),
    "ukf": UKF(masses(), *NOISE, SPEED, substeps=1, gate=None),
    "ukf, narrow": UKF(masses(), *NOISE, SPEED, substeps=1, spread=0.6, gate=None),
    "intrinsic-kalman": IntrinsicKalman(masses(), *NOISE, SPEED**2 * jnp.eye(2), substeps=1, gate=None),
}


@pytest.fixture(scope="module", params=FILTERS)
def followed(request, follow):
    return follow(FILTERS[request.param], T, Y, u=U)


@pytest.mark.exhaustive("ukf", "intrinsic-kalman")
def test_estimates_and_covariances_are_those_of_the_textbook(followed):
    means, covs = kalman(np.append(Y[0], [0.0, 0.0]), FIRST_COV, masses_steps(T, U), Y, POSITIONS, MEASUREMENT)
    np.testing.assert_allclose(followed.x, means[1:], rtol=0, atol=1e-9)
    state = followed.state
    found = state.cov if hasattr(state, "cov") else state.root @ np.swapaxes(state.root, 1, 2)
    np.testing.assert_allclose(found, covs[1:], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    assert np.linalg.eigvalsh(found).min() > 0
    if hasattr(followed.info, "innovation_cov"):
        before = np.linalg.inv(np.linalg.inv(covs[-1][:2, :2]) - np.linalg.inv(MEASUREMENT))
        np.testing.assert_allclose(followed.info.innovation_cov[-1], before + MEASUREMENT, rtol=1e-8)


@pytest.mark.exhaustive("ekf", "intrinsic-kalman")
def test_what_is_missing_is_reported(followed):
    gaps = np.isnan(Y[1:])
    np.testing.assert_array_equal(np.asarray(followed.info.innovation)[gaps], 0.0)
    np.testing.assert_array_equal(followed.info.result, np.where(gaps.any(1), StepCode.COASTED, StepCode.OK))
    if hasattr(followed.info, "innovation_cov"):
        assert np.isfinite(followed.info.innovation_cov).all()
