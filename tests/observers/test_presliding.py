"""Coulomb friction that turns over a distance: Dahl's law as a state, against LuGre friction simulated by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import Record, models, observers
from covariant.models import pendulum_chain, resistance
from covariant.observers.sensors import SlowStates
from scalargraph.errors import InputError

COULOMB, STIFFNESS, INERTIA, VISCOUS, TICK, DT = 0.3, 300.0, 0.02, 0.03, 2 * np.pi / 4096, 5e-3


def joint() -> models.MechanicalSystem:
    # The model's torque at high speed is coulomb·π/2.
    return pendulum_chain((INERTIA,), (1.0,), viscous=(VISCOUS,), coulomb=(COULOMB * 2 / np.pi,), gravity=0.0)


@pytest.mark.parametrize("speed", [0.05, -0.4])
def test_state_follows_dahls_law(speed):
    group = observers.presliding_friction(joint(), COULOMB / STIFFNESS)
    force, steps, h = -0.1, 20_000, 0.004
    for _ in range(steps):
        rate = STIFFNESS * speed * (1 - force * np.sign(speed) / COULOMB)
        force += h / steps * rate
    _, end = group.advanced(jnp.array([speed]), jnp.array([-0.1]), jnp.asarray(h))
    assert float(end[0]) == pytest.approx(force, abs=1e-4)


def test_at_rest_it_is_a_spring():
    group = observers.presliding_friction(joint(), COULOMB / STIFFNESS)

    def end(v):
        return group.advanced(v, jnp.zeros(1), jnp.asarray(1e-3))[1][0]

    assert float(jax.grad(end)(jnp.zeros(1))[0]) == pytest.approx(STIFFNESS * 1e-3)


@pytest.mark.parametrize("angles", ["relative", "absolute"])
def test_state_replaces_the_models_friction_of_its_joint(angles):
    model = pendulum_chain(viscous=(0.1, 0.2), coulomb=(0.3, 0.4), angles=angles)
    states = SlowStates((observers.presliding_friction(model, (0.0, 1e-3)),))
    assert states.names == ("friction2",)
    q, v, none = jnp.zeros(2), jnp.array([30.0, -20.0]), jnp.zeros(())
    sliding, _ = states.groups[0].law(v)
    with_state = states.in_model(model, sliding)
    forces = [resistance(each, none, q, v, jnp.zeros(2)) for each in (with_state, model)]
    # At 30 rad/s the smoothed sign is one up to 2/π/3000.
    np.testing.assert_allclose(*forces, atol=1e-3)
    at_rest = states.in_model(model, jnp.zeros(1))
    axis = np.array([0.0, 1.0]) if angles == "relative" else np.array([-1.0, 1.0])
    added = forces[1] - resistance(at_rest, none, q, v, jnp.zeros(2))
    np.testing.assert_allclose(added, 0.4 * np.pi / 2 * axis, atol=1e-3)


def test_without_coulomb_friction_it_is_refused():
    with pytest.raises(InputError, match="has Coulomb friction"):
        observers.presliding_friction(pendulum_chain(), 1e-3)


def lugre_log(rows: int) -> tuple[Record, np.ndarray]:
    """Log of a controlled joint, and its velocities."""
    q = v = z = 0.0
    log, substeps = np.zeros((rows, 4)), 25
    for k in range(rows):
        t, read = k * DT, TICK * np.round(q / TICK)
        wanted = 0.6 * np.sin(1.8 * t) + 0.25 * np.sin(4.6 * t + 1), 1.08 * np.cos(1.8 * t) + 1.15 * np.cos(4.6 * t + 1)
        u = 6 * (wanted[0] - read) + 0.12 * (wanted[1] - v)
        log[k] = t, u, read, v
        for _ in range(substeps):
            bristle = v - STIFFNESS * abs(v) * z / (COULOMB * (1 + 0.2 * np.exp(-((v / 0.05) ** 2))))
            a = (u - STIFFNESS * z - 0.02 * bristle - VISCOUS * v) / INERTIA
            v, q, z = v + DT / substeps * a, q + DT / substeps * v, z + DT / substeps * bristle
    return Record(log[:, 0], log[:, 1:2], log[:, 2:3]), log[:, 3]


@pytest.mark.long
def test_velocities_at_reversals_are_twice_as_accurate():
    record, true = lugre_log(1200)
    near = np.zeros(len(true), bool)
    for k in np.flatnonzero(true[1:] * true[:-1] < 0):
        near[max(0, k - 4) : k + 12] = True
    near[:200] = False

    def error(*slow):
        kalman = observers.IntrinsicKalman(joint(), 1e-3, TICK**2 / 12, 1.0, slow, substeps=5)
        return np.sqrt(np.mean((observers.run(kalman, record).estimate[near, 1] - true[near]) ** 2))

    assert error(observers.presliding_friction(joint(), COULOMB / STIFFNESS)) < error() / 2
