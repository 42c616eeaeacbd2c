"""Simulation under inputs as a log has them, against closed forms and against dense integration: what takes long."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_piecewise import AT, T, U, dense

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import Motion
from covariant.signals import Record, acting_inputs
from covariant.simulation import logged_inputs, simulate, simulate_piecewise


def on_a_line():
    """A unit mass without friction, pushed by its input."""
    return models.Lagrangian(lambda q: jnp.eye(1), lambda q: 0.0 * q[0], coordinates=("x",))


@pytest.mark.exhaustive
@pytest.mark.parametrize("between", ["held", "linear"])
def test_a_lag_follows_what_is_commanded(between):
    """Against a plain Euler integration of `lag du/dt = command − u` in tiny steps."""
    step, lag = 1e-4, 0.3
    times = np.arange(0.0, 2.0, step)
    command = dense(logged_inputs(T, U, between, 0.1, at=AT), times)
    u, path = U[0, 0], []
    for c in command:
        path.append(u)
        u += step * (c - u) / lag
    np.testing.assert_allclose(dense(logged_inputs(T, U, between, 0.1, lag, at=AT), times), path, atol=2e-3)


@pytest.mark.exhaustive("held")
@pytest.mark.parametrize(("between", "delay"), [("held", 0.0), ("held", 0.02), ("linear", 0.0), ("linear", 0.013)])
def test_a_machine_feels_what_a_reader_of_the_log_takes_for_acting(between, delay):
    """The impulse between two stamps is the mean input that `acting_inputs` gives, times the step."""
    rng = np.random.default_rng(0)
    t, u = np.round(np.cumsum(rng.uniform(0.005, 0.02, 60)), 12), rng.normal(size=(60, 1))
    inputs = logged_inputs(t, u, between, delay, at=t)
    record = simulate_piecewise(on_a_line(), jnp.zeros(2), inputs)
    v = np.asarray(record.x)[np.searchsorted(inputs.begin, t), 1]
    mean = acting_inputs(Record(t, u, np.zeros((60, 1))), between, delay).u[:, 0]
    np.testing.assert_allclose(np.diff(v), mean[:-1] * np.diff(t), atol=1e-9)


@pytest.mark.exhaustive
def test_smooth_inputs_give_the_motion_of_a_continuous_simulation():
    """A ramp that is linear between its stamps is the ramp: on a group, and of a state-space model too."""
    t = np.linspace(0.0, 1.0, 11)
    for model, x0 in (
        (models.duffing(), jnp.array([0.5, -0.2])),
        (models.free_body((1.0, 2.0, 3.0)), Motion(SO3.identity(), jnp.array([0.1, 1.0, 0.2]))),
    ):
        slope = 0.7 * jnp.ones(models.input_count(model, 3))
        expected = simulate(model, x0, jnp.asarray(t), lambda s, x, slope=slope: s * slope)
        record = simulate_piecewise(model, x0, logged_inputs(t, t[:, None] * np.asarray(slope), "linear"))
        for one, two in zip(jax_leaves(record), jax_leaves(expected), strict=True):
            np.testing.assert_allclose(one, two, atol=1e-8)


def jax_leaves(record):
    x = record.x
    return [record.t, record.u, record.y, *(x if isinstance(x, tuple) else (x,))]
