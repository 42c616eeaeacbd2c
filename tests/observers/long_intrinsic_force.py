"""What takes long of `test_intrinsic_force.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_intrinsic_force import ALPHA, BETA, DOUBLE, RATE, SPRING, errors

from covariant import models, observers
from covariant.observers import Intrinsic, IntrinsicForce
from covariant.signals import Record, StepCode
from covariant.simulation import hold, simulate


@pytest.mark.exhaustive
def test_without_a_rate_it_is_the_observer_of_the_paper():
    """Sample by sample, in all its forms."""
    t = np.linspace(0.0, 0.5, 26)
    y = np.stack([0.4 + np.sin(3 * t), 0.6 - np.cos(4 * t)], axis=1)
    record = Record(t, np.zeros((26, 2)), y)
    for form in ({}, {"order": 2, "coefficients": "estimated", "curvature": False, "substeps": 2}):
        one = observers.run(IntrinsicForce(DOUBLE, 20.0, 200.0, 0.0, **form), record)
        two = observers.run(Intrinsic(DOUBLE, 20.0, 200.0, **form), record)
        np.testing.assert_allclose(one.estimate, two.estimate, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(one.info.slow, 0.0)


@pytest.mark.exhaustive
@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_on_a_curved_metric_the_force_couples_by_the_connection_alone(speed):
    found, law = errors(DOUBLE, speed, 1e-6)
    assert np.abs(found - law).max() < 1e-4 * np.abs(law).max()


@pytest.mark.exhaustive
def test_without_the_coupling_the_law_is_another_one():
    for coupling in (0.0, -1.0):
        found, law = errors(DOUBLE, 10.0, 1e-6, coupling)
        assert np.abs(found - law).max() > 1e-2 * np.abs(law).max()


def test_a_new_start_keeps_the_force():
    """Readings that jump and stay: the gate starts the estimate anew there, and the load is the same."""
    gated = observers.Gated(IntrinsicForce(SPRING, 20.0, 200.0, 10.0), SPRING, noise=1e-3, speed=0.05)
    step = jax.jit(gated.step)
    state, codes = gated.init(jnp.array([2.0])), []
    for y in [2.0] * 200 + [1.0] * 14:
        state, info = step(state, jnp.zeros(1), jnp.array([y]), 0.01)
        codes.append(int(info.result))
        if codes[-1] == StepCode.RESTARTED:
            break
    assert codes[-1] == StepCode.RESTARTED
    # On a unit spring at 2; the readings that were refused took a little longer than the force is remembered as it was.
    np.testing.assert_allclose(state.inner.force, 2.0, rtol=0.12)
    np.testing.assert_allclose(state.inner.q, 1.0)


@pytest.mark.exhaustive
def test_a_torque_on_a_body_is_found_in_the_frame_of_the_body():
    body, torque = models.free_body((0.9, 1.0, 1.2)), jnp.array([0.3, -0.2, 0.1])
    t = jnp.linspace(0.0, 3.0, 301)
    start = models.Motion(jnp.eye(3), jnp.array([0.3, 0.8, -0.2]))
    true = jax.jit(lambda: simulate(body, start, t, hold(t, jnp.broadcast_to(torque, (301, 3)))))()
    run = observers.run(IntrinsicForce(body, 28.0, 400.0, 10.0, substeps=1), Record(t, jnp.zeros((301, 3)), true.y))
    np.testing.assert_allclose(run.info.slow[-1], torque, atol=2e-3)
    np.testing.assert_allclose(run.estimate.v[-1], true.x.v[-1], atol=1e-3)


@pytest.mark.exhaustive
def test_late_readings_give_the_same_force():
    observer = IntrinsicForce(SPRING, 20.0, 200.0, 10.0, substeps=1)
    late = observers.Delayed(observer, delay=0.05, rate=100.0)
    t = np.arange(400) * 0.01
    y = 2.0 - np.cos(t)
    record = Record(t, np.zeros((400, 1)), y[:, None])
    delayed = Record(t, np.zeros((400, 1)), np.interp(t - 0.05, t, y)[:, None])
    one, two = observers.run(observer, record), observers.run(late, delayed)
    np.testing.assert_allclose(two.info.slow[-1], one.info.slow[-1], atol=1e-3)
    np.testing.assert_allclose(two.estimate[-1], one.estimate[-1], atol=1e-3)


def test_without_a_force_it_moves_as_the_observer_without_one():
    """With the gains of position and velocity that three poles have."""
    y, v, u = jnp.array([0.4, 0.6]), jnp.array([1.0, -2.0]), jnp.array([0.3, -0.2])
    pair = IntrinsicForce(DOUBLE, ALPHA, BETA, RATE), Intrinsic(DOUBLE, ALPHA + RATE, BETA + ALPHA * RATE)
    with_force, without = (o.flow(jnp.zeros(()), o.init(y)._replace(q=y + 0.1, v=v), u, y) for o in pair)
    np.testing.assert_allclose(with_force.q, without.q, rtol=1e-12)
    np.testing.assert_allclose(with_force.v, without.v, rtol=1e-12)
