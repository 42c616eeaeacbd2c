"""State-space models: what they refuse, their Jacobians, and what is known of each example system: what takes long."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_state_space import inside

from covariant import models
from covariant.models import Lagrangian, StateSpace, pendulum_chain, state_space
from covariant.simulation import simulate


@pytest.mark.exhaustive
def test_a_lagrangian_in_states_moves_as_it_does_itself():
    model, t = pendulum_chain(viscous=(0.1, 0.2), actuated=(1,)), jnp.linspace(0.0, 2.0, 9)
    twin, x0 = state_space(model), jnp.array([2.0, -1.0, 1.0, -3.0])
    assert (twin.coordinates, twin.units) == (("q1", "q2", "q1_dot", "q2_dot"), ("rad", "rad", "rad/s", "rad/s"))
    assert (twin.outputs, twin.inputs, twin.circles) == (("q1", "q2"), 1, (0, 1))
    one, other = (simulate(each, x0, t, lambda s, x: jnp.sin(s)[None]) for each in (model, twin))
    for name in ("u", "y", "x"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-9)
    assert state_space(Lagrangian(model.metric, model.potential, coordinates=("a", "b"), units=("m", "m"))).inputs == 2


@pytest.mark.exhaustive
def test_a_simulated_oscillator_is_the_closed_form_and_keeps_its_frequency():
    model, t = models.unknown_frequency(), jnp.linspace(0.0, 7.0, 29)
    record, w = simulate(model, jnp.array([0.5, 1.2, 0.81]), t), 0.9
    np.testing.assert_allclose(record.y[:, 0], 0.5 * np.cos(w * t) + 1.2 / w * np.sin(w * t), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(record.y, record.x[:, :1])
    np.testing.assert_array_equal(record.x[:, 2], 0.81)
    assert record.u.shape == (29, 0)
    assert record.check() is record


@pytest.mark.exhaustive
def test_inputs_reach_the_outputs_at_their_own_time():
    """x' = −x + u, y = x + 2u + t with u = t: x = t − 1 + exp(−t)."""
    model = StateSpace(lambda t, x, u: u - x, lambda t, x, u: x + 2 * u + t, coordinates=("x",), inputs=1)
    t = jnp.linspace(0.0, 3.0, 13)
    record = simulate(model, jnp.zeros(1), t, lambda s, x: s[None])
    np.testing.assert_allclose(record.y[:, 0], 4 * t - 1 + np.exp(-t), rtol=0, atol=1e-9)
    np.testing.assert_allclose(record.u[:, 0], t, rtol=0, atol=0)
