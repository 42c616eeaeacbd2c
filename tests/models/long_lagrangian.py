"""What takes long of `test_lagrangian.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_lagrangian import TIME, model, motions

from covariant import geometry, models
from covariant.models import MechanicalSystem, acceleration, energy, friction, robots, source


@pytest.mark.exhaustive("chain, relative")
def test_power_balance(model, motions):
    """`dE/dt = v·(force + dissipation)` along every motion, so energy is conserved where neither acts."""

    @jax.jit
    @jax.vmap
    def both(q, v, u):
        a = acceleration(model, TIME, q, v, u)
        _, rate = jax.jvp(lambda q, v: energy(model, q, v), (q, v), (v, a))
        return rate, v @ (model.force(TIME, q, u) + model.dissipation(q, v))

    rate, power = both(*motions)
    np.testing.assert_allclose(rate, power, atol=1e-11 * max(1.0, np.abs(power).max()))


@pytest.mark.exhaustive("chain, relative")
def test_acceleration_is_source_friction_and_geodesic(model, motions):
    @jax.jit
    @jax.vmap
    def both(q, v, u):
        parts = source(model, TIME, q, u) + friction(model, TIME, q, v, u) - geometry.christoffel(model.metric, q, v, v)
        return acceleration(model, TIME, q, v, u), parts

    whole, parts = both(*motions)
    np.testing.assert_allclose(whole, parts, atol=1e-11 * max(1.0, np.abs(whole).max()))


@pytest.mark.exhaustive
def test_an_input_for_each_velocity_is_a_force_where_a_configuration_has_more_numbers():
    """A floating robot: its pose is sixteen numbers and six velocities."""
    space = robots.load("quadruped").space
    model = MechanicalSystem(space)
    x = model.manifold.origin()
    assert x.ndim == 1
    v = model.manifold.zero(x)
    np.testing.assert_allclose(space.lower(x, acceleration(model, TIME, x, v, v + 1.0)), v + 1.0, atol=1e-9)


def test_an_oscillator_is_the_same_in_the_chart_q_and_in_r_its_exponential():
    """`r̈ = r(q̈ + q̇²)`."""
    q, v, u = jnp.array([0.4]), jnp.array([-0.7]), jnp.array([0.3])
    r, v_r, (plain, other) = jnp.exp(q), jnp.exp(q) * v, (models.oscillator(chart, 2.0) for chart in "qr")
    in_q, in_r = acceleration(plain, TIME, q, v, u), acceleration(other, TIME, r, v_r, u)
    np.testing.assert_allclose(in_q, -2.0 * q + u, rtol=1e-15)
    np.testing.assert_allclose(in_r, r * (in_q + v**2), rtol=1e-14)
    np.testing.assert_allclose(energy(plain, q, v), energy(other, r, v_r), rtol=1e-14)
    with pytest.raises(ValueError, match="chart must be 'q' or 'r'; got 's'"):
        models.oscillator("s")
