"""Ball and beam against the printed values of Aghannan & Rouchon 2003, appendix I, and against Lagrange's equations."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import christoffel, curvature
from covariant.models import acceleration, ball_and_beam

POINT = jnp.array([0.7, 0.4])
R = 0.7
UNIT = jnp.eye(2)
SYMBOLS = {(0, 1, 1): -R, (1, 0, 1): R / (1 + R**2), (1, 1, 0): R / (1 + R**2)}
"""`Γ^i_jk` as printed, where they are not 0."""
RIEMANN = {
    **{(0, 0, 1, 1): -1 / (1 + R**2), (0, 1, 0, 1): 1 / (1 + R**2)},
    **{(1, 0, 1, 0): 1 / (1 + R**2) ** 2, (1, 1, 0, 0): -1 / (1 + R**2) ** 2},
}
"""The paper's `R^i_jkl`, which acts as `{R(u, w)z}^i = R^i_jkl u^k w^j z^l`: the library's with the other sign."""
PARAMETERS = {"normalised": (1.0, 1.0, 1.0), "heavy": (9.81, 2.0, 0.3)}
each = pytest.mark.parametrize(("gravity", "mass", "inertia"), PARAMETERS.values(), ids=PARAMETERS)


def test_connection_and_curvature_are_those_printed():
    metric = ball_and_beam().metric
    for j, k in itertools.product((0, 1), repeat=2):
        found = christoffel(metric, POINT, UNIT[j], UNIT[k])
        np.testing.assert_allclose(found, [SYMBOLS.get((i, j, k), 0.0) for i in (0, 1)], atol=1e-14)
    for z, u, w in itertools.product((0, 1), repeat=3):
        found = -curvature(metric, POINT, UNIT[u], UNIT[w], UNIT[z])
        np.testing.assert_allclose(found, [RIEMANN.get((i, w, u, z), 0.0) for i in (0, 1)], atol=1e-13)


@each
def test_acceleration_is_that_of_lagranges_equations(gravity, mass, inertia):
    """Normalised it is equation (13) of the paper; the torque does not push the ball."""
    (r, theta), v_r, v_theta, u = POINT, 0.3, -0.5, 1.7
    turning = u - 2 * mass * r * v_r * v_theta - mass * gravity * r * np.cos(theta)
    expected = [r * v_theta**2 - gravity * np.sin(theta), turning / (inertia + mass * r**2)]
    model = ball_and_beam(gravity, mass, inertia)
    found = acceleration(model, jnp.zeros(()), POINT, jnp.array([v_r, v_theta]), jnp.array([u]))
    np.testing.assert_allclose(found, expected, rtol=1e-13)
