"""Systems whose friction depends on time and inputs."""

import jax.numpy as jnp
import numpy as np

from covariant.geometry.lie import SE2
from covariant.models import GroupSystem, Lagrangian


def braked(t, q, v, u):
    """A brake that the second input closes, and oil that warms up."""
    return -(0.05 + 0.2 / (1 + t) + u[1]) * v


def pendulum(dissipation=braked):
    return Lagrangian(
        lambda q: jnp.eye(1, dtype=q.dtype) * 0.5,
        lambda q: -3.0 * jnp.cos(q[0]),
        lambda t, q, u: u[:1],
        dissipation,
        coordinates=("angle",),
        units=("rad",),
        inputs=2,
    )


def steered(t, g, v, u):
    """Drag of a hull, and a rudder whose lift grows with the square of the speed."""
    lift = u[1] * v[0] * jnp.abs(v[0])
    return jnp.stack([-0.3 * v[0], -0.8 * v[1] + 0.4 * lift, -0.1 * v[2] - 0.2 * lift])


def boat(dissipation=steered):
    return GroupSystem(
        SE2,
        np.diag([3.0, 4.0, 0.5]),
        None,
        lambda t, g, u: jnp.stack([u[0], 0 * u[0], 0 * u[0]]),
        dissipation,
        inputs=2,
    )


def sled():
    """A sled on rails of any length, with a brake."""
    return Lagrangian(
        lambda q: 2.0 * jnp.eye(1, dtype=q.dtype),
        None,
        lambda t, q, u: u[:1],
        lambda t, q, v, u: -(0.2 + u[1]) * v - 0.1 * jnp.abs(v) * v,
        coordinates=("x",),
        units=("m",),
        inputs={"thrust": "N", "brake": "N s/m"},
    )
