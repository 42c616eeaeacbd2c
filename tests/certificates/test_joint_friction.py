"""Friction in joints as variables of a proof in continuous time: its force and its slope, beside the velocity."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates.proving._joint_bounds import friction_bounds, has_dry_friction
from covariant.models import Lagrangian


def two_links(**friction):
    return models.pendulum_chain(mass=(0.6, 0.4), length=(0.3, 0.2), inertia=(0.05, 0.02), **friction)


def test_bounds_contain_the_friction_and_its_slopes():
    model = two_links(viscous=(0.01, 0.02), coulomb=(0.09, 0.05))
    speed = np.array([0.5, 2.0])
    (low, high), (least, largest) = friction_bounds(model, speed)
    friction = functools.partial(model.dissipation, jnp.zeros(2))
    for share in np.linspace(-1, 1, 41):
        v = share * speed
        assert ((low <= friction(v)) & (friction(v) <= high)).all()
        slopes = -np.diag(np.asarray(jax.jacfwd(friction)(v)))
        assert ((least <= slopes) & (slopes <= largest)).all()


@pytest.mark.parametrize(
    ("friction", "dry"),
    [
        (lambda q, v: -jnp.arctan(100 * v), True),
        (lambda q, v: -2 * v, False),
        (lambda q, v: -v * jnp.abs(v) - v, False),
        (lambda q, v: -(1 + q**2) * jnp.arctan(100 * v), False),
        (lambda q, v: -jnp.arctan(100 * v[::-1]), False),
        (lambda q, v: -jnp.sign(v), True),  # that it has no slope is for `friction_bounds` to say
    ],
)
def test_dry_friction_is_recognised(friction, dry):
    model = Lagrangian(lambda q: jnp.eye(2), lambda q: 0.0 * q[0], None, friction, coordinates=("a", "b"))
    assert has_dry_friction(model, np.ones(2)) == dry
