"""Streams as they come: whatever numbers arrive, every observer stays finite, says so, and returns once they are sound.

Each observer's loop is compiled once, over streams of one length; the faults are drawn, the loop is not.
"""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import Euclidean
from covariant.models import Lagrangian, StateSpace, free_body
from covariant.observers import (
    EKF,
    Contracting,
    FilteredDerivative,
    Geodesic,
    Intrinsic,
    ModelCopy,
    Riccati,
    Salcudean,
    SampledState,
)
from covariant.signals import StepCode

BODY = free_body((1.0, 2.0, 3.5))
MASSES = StateSpace(
    lambda t, x, u: jnp.stack([x[2], x[3], u[0] - x[0] + x[1], x[0] - 2 * x[1] - 0.2 * x[3]]),
    lambda t, x, u: x[:2],
    coordinates=("a", "b", "va", "vb"),
    inputs=1,
)
"""Two masses on springs, both positions measured."""

START = jnp.zeros(4)
GAIN = jnp.array([[3.0, 0.0], [0.0, 3.0], [2.0, 0.0], [0.0, 2.0]])
METRIC = jnp.asarray(np.linalg.inv(np.kron([[3.0, 2.0], [2.0, 3.0]], np.eye(2))))
"""A constant one, whose correction is that of GAIN."""


# The rules, one by one

ONE = Lagrangian(Euclidean(), lambda q: 0.0 * q[0], inputs=2, force=lambda t, q, u: u[:1] + 10 * u[1:])
"""A unit mass on a line, pushed by two inputs."""
WATCHER = Intrinsic(ONE, 4.0, 4.0)
NOTHING = jnp.array([jnp.nan])


@jax.jit
def stepped(state, u, y, dt):
    return WATCHER.step(state, u, y, dt)


def moving() -> SampledState:
    return WATCHER.init(jnp.array([1.0]), 2.0)._replace(v=jnp.array([0.5]))


def same(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_last_finite_input_is_held_entry_by_entry_and_zero_before_the_first():
    dt, state, twin = jnp.asarray(0.1), moving(), moving()
    given = np.array([[np.nan, np.inf], [3.0, np.nan], [np.nan, -1.0], [-np.inf, np.nan], [2.0, 0.5]])
    meant = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, -1.0], [3.0, -1.0], [2.0, 0.5]])
    for u, sound in zip(given, meant, strict=True):
        state, info = stepped(state, jnp.asarray(u), jnp.array([1.0]), dt)
        twin, _ = stepped(twin, jnp.asarray(sound), jnp.array([1.0]), dt)
        same(state, twin)
        assert info.result == (StepCode.OK if np.isfinite(u).all() else StepCode.INPUT_HELD)


@pytest.mark.parametrize("dt", [np.nan, np.inf, -np.inf, -0.1, -1e-300])
def test_a_step_that_is_none_is_refused_whatever_else_arrives(dt):
    state, info = stepped(moving(), jnp.array([7.0, np.nan]), NOTHING, jnp.asarray(dt))
    same(state, moving())
    assert info.result == StepCode.STEP_REFUSED
    assert all(np.isfinite(np.asarray(part)).all() for part in info)


def test_infinite_measurements_are_missing_ones():
    u, dt = jnp.array([0.3, 0.1]), jnp.asarray(0.1)
    missing, _ = stepped(moving(), u, NOTHING, dt)
    for y in (np.inf, -np.inf):
        state, info = stepped(moving(), u, jnp.array([y]), dt)
        same(state, missing)
        assert info.result == StepCode.COASTED


def test_a_state_made_by_hand_without_a_held_input_takes_zero_and_keeps_its_form():
    bare = SampledState(jnp.array([1.0]), jnp.array([0.5]), jnp.asarray(2.0))
    state, info = stepped(bare, jnp.array([np.nan, 1.0]), NOTHING, jnp.asarray(0.1))
    twin, _ = stepped(bare, jnp.array([0.0, 1.0]), NOTHING, jnp.asarray(0.1))
    same(state, twin)
    assert state.last_input is None
    assert info.result == StepCode.INPUT_HELD


def test_streams_may_be_mapped_and_stay_single():
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (moving(), jnp.ones(2), NOTHING, 0.1))
    state, info = eqx.filter_eval_shape(WATCHER.step, *single)
    assert {leaf.dtype for leaf in jax.tree.leaves((state, info.innovation, info.distance))} == {np.dtype(np.float32)}
    dts = jnp.array([0.1, jnp.nan, 0.0, -1.0])
    states, info = jax.vmap(lambda dt: stepped(moving(), jnp.ones(2), jnp.array([1.0]), dt))(dts)
    assert list(info.result) == [StepCode.OK, StepCode.STEP_REFUSED, StepCode.REPEATED, StepCode.STEP_REFUSED]
    np.testing.assert_array_equal(states.t, [2.1, 2.0, 2.0, 2.0])


# Gains

SECOND_ORDER = (Intrinsic, Geodesic, ModelCopy)
POSITIVE = "must be a positive, finite number; got .*$"
GAINS = {f"^{kind.__name__}: alpha {POSITIVE}": lambda gain, kind=kind: kind(ONE, gain, 3.0) for kind in SECOND_ORDER}
GAINS |= {f"^{kind.__name__}: beta {POSITIVE}": lambda gain, kind=kind: kind(ONE, 2.0, gain) for kind in SECOND_ORDER}
GAINS["^Salcudean: kv must be a positive"] = lambda gain: Salcudean(BODY, 1.0, gain)
GAINS["^FilteredDerivative: bandwidth must be a positive"] = FilteredDerivative


@pytest.mark.parametrize("message", GAINS)
def test_gains_that_are_not_positive_and_finite_are_refused_in_one_line(message):
    for gain in (np.nan, np.inf, -np.inf, -1.0, 0.0):
        for written in (gain, np.float64(gain), jnp.asarray(gain)):
            with pytest.raises(ValueError, match=message):
                GAINS[message](written)


ODD = jnp.array([[1.0, jnp.nan], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("message", "make"),
    [
        ("EKF: process_cov must have finite entries", lambda: EKF(ONE, ODD, jnp.eye(2))),
        ("EKF: process_cov must have finite entries", lambda: EKF(BODY, ODD, jnp.eye(2))),
        ("Contracting: gain must have finite entries", lambda: Contracting(MASSES, GAIN.at[0, 0].set(jnp.inf), START)),
        ("Riccati: gain must have finite entries", lambda: Riccati(MASSES, lambda x: METRIC, START, jnp.nan)),
    ],
)
def test_matrices_of_gains_that_are_not_finite_are_refused(message, make):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_gains_pass():
    def estimate(alpha):
        observer = Intrinsic(ONE, alpha, alpha**2)
        return observer.step(moving(), jnp.ones(2), jnp.array([2.0]), jnp.asarray(0.1))[0].v

    assert jax.jit(jax.vmap(estimate))(jnp.array([1.0, 2.0])).shape == (2, 1)
