"""What takes long of `test_doors.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_doors import folder

from covariant import Record, models, observers


@pytest.mark.exhaustive
def test_a_smoother_goes_on_after_a_restart():
    t = np.arange(0, 0.3, 0.01)
    u = np.zeros((30, 1))
    u[10] = 1e200
    ekf = observers.EKF(models.oscillator(), jnp.eye(1), 1e-4 * jnp.eye(1), substeps=1)
    smoothed = observers.smooth(ekf, Record(t, u, np.cos(t)[:, None]))
    assert np.isfinite(smoothed.run.estimate).all()
    np.testing.assert_allclose(smoothed.run.estimate[:, 0], np.cos(t), atol=0.05)
