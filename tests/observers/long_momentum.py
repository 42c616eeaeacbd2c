"""Momentum observer: on exact motions its force is the true one behind a first-order lag: what takes long."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_momentum import CHAIN

from covariant import models
from covariant.models import resistance
from covariant.observers import MomentumObserver, observed_forces
from covariant.simulation import simulate

PUSH = np.array([0.6, -0.3])


GAIN = 12.0


def pushed(model, force):
    def dissipation(t, q, v, u):
        return resistance(model, t, q, v, u) + force(t)

    return eqx.tree_at(lambda m: m.dissipation, model, dissipation)


def swing(step, force, duration=2.0):
    """A fast swing with held torques and an external force: stamps, inputs, angles and exact velocities."""
    t = np.arange(0.0, duration + step / 2, step)

    def torques(s, x):
        return jnp.stack([jnp.where(s < 1.0, 1.0, -1.0), jnp.zeros_like(s)])

    record = simulate(pushed(CHAIN, force), jnp.array([1.5, -1.0, 3.0, -6.0]), jnp.asarray(t), torques)
    q, v = np.split(np.asarray(record.x), 2, axis=1)
    return t, np.stack([np.where(t < 1.0, 1.0, -1.0), 0 * t], axis=1), q, v


@pytest.mark.exhaustive
def test_a_constant_force_appears_behind_a_first_order_lag():
    errors = []
    for step in (0.01, 0.005):
        t, u, q, v = swing(step, lambda s: jnp.asarray(PUSH))
        assert np.abs(v).max() > 5.0  # so that the terms of the velocity weigh as much as the force
        force = observed_forces(MomentumObserver(CHAIN, GAIN), t, u, q, v)
        lagged = PUSH * (1 - np.exp(-GAIN * t))[:, None]
        errors.append(np.abs(np.asarray(force) - lagged).max())
    assert errors[1] < 5e-3 * np.abs(PUSH).max()
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.15)  # the trapezoidal rule is of order 2


@pytest.mark.exhaustive
def test_a_force_that_changes_appears_behind_the_same_lag_at_uneven_stamps():
    t, u, q, v = swing(0.002, lambda s: jnp.asarray(PUSH) * jnp.sin(5 * s))
    rows = np.flatnonzero(np.random.default_rng(0).random(len(t)) < 0.7)
    t, u, q, v = (each[rows] for each in (t, u, q, v))
    force = np.asarray(observed_forces(MomentumObserver(CHAIN, GAIN), t, u, q, v))
    late = t > 0.8  # what the lag does to a sine, once it has begun: gain K/√(K² + 5²) and phase atan(5/K)
    expected = PUSH * (GAIN / np.hypot(GAIN, 5.0) * np.sin(5 * t - np.arctan2(5.0, GAIN)))[:, None]
    np.testing.assert_allclose(force[late], expected[late], atol=6e-3 * np.abs(PUSH).max())


@pytest.mark.exhaustive
def test_a_body_on_a_group():
    body, torque = models.free_body((1.0, 2.0, 3.5)), jnp.array([0.3, -0.2, 0.5])
    t = np.arange(0.0, 1.5, 0.004)
    start = models.Motion(jnp.eye(3), jnp.array([2.0, -1.5, 1.0]))
    x = simulate(pushed(body, lambda s: torque), start, jnp.asarray(t)).x
    force = observed_forces(MomentumObserver(body, GAIN), t, np.zeros((len(t), 3)), x.q, x.v)
    np.testing.assert_allclose(force, np.asarray(torque) * (1 - np.exp(-GAIN * t))[:, None], atol=1e-4)
