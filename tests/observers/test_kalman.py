"""The extended Kalman filter against one written plainly, on two coupled masses with damping, gaps and all."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from covariant.models import Lagrangian
from covariant.observers import EKF
from covariant.signals import StepCode

MASS = np.array([[2.0, 0.5], [0.5, 1.0]])
STIFFNESS = np.array([[30.0, -10.0], [-10.0, 20.0]])
DAMPING = np.diag([0.3, 0.8])
PROCESS = np.array([[2.0, 0.4], [0.4, 1.0]])
MEASUREMENT = 1e-4 * np.array([[1.0, 0.6], [0.6, 2.0]])
ROWS = 120
OUTPUT = np.eye(2, 4)


class Case(NamedTuple):
    """Stamps, held inputs and measurements with gaps: of both, of one, of the other."""

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.002, 0.02, ROWS))
    y = 0.1 * np.cumsum(rng.normal(size=(ROWS, 2)), 0)
    y[20:30] = y[40:50, 0] = y[60:80:2, 1] = np.nan
    return Case(t, rng.normal(size=(ROWS, 2)), y)


@pytest.fixture(scope="module")
def followed(case, follow):
    model = Lagrangian(
        lambda q: jnp.asarray(MASS),
        lambda q: q @ jnp.asarray(STIFFNESS) @ q / 2,
        dissipation=lambda q, v: -jnp.asarray(DAMPING) @ v,
    )
    observer = EKF(model, jnp.asarray(PROCESS), jnp.asarray(MEASUREMENT), 0.7, substeps=16, gate=None)
    return follow(observer, case.t, case.y, u=case.u)


def textbook(t, u, y):
    """The linear filter: exact discretisation, and of each sample only the entries that were measured."""
    system = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(MASS, np.hstack([STIFFNESS, DAMPING]))]])
    push = np.vstack([np.zeros((2, 2)), np.linalg.inv(MASS)])
    x, cov = np.append(y[0], [0.0, 0.0]), linalg.block_diag(MEASUREMENT, 0.49 * np.eye(2))
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        both = linalg.expm(np.block([[system, push], [np.zeros((2, 6))]]) * dt)
        transition = both[:4, :4]
        noise = np.block([[PROCESS * dt**3 / 3, PROCESS * dt**2 / 2], [PROCESS * dt**2 / 2, PROCESS * dt]])
        x, cov = transition @ x + both[:4, 4:] @ u[k - 1], transition @ cov @ transition.T + noise
        seen = np.isfinite(y[k])
        if seen.any():
            output = OUTPUT[seen]
            innovation_cov = output @ cov @ output.T + MEASUREMENT[np.ix_(seen, seen)]
            gain = cov @ output.T @ np.linalg.inv(innovation_cov)
            x, cov = x + gain @ (y[k] - OUTPUT @ x)[seen], cov - gain @ output @ cov
        yield x, cov


@pytest.mark.long
def test_estimates_and_covariances_are_those_of_the_textbook(case, followed):
    for k, (x, cov) in enumerate(textbook(*case)):
        np.testing.assert_allclose(followed.x[k], x, rtol=0, atol=1e-9, err_msg=f"row {k + 2}")
        np.testing.assert_allclose(followed.state.cov[k], cov, rtol=0, atol=1e-9, err_msg=f"row {k + 2}")


def test_covariances_stay_symmetric_and_positive(followed):
    cov = np.asarray(followed.state.cov)
    np.testing.assert_array_equal(cov, cov.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(cov).min() > 0


def test_what_is_missing_is_reported(case, followed):
    gaps = np.isnan(case.y[1:])
    np.testing.assert_array_equal(np.asarray(followed.info.innovation)[gaps], 0.0)
    np.testing.assert_array_equal(followed.info.result, np.where(gaps.any(1), StepCode.COASTED, StepCode.OK))
    assert np.isfinite(followed.info.innovation_cov).all()
