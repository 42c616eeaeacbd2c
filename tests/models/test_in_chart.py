"""The same machine in other coordinates moves the same, with everything that pushes and brakes it."""

import jax.numpy as jnp
import numpy as np
import pytest
from charts import chart_jacobian, in_chart

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, Lagrangian
from covariant.models.marine import euler_rates, euler_rotation

INERTIA = jnp.diag(jnp.array([1.0, 2.0, 3.5]))
DRAG = jnp.diag(jnp.array([0.3, 0.2, 0.5]))


def wavy(z):
    return z + 0.2 * jnp.sin(z[::-1])


def braked(group, n) -> GroupSystem:
    """A body with a potential, a drag that the input scales and a force that depends on time and input."""
    return GroupSystem(
        group,
        INERTIA[:n, :n],
        lambda g: 2.0 * g[0, 0] - g[1, 0],
        lambda t, g, u: jnp.sin(t) * g[0, :n] + u,
        lambda t, g, v, u: -(1 + u[0] ** 2) * DRAG[:n, :n] @ v,
    )


CHAIN = models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.1, 0.2))


def test_euler_angles_have_the_rates_they_are_known_for():
    z = jnp.array([0.4, 0.5, -0.3])
    jacobian = chart_jacobian(SO3, euler_rotation, z)
    np.testing.assert_allclose(euler_rates(z) @ jacobian, np.eye(3), rtol=0, atol=1e-12)


def test_a_chart_of_a_chart():
    z = jnp.array([0.3, -0.8])
    twice = in_chart(in_chart(CHAIN, wavy), wavy)
    at_once = in_chart(CHAIN, lambda s: wavy(wavy(s)))
    np.testing.assert_allclose(twice.metric(z), at_once.metric(z), rtol=1e-12)


def test_a_chart_that_leads_elsewhere_is_refused():
    with pytest.raises(ValueError, match="metric cannot be evaluated"):
        in_chart(GroupSystem(SO3, INERTIA), lambda z: z, coordinates=("a", "b", "c"))


def test_a_plain_lagrangian_keeps_its_inputs():
    model = Lagrangian(lambda q: jnp.eye(2), force=lambda t, q, u: jnp.stack([u[0], 0 * u[0]]), inputs=1)
    assert in_chart(model, wavy).inputs == 1
    assert in_chart(braked(SO3, 3), euler_rotation).inputs == 3
