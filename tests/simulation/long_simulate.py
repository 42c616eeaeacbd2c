"""What takes long of `test_simulate.py`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_simulate import SPRING

from covariant import geometry
from covariant._adaptive import solve
from covariant.models import Lagrangian, duffing, energy, pendulum_chain
from covariant.observers import AbstractFlowObserver, MechanicalState
from covariant.simulation import hold, observe, simulate


class Follower(AbstractFlowObserver):
    """An observer of which everything is known: it adds the measurement up, or runs away as q' = q²."""

    escape: bool = False

    def init(self, y, t=0.0):
        return MechanicalState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype))

    def estimate(self, state):
        return jnp.concatenate([state.q, state.v])

    def predict(self, state, u, dt):
        raise NotImplementedError

    def correct(self, state, u, y):
        raise NotImplementedError

    def flow(self, t, state, u, y):
        q_dot = state.q**2 if self.escape else y
        return MechanicalState(q_dot, u + 0 * y, jnp.ones_like(state.t))


@pytest.mark.exhaustive
def test_a_double_pendulum_keeps_its_energy():
    model = pendulum_chain((1.0, 0.5), (0.8, 0.6), com=(0.4, 0.5), inertia=(0.05, 0.01))
    t = jnp.linspace(0.0, 8.0, 33)
    record = simulate(model, jnp.array([2.0, -1.0, 1.0, -3.0]), t)
    total = jax.vmap(lambda x: energy(model, x[:2], x[2:]))(record.x)
    np.testing.assert_allclose(total, total[0], rtol=0, atol=1e-9 * float(jnp.abs(record.x).max()) ** 2)
    assert np.ptp(record.x[:, 1]) > 3.0, "it must really have swung"
    np.testing.assert_array_equal(record.y, record.x[:, :2])
    np.testing.assert_array_equal(record.u, np.zeros((33, 2)))
    assert record.check() is record


@pytest.mark.exhaustive("05", "08")
@pytest.mark.parametrize("rtol", [1e-5, 1e-8, 1e-11])
def test_the_tolerance_is_kept(rtol):
    t = jnp.linspace(0.0, 10.0, 21)
    x = simulate(SPRING, jnp.array([1.0, 0.0]), t, rtol=rtol, atol=rtol).x
    error = np.abs(x - np.stack([np.cos(2 * t), -2 * np.sin(2 * t)], axis=1)).max()
    assert error < 100 * rtol


@pytest.mark.exhaustive
def test_inputs_and_feedback_reach_the_machine():
    """A spring made critically damped by feedback, and pushed: q = 1 + (A + Bt) exp(−2t)."""
    t = jnp.linspace(0.0, 3.0, 13)
    record = simulate(SPRING, jnp.array([0.0, 0.5]), t, lambda s, x: 4.0 - 4 * x[1:])
    expected = 1 + (-1 + (0.5 - 2) * t) * np.exp(-2 * t)
    np.testing.assert_allclose(record.x[:, 0], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(record.u, 4 - 4 * record.x[:, 1:], rtol=0, atol=1e-12)


@pytest.mark.exhaustive
def test_a_machine_moves_by_held_inputs_as_by_steps_of_force():
    free = Lagrangian(geometry.Euclidean(), lambda q: 0.0 * q[0])
    t, u = jnp.array([0.0, 0.5, 0.75, 2.0]), jnp.array([[1.0], [-2.0], [4.0], [0.0]])
    x = simulate(free, jnp.zeros(2), t, hold(t, u)).x
    q, v = [0.0], [0.0]
    for dt, a in zip(np.diff(t), np.asarray(u)[:-1, 0], strict=True):
        q.append(q[-1] + v[-1] * dt + a * dt**2 / 2)
        v.append(v[-1] + a * dt)
    np.testing.assert_allclose(x, np.stack([q, v], axis=1), rtol=0, atol=1e-9)


@pytest.mark.exhaustive
@pytest.mark.parametrize("model", [SPRING, duffing(0.0, 4.0, 0.0)], ids=["mechanical", "state space"])
def test_a_watched_machine_moves_as_it_does_alone(model):
    t = jnp.linspace(0.0, 4.0, 17)
    x0, push = jnp.array([0.5, 0.0]), lambda s, x: jnp.sin(s)[None]
    start = Follower().init(jnp.zeros(1))
    x, state = observe(model, Follower(), x0, start, t, push, measure=lambda s, q: q + 3.0 * s)
    np.testing.assert_allclose(x, simulate(model, x0, t, push).x, rtol=0, atol=1e-8)
    # The observer got the input and the measurement of the same instant: q'' = u − 4q gives ∫q.
    np.testing.assert_allclose(state.v[:, 0], 1 - np.cos(t), rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.t, t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(4 * (state.q[:, 0] - 1.5 * t**2), 1 - np.cos(t) - x[:, 1], rtol=0, atol=1e-8)


@pytest.mark.exhaustive
def test_after_an_escape_the_stamps_are_infinite(monkeypatch):
    """q' = q² from q = 1 reaches infinity at t = 1."""
    monkeypatch.setattr("covariant.simulation._simulate.solve", functools.partial(solve, max_steps=5000))
    t = jnp.linspace(0.0, 2.0, 9)
    start = Follower().init(jnp.ones(1))
    x, state = observe(SPRING, Follower(escape=True), jnp.array([0.5, 0.0]), start, t)
    before = t < 1
    np.testing.assert_allclose(state.q[before, 0], 1 / (1 - t[before]), rtol=1e-8)
    assert np.isinf(state.q[t > 1]).all()
    assert np.isinf(x[t > 1]).all()
    np.testing.assert_allclose(x[before, 0], 0.5 * np.cos(2 * t[before]), atol=1e-8)
