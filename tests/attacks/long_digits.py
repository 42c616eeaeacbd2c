"""Numbers of the machine that are no real numbers: integers that wrap around, and single precision: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_digits import whole

from covariant import Record, models, observers
from covariant.certificates import decay
from covariant.certificates.base import in_coordinates


@pytest.mark.exhaustive
def test_stamps_that_single_precision_rounds_together_are_refused():
    """Without double precision in JAX, seconds since 1970 are multiples of 128 s: no step would take any time."""
    t = np.linspace(0.0, 4.0, 401)
    zeros, record = np.zeros((401, 1)), Record(t, np.zeros((401, 1)), np.cos(t)[:, None])
    with jax.enable_x64(False):
        ekf = observers.EKF(models.oscillator(), 1e-3 * jnp.eye(1), 1e-4 * jnp.eye(1), substeps=1)
        momentum = observers.MomentumObserver(models.oscillator(), 5.0)
        metric, pair = in_coordinates(lambda t, x: jnp.eye(1)), (jnp.zeros((1, 1)), jnp.ones((1, 1)))
        uses = [
            lambda later: observers.run(ekf, record._replace(t=t + later)),
            lambda later: observers.smooth(ekf, record._replace(t=t + later)),
            lambda later: observers.observed_forces(momentum, t + later, zeros, record.y, zeros),
            lambda later: decay(lambda t, x: 5.0 * x, metric, -2.0, *pair, t[::200] + later),
        ]
        for use in uses:
            use(0.0)
            with pytest.raises(ValueError, match=r"stamps in float32 near 1\.7e\+09 s are whole multiples"):
                use(1.7e9)
