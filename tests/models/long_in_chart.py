"""The same machine in other coordinates moves the same, with everything that pushes and brakes it: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from charts import chart_jacobian, chart_velocity, in_chart
from test_in_chart import CHAIN, braked, wavy

from covariant import models
from covariant.geometry.lie import SE2, SO3
from covariant.models.marine import euler_rotation


def planar(z):
    return SE2.exp(jnp.stack([z[0], z[1], z[2]]))


CASES = {
    "double pendulum": (CHAIN, wavy, (0.3, -0.8)),
    "body on SO(3)": (braked(SO3, 3), euler_rotation, (0.4, 0.5, -0.3)),
    "body on SE(2)": (braked(SE2, 3), planar, (0.4, 0.5, -0.3)),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CASES)
def test_it_accelerates_alike(name):
    model, chart, z = CASES[name]
    z, manifold = jnp.array(z), model.manifold
    n = len(z)
    rate, u, t = jnp.linspace(1.0, -0.7, n), jnp.linspace(0.2, 0.9, n), jnp.asarray(0.7)
    there = in_chart(model, chart)
    bend = models.acceleration(there, t, z, rate, u)
    # v(t) = J(z)z', so v' = J z'' + (∂_z' J) z'.
    turned = jax.jvp(lambda s: chart_jacobian(manifold, chart, s) @ rate, (z,), (rate,))[1]
    found = chart_jacobian(manifold, chart, z) @ bend + turned
    v = chart_velocity(manifold, chart, z, rate)
    np.testing.assert_allclose(found, models.acceleration(model, t, chart(z), v, u), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(models.energy(there, z, rate), models.energy(model, chart(z), v), rtol=1e-12)
