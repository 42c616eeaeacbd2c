"""What takes long of `test_ball_and_beam.py`."""

import jax.numpy as jnp
import numpy as np
from test_ball_and_beam import R, each

from covariant.geometry import curvature
from covariant.geometry._functions import inner
from covariant.models import ball_and_beam

X, Y, Z = jnp.array([[0.3, -0.5], [1.1, 0.2], [-0.4, 0.9]])


@each
def test_its_curvature_is_that_of_a_surface(gravity, mass, inertia):
    """`R(x, y)z = K(<y, z>x − <x, z>y)` with Gauss's K, which is half of the printed scalar curvature."""
    metric = ball_and_beam(gravity, mass, inertia).metric
    for r in (-3.0, 1e-8, 0.7):
        q, k = jnp.array([r, 0.4]), -inertia / (inertia + mass * r**2) ** 2
        expected = k * (inner(metric, q, Y, Z) * X - inner(metric, q, X, Z) * Y)
        np.testing.assert_allclose(curvature(metric, q, X, Y, Z), expected, rtol=1e-12)
