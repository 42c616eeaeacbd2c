"""What takes long of `test_noise_step.py`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_noise_step import MEASUREMENT, PROCESS, ROWS, log, masses

from covariant.observers import EKF, IntrinsicKalman, noise_step


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
