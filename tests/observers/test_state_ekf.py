"""The extended Kalman filter of state-space models against one that is written plainly, and its gate."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import StateSpace
from covariant.observers import StateEKF

A, C = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[1.0, 0.0], [0.5, 1.0]])
Q, R = np.diag([0.02, 0.3]), np.array([[0.01, 0.004], [0.004, 0.04]])
START, SPREAD = np.array([0.3, -1.0]), np.diag([0.5, 2.0])
LINEAR = StateSpace(
    lambda t, x, u: jnp.asarray(A) @ x + jnp.array([0.0, 1.0]) * u[0],
    lambda t, x, u: jnp.asarray(C) @ x,
    coordinates=("position", "velocity"),
    inputs=1,
)


def test_numbers_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="StateEKF: process_cov must have finite entries"):
        StateEKF(LINEAR, jnp.full((2, 2), jnp.nan), jnp.asarray(R), jnp.asarray(START), jnp.asarray(SPREAD))
