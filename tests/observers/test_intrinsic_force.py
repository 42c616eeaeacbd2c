"""The observer with an unknown force: its three poles, in continuous time and sampled, and its limit `Intrinsic`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant import models
from covariant._integrate import rk8
from covariant.certificates import error_system
from covariant.geometry.lie import SO3
from covariant.observers import IntrinsicForce, run
from covariant.signals import Record
from covariant.simulation import simulate


def matrix(alpha, beta, rate):
    """Of the error law in continuous time."""
    return np.array([[-alpha - rate, 1.0, 0.0], [-beta - alpha * rate, 0.0, 1.0], [-beta * rate, 0.0, 0.0]])


SPRING = models.oscillator()


DOUBLE = models.pendulum_chain((1.0, 0.7), (0.5, 0.4))


# The error law in continuous time.

ALPHA, BETA, RATE = 14.0, 100.0, 5.0
FORCE = jnp.array([0.5, -0.3])
ERRORS = jnp.array([[0.8, -0.6], [3.0, 5.0], [4.0, 2.0]])


@eqx.filter_jit
def errors(model, speed, size, coupling=1.0, duration=0.3):
    """Errors (3, n) of position, velocity and acceleration by the force, and those of the law; over `size`.

    A plant moves under a constant force that the observer does not know. All are components at the truth.
    """
    space, u, observer = model.space, jnp.zeros(2), IntrinsicForce(model, ALPHA, BETA, RATE)
    q, v = jnp.array([0.4, 0.6]), speed * jnp.array([0.7, -0.6])
    xi, zeta, delta = size * ERRORS
    state = observer.init(q + xi)._replace(v=v + zeta - space.connection(q, xi, v), force=FORCE + delta)
    law = jnp.stack([xi, zeta, space.raise_(q, delta)])

    def flow(t, joint):
        q, v, state, (xi, zeta, eta) = joint
        along = jax.vmap(lambda a: space.connection(q, v, a))
        delta = space.lower(q, eta)
        rates = (
            zeta - (ALPHA + RATE) * xi,
            -(BETA + ALPHA * RATE) * xi + eta,
            -BETA * RATE * xi - coupling * space.raise_(q, along(jnp.eye(2)) @ delta),
        )
        slopes = jnp.stack(rates) - along(jnp.stack([xi, zeta, eta]))
        return v, models.acceleration(model, t, q, v, FORCE), observer.flow(t, state, u, q), slopes

    start = q, v, state._replace(last_input=None, age=None), law
    q, v, end, law = rk8(flow, jnp.zeros(()), start, jnp.asarray(duration), 100)
    xi = end.q - q
    found = jnp.stack([xi, end.v + space.connection(q, xi, v) - v, space.raise_(q, end.force - FORCE)])
    return found / size, law / size


def test_the_error_law_has_three_poles_exactly_where_the_metric_is_constant():
    """At any size of the error, and whatever the potential."""
    model = models.Lagrangian(
        lambda q: jnp.array([[2.0, 0.3], [0.3, 1.0]]), lambda q: -3.0 * jnp.cos(q[0] + 2 * q[1]), inputs=2
    )
    found, law = errors(model, 3.0, 1.0)
    np.testing.assert_allclose(found, law, atol=1e-9)
    raised = np.linalg.solve([[2.0, 0.3], [0.3, 1.0]], ERRORS[2])
    np.testing.assert_allclose(found, expm(0.3 * matrix(ALPHA, BETA, RATE)) @ [*ERRORS[:2], raised], atol=1e-9)


# Behind a gate, on groups, and late.


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ((-1.0, 2.0, 3.0), "IntrinsicForce: alpha must be a positive"),
        ((1.0, 0.0, 3.0), "IntrinsicForce: beta must be a positive"),
        ((1.0, 2.0, -3.0), "IntrinsicForce: force_rate must be a finite number, 0 or more"),
    ],
)
def test_gains_that_make_no_sense_are_refused(gains, message):
    with pytest.raises(ValueError, match=message):
        IntrinsicForce(SPRING, *gains)


def test_no_certificate_is_about_it():
    observer = IntrinsicForce(DOUBLE, ALPHA, BETA, RATE)
    with pytest.raises(TypeError, match=r"certificates are about .*; got IntrinsicForce"):
        error_system(observer, np.eye(2))


def test_a_force_is_forgotten_with_the_time_in_which_it_was_learnt_and_not_before():
    """At steps up to 1/ρ it stays; of a hole one step or many give the same, with steps of the integration that are."""
    observer = IntrinsicForce(SPRING, ALPHA, BETA, RATE, substeps=400)
    start = observer.init(jnp.array([0.3]))._replace(force=jnp.array([2.0]))
    u = jnp.zeros(1)
    assert observer.predict(start, u, 1 / RATE).force[0] == 2.0
    once = observer.predict(start, u, 1.0)
    np.testing.assert_allclose(once.force, 2.0 * np.exp(1 - RATE), rtol=1e-12)
    parts = start
    for dt in (0.1, 0.1, 0.3, 0.5):
        parts = observer.predict(parts, u, dt)
    np.testing.assert_allclose(parts.force, once.force, rtol=1e-12)
    np.testing.assert_allclose([*parts.q, *parts.v], [*once.q, *once.v], atol=1e-5)


def test_through_a_hole_a_body_that_spins_does_not_carry_the_force_it_had_learnt():
    """At 30 rad/s, with moments of inertia that are wrong: what is missing turns with the body."""
    model, t, rng = models.free_body((1.0, 1.2, 1.4)), np.arange(0, 2.65, 0.005), np.random.default_rng(0)
    begin = models.Motion(jnp.eye(3), jnp.array([3.0, 30.0, 4.0]))
    true = simulate(models.free_body((1.0, 1.15, 1.5)), begin, jnp.asarray(t))
    noise = jax.vmap(SO3.exp)(jnp.asarray(rng.normal(0, 2e-3, (len(t), 3))))
    hole, u = (t > 2) & (t < 2.5), np.zeros((len(t), 3))
    y = np.where(hole[:, None, None], np.nan, np.asarray(true.y @ noise))
    observer = IntrinsicForce(model, 84.0, 3600.0, 20.0)
    done = run(observer, Record(t, u, y), ("slow",))
    last = int(np.flatnonzero(hole)[0]) - 1
    carried = eqx.tree_at(lambda m: m.force, model, lambda t, q, u: done.info.slow[last] + u)
    coasting = models.Motion(*(jnp.asarray(each)[last] for each in (done.estimate.q, done.estimate.v)))
    unchanged = simulate(carried, coasting, jnp.asarray(t[last:][: hole.sum() + 1]))

    def error(v):
        return np.sqrt(np.mean((np.asarray(v) - np.asarray(true.x.v)[hole]) ** 2))

    assert error(np.asarray(done.estimate.v)[hole]) < 0.85 * error(unchanged.x.v[1:])
