"""Pushes: those of `simulate`, and rows of `estimate` in which something pushes."""

import jax.numpy as jnp
import numpy as np

from covariant.verbs.base.simulated_log import pushes


def test_pushes_are_on_each_joint_in_turn_and_change_sign():
    times = jnp.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.5, 5.5, 7.5, 9.5])
    forces = np.stack([pushes(t, jnp.array([0.5, 0.2])) for t in times])
    first, second = [0, 0, 0.5, 0, 0, 0, -0.5, 0, 0.5], [0, 0, 0, 0, 0, 0.2, 0, -0.2, 0]
    np.testing.assert_allclose(forces, np.stack([first, second], axis=1), atol=1e-12)
