"""Observers that copy the plant: the virtual system, samples, gaps, and the passive observer of ships."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import marine
from covariant.observers import (
    Contracting,
    craft_observer,
    lyapunov_gains,
    notch_gains,
    run,
)
from covariant.signals import Record

ZERO = jnp.zeros(())


@eqx.filter_jit
def step(observer, state, u, y, dt):
    return observer.step(state, u, y, dt)


@eqx.filter_jit
def flow_of(observer, state, u, y):
    return observer.flow(ZERO, state, u, y).x


def mass_on_a_spring():
    return models.StateSpace(
        lambda t, x, u: jnp.stack([x[1], u[0] - x[0]]), lambda t, x, u: x[:1], coordinates=("x", "v"), inputs=1
    )


# The sampled form


def test_step_tends_to_the_flow():
    observer = Contracting(mass_on_a_spring(), jnp.array([[3.0], [2.0]]), jnp.array([0.2, -0.3]))
    u, y = jnp.array([0.4]), jnp.array([0.7])
    state = observer.init(y)
    slope = flow_of(observer, state, u, y)
    errors = []
    for dt in (1e-2, 5e-3, 2.5e-3):
        moved, _ = step(observer, state, u, y, jnp.asarray(dt))
        errors.append(float(jnp.linalg.norm((moved.x - state.x) / dt - slope)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 1.0, atol=0.1)


def test_a_sample_counts_for_the_time_since_the_one_before():
    model = mass_on_a_spring()
    slow = Contracting(model, jnp.array([[3.0], [2.0]]), jnp.zeros(2))
    t = np.arange(0.0, 8.0, 0.05)
    truth = np.stack([np.cos(t), -np.sin(t)], axis=1)
    y = truth[:, :1].copy()
    y[np.arange(len(t)) % 10 != 0] = np.nan
    record = Record(t, np.zeros((len(t), 1)), y, None)
    error = np.abs(np.asarray(run(slow, record).estimate) - truth)[-20:].max()
    assert error < 2e-2
    forgetful = np.asarray(run(Contracting(model, slow.gain, slow.start, memory=0.05), record).estimate)
    assert np.abs(forgetful - truth)[-20:].max() > 3 * error


def test_angles_are_wrapped():
    model = models.StateSpace(
        lambda t, x, u: jnp.stack([x[1], -x[1]]), lambda t, x, u: x[:1], coordinates=("a", "w"), circles=(0,)
    )
    observer = Contracting(model, jnp.array([[1.0], [1.0]]), jnp.array([3.1, 0.0]))
    state = observer.init(jnp.zeros(1))
    flows = [observer.flow(ZERO, state, jnp.zeros(0), jnp.array([a])).x for a in (-3.1, 2 * np.pi - 3.1)]
    np.testing.assert_allclose(*flows, atol=1e-12)
    assert flows[0][0] > 0  # the short way round


def test_single_precision_stays_single():
    observer = Contracting(mass_on_a_spring(), jnp.array([[3.0], [2.0]]), jnp.zeros(2))
    y = jnp.ones(1, jnp.float32)
    state, _ = step(observer, observer.init(y), jnp.zeros(1, jnp.float32), y, jnp.asarray(0.1, jnp.float32))
    assert state.x.dtype == jnp.float32


def test_gains_and_starts_that_do_not_fit_are_refused():
    model = mass_on_a_spring()
    with pytest.raises(ValueError, match="start has 3 entries; the model has 2 states"):
        Contracting(model, jnp.ones((3, 1)), jnp.zeros(3))
    with pytest.raises(ValueError, match="a row for each of 2 states, a column for each of 1 outputs"):
        Contracting(model, jnp.ones((2, 2)), jnp.zeros(2))
    with pytest.raises(ValueError, match="k2 must be square"):
        craft_observer(marine.odin(), np.eye(6), np.ones((6, 3)))


# The passive observer


def station(**more):
    return marine.Station(marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7])), **more)


REFUSED = {
    "A2 not Hurwitz": (
        lambda: lyapunov_gains(marine.Station(marine.surface_ship(np.eye(3), -np.eye(3))), np.eye(3), np.eye(3)),
        "A2 = −M⁻¹D is not Hurwitz",
    ),
    "Q not positive": (lambda: lyapunov_gains(station(), np.eye(3), -np.eye(3)), "q1 must be positive definite"),
    "Q2 not positive": (
        lambda: lyapunov_gains(station(), np.eye(3), np.eye(3), np.diag([1.0, 0.0, 1.0])),
        "q2 must be positive definite",
    ),
    "K not square": (lambda: lyapunov_gains(station(), np.ones((3, 2)), np.eye(3)), "stiffness must be a matrix of 3"),
    "bandwidth": (lambda: notch_gains(station(), (0.1, 0.1)), "bandwidth needs three positive numbers"),
}


@pytest.mark.core(1)
@pytest.mark.parametrize("case", REFUSED)
def test_bad_designs_are_refused_in_one_line(case):
    make, message = REFUSED[case]
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
