"""Observers through touch-downs and lift-offs: the maps of errors, contacts known late, and C.

The oracle is written in NumPy from the points of mass of the leg, and differentiated by a complex step.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.geometry import Metric

LEG = models.hopping_leg()
ALPHA, BETA = 30.0, 400.0


def held(q):
    return models.standing(LEG, jnp.array([True]), LEG.feet(q)).space


def error(space, x, estimate):
    """√V of the error at a true state."""
    (q, v), (p, w) = jnp.split(x, 2), jnp.split(estimate, 2)
    e = p - q
    xi = space.projected(q, e + space.connection(q, e, e) / 2)
    zeta = space.projected(q, w - v + space.connection(q, xi, v))
    return jnp.sqrt(BETA * space.inner(q, xi, xi) - ALPHA * space.inner(q, xi, zeta) + space.inner(q, zeta, zeta))


@jax.jit
@jax.vmap
def touch_down(x, estimate):
    (q, v), leaf = jnp.split(x, 2), held(x[:4])
    after = jnp.concatenate([q, leaf.projected(q, v)]), jnp.concatenate(leaf.impact(*jnp.split(estimate, 2)))
    return error(LEG.space, x, estimate), error(leaf, *after), leaf.norm(q, v - leaf.projected(q, v))


@jax.jit
@jax.vmap
def lift_off(x, estimate):
    return error(held(x[:4]), x, estimate), error(LEG.space, x, estimate)


def test_feet_land_one_by_one():
    """Two masses in a plane whose inertia couples them: a foot that lands stops, and the other one goes on."""
    inertia = jnp.array([[2.0, 0.0, 1.0, 0.0], [0.0, 2.0, 0.0, 1.0], [1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 2.0]])
    names = ("x1", "z1", "x2", "z2")
    model = models.Lagrangian(
        Metric(lambda q: inertia),
        force=lambda t, q, u: jnp.zeros(4),
        coordinates=names,
        units=("m",) * 4,
        inputs=2,
        feet=lambda q: q.reshape(2, 2),
    )
    q, v = jnp.arange(4.0), jnp.array([1.0, 2.0, 3.0, 5.0])

    @jax.jit
    def after(down):
        return jnp.concatenate(models.standing(model, down, model.feet(q)).space.impact(q, v))

    # The momentum of the other mass is kept: 2 v2⁺ = v1 + 2 v2.
    for down, wanted in (
        ((False, False), [1.0, 2.0, 3.0, 5.0]),
        ((True, False), [0.0, 0.0, 3.5, 6.0]),
        ((False, True), [2.5, 4.5, 0.0, 0.0]),
        ((True, True), [0.0, 0.0, 0.0, 0.0]),
    ):
        np.testing.assert_allclose(after(jnp.array(down)), [*q, *wanted], atol=1e-14)


def test_what_has_no_jump_is_refused_by_name():
    with pytest.raises(ValueError, match="EKF has no jump at a touch-down"):
        observers.Contacts(observers.EKF(LEG, jnp.eye(4), 1e-6 * jnp.eye(4)))
    with pytest.raises(ValueError, match="the model of Intrinsic has no feet"):
        observers.Contacts(observers.Intrinsic(models.oscillator(), 4.0, 8.0))
    with pytest.raises(ValueError, match=r"feet must return positions .* it returned shape \(2,\)"):
        models.Lagrangian(lambda q: jnp.eye(2), coordinates=("x", "z"), units=("m", "m"), feet=lambda q: q)
