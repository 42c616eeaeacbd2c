"""Simulated truth: conserved energy, the tolerance asked for, held inputs, and what is left after an escape."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant import geometry
from covariant.models import Lagrangian, ball_and_beam
from covariant.simulation import hold
from covariant.simulation._simulate import no_input

SPRING = Lagrangian(geometry.Euclidean(), lambda q: 2 * q @ q)  # ω = 2 rad/s


def test_recorded_inputs_are_held_to_the_next_stamp():
    t, u = jnp.array([0.0, 0.1, 0.4]), jnp.array([[1.0], [2.0], [3.0]])
    held = jax.vmap(lambda s: hold(t, u)(s, jnp.zeros(2)))(jnp.array([-1.0, 0.0, 0.0999, 0.1, 0.3999, 0.4, 9.0]))
    np.testing.assert_array_equal(held[:, 0], [1, 1, 1, 2, 2, 3, 3])


def test_no_input_has_as_many_entries_as_the_model_takes():
    assert no_input(ball_and_beam(), jnp.zeros(2))(0.0, jnp.zeros(4)).shape == (1,)
    assert no_input(SPRING, jnp.zeros(1))(0.0, jnp.zeros(2)).shape == (1,)
    np.testing.assert_array_equal(no_input(SPRING, jnp.zeros(1))(0.0, jnp.zeros(2)), 0.0)
