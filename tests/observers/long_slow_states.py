"""What takes long of `test_slow_states.py`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import plants
import pytest
from test_slow_states import CHAIN, NOISE, ROWS, STEP, kalman

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import Lagrangian, Motion, Parametric, heavy_top, pendulum_chain
from covariant.observers import IntrinsicKalman, SlowVariables, external_force, run, sensor_bias, uncertain_parameters
from covariant.signals import Record
from covariant.simulation import hold, simulate

STAMPS = STEP * np.arange(ROWS)


LATE = slice(200, None)


NOTHING = 1e-9
"""A standard deviation of what is known: the same program then estimates nothing of it."""


def swing(model, start, u):
    return simulate(model, start, jnp.asarray(STAMPS), hold(jnp.asarray(STAMPS), jnp.asarray(u))).x


def noise(n: int) -> np.ndarray:
    return NOISE * np.random.default_rng(0).normal(size=(ROWS, n))


def mass_on_a_spring(stiffness: float) -> Lagrangian:
    return Lagrangian(lambda q: jnp.eye(1), Parametric(_spring, stiffness=stiffness), coordinates=("q",))


def _spring(q, stiffness):
    return stiffness * q[0] ** 2 / 2


def textbook(y: np.ndarray, stiffness: float, std: float, drift: float) -> tuple[np.ndarray, np.ndarray]:
    """Means (T, 3) of position, velocity and offset, and covariances, of the plain filter, from the first sample on."""
    ahead = np.eye(3)
    w = STEP * np.sqrt(stiffness)
    ahead[:2, :2] = [[np.cos(w), STEP * np.sinc(w / np.pi)], [-stiffness * STEP * np.sinc(w / np.pi), np.cos(w)]]
    added = np.zeros((3, 3))
    added[:2, :2] = 1e-4 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
    added[2, 2] = drift**2 * STEP
    # Nothing is known of the position before the first sample, which then says q = y − offset.
    cov = np.diag([NOISE**2 + std**2, 4.0, std**2])
    cov[0, 2] = cov[2, 0] = -(std**2)
    steps = [(ahead, np.zeros(3), added)] * (len(y) - 1)
    output, noise = np.array([[1.0, 0.0, 1.0]]), np.array([[NOISE**2]])
    return plants.kalman(np.array([y[0], 0.0, 0.0]), cov, steps, y[:, None], output, noise)


@pytest.mark.exhaustive
@pytest.mark.parametrize("stiffness", [0.0, 6.0])
def test_of_an_offset_it_is_the_kalman_filter_and_where_nothing_shows_it_stays_unknown(stiffness):
    w, std, drift = np.sqrt(stiffness), 0.1, 0.002
    y = 0.04 + np.cos(w * STAMPS) + 0.5 * STAMPS * np.sinc(w * STAMPS / np.pi) + noise(1)[:, 0]
    y[100:130] = np.nan
    observer = kalman(mass_on_a_spring(stiffness), 1, sensor_bias((std,), drift), gate=None)
    assert observer.slow_names == ("bias1",)
    found = run(observer, Record(STAMPS, np.zeros((ROWS, 1)), y[:, None]))
    means, covs = textbook(y, stiffness, std, drift)
    np.testing.assert_allclose(found.estimate, means[:, :2], rtol=0, atol=2e-7)
    np.testing.assert_allclose(found.info.slow[:, 0], means[:, 2], rtol=0, atol=2e-7)
    stds = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    np.testing.assert_allclose(found.info.velocity_std[1:, 0], stds[1:, 1], rtol=1e-6)
    np.testing.assert_allclose(found.info.slow_std[1:, 0], stds[1:, 2], rtol=1e-6)
    if stiffness:
        assert abs(found.info.slow[-1, 0] - 0.04) < 3 * stds[-1, 2] < 0.02
    else:
        assert stds[-1, 2] >= std
        assert stds[-1, 1] < 0.02  # the velocity needs no offset


TORQUES = np.stack([2 * np.sin(3 * STAMPS), np.cos(5 * STAMPS)], axis=1)


@pytest.fixture(scope="module")
def arm() -> np.ndarray:
    """Its true states (T, 4)."""
    return np.asarray(swing(CHAIN, jnp.array([0.6, -0.4, 0.0, 0.0]), TORQUES))


def velocity_errors(found, x: np.ndarray) -> np.ndarray:
    return np.asarray(found.estimate)[LATE, 2:] - x[LATE, 2:]


@pytest.mark.exhaustive
def test_encoders_that_are_off_are_found_and_leave_no_bias(arm):
    off = np.array([0.06, -0.04])
    record = Record(STAMPS, TORQUES, arm[:, :2] + off + noise(2))
    record.y[50:60, 1] = np.nan
    found, blind = (run(kalman(CHAIN, 2, sensor_bias((std, std))), record) for std in (0.1, NOTHING))
    std = np.asarray(found.info.slow_std[-1])
    assert (np.abs(np.asarray(found.info.slow[-1]) - off) < 3 * std).all()
    assert (std < 0.005).all()
    errors, worse = velocity_errors(found, arm), velocity_errors(blind, arm)
    assert np.abs(errors.mean(axis=0)).max() < 0.1 * np.abs(worse.mean(axis=0)).max()
    assert np.sqrt(np.mean(errors**2)) < 0.4 * np.sqrt(np.mean(worse**2))
    positions = np.asarray(found.estimate)[LATE, :2] - arm[LATE, :2]
    assert np.abs(positions.mean(axis=0)).max() < 0.006  # the true ones, not the read ones


@pytest.mark.exhaustive
def test_ticks_of_encoders_that_are_off(arm):
    tick, off = 0.01, np.array([0.0, 0.052])
    read = tick * np.round((arm[:, :2] + off) / tick)
    edges = IntrinsicKalman(
        CHAIN, 1e-4, (0.1 * tick) ** 2 * jnp.eye(2), 4 * jnp.eye(2), (sensor_bias((0.0, 0.1)),), (tick,) * 2, substeps=1
    )
    assert edges.slow_names == ("bias2",)
    found = run(edges, Record(STAMPS, TORQUES, read))
    assert abs(found.info.slow[-1, 0] - off[1]) < 3 * float(found.info.slow_std[-1, 0]) < 0.02
    assert np.abs(velocity_errors(found, arm).mean(axis=0)).max() < 0.02


@pytest.mark.exhaustive
def test_a_payload_and_friction_are_found(arm):
    given = ["parameters.mass=[1.0, 0.4]", "parameters.length=[0.5, 0.4]", "parameters.viscous=[0.2, 0.05]"]
    family = models.family("pendulum_chain", ["mass[1]", "viscous[0]"], given)
    record = Record(STAMPS, TORQUES, arm[:, :2] + noise(2))
    found, blind = (
        run(kalman(family.file.model, 2, uncertain_parameters(family, (mass, 1.0))), record) for mass in (0.5, NOTHING)
    )
    value, std = (np.asarray(a[-1]) for a in (found.info.slow, found.info.slow_std))
    assert (np.abs(value - [0.7, 0.05]) < 3 * std).all()
    assert (std < [0.01, 0.02]).all()
    assert np.sqrt(np.mean(velocity_errors(found, arm) ** 2)) < 0.2 * np.sqrt(np.mean(velocity_errors(blind, arm) ** 2))
    np.testing.assert_allclose(blind.info.slow[-1, 0], 0.4, rtol=1e-6)


@pytest.mark.exhaustive
def test_a_sensor_that_is_mounted_askew_on_a_body_is_found():
    """On a group the offset is in the body: y = q exp(offset). Here it is large, and known to a few degrees."""
    top, off = heavy_top((0.2, 0.3, 0.1), axis=(0.3, 0.2, 1.0)), jnp.array([0.7, -0.5, 0.4])
    u = 0.3 * np.stack([np.sin(2 * STAMPS), np.cos(3 * STAMPS), np.sin(4 * STAMPS)], axis=1)
    true = swing(top, Motion(SO3.exp(jnp.array([2.0, 0.3, 0.0])), jnp.array([0.2, 0.1, -0.1])), u)
    y = jax.vmap(lambda q, w: q @ SO3.exp(off) @ SO3.exp(w))(true.q, jnp.asarray(noise(3)))
    measured = sensor_bias((1.0, 1.0, 1.0))
    known = dataclasses.replace(measured, first=off + jnp.array([0.06, 0.05, -0.04]))
    found, blind = (
        run(kalman(top, 3, dataclasses.replace(known, first_cov=std**2 * jnp.eye(3))), Record(STAMPS, u, np.asarray(y)))
        for std in (0.1, NOTHING)
    )
    std = np.asarray(found.info.slow_std[-1])
    assert (np.abs(np.asarray(found.info.slow[-1] - off)) < 3 * std).all()
    assert (std < 0.004).all()
    errors, worse = (np.asarray(each.estimate.v - true.v)[LATE] for each in (found, blind))
    assert np.sqrt(np.mean(errors**2)) < 0.2 * np.sqrt(np.mean(worse**2))


@pytest.mark.exhaustive
def test_a_force_of_your_own():
    """A level of friction, written as a force."""
    one = jnp.eye(1)
    slow = SlowVariables(("friction",), jnp.zeros(1), one, 0 * one, force=_friction)
    t = STAMPS
    y = np.exp(-0.3 * t) * np.cos(2.0 * t)  # q'' + .6 q' + 4.09 q = 0
    found = run(kalman(mass_on_a_spring(4.09), 1, slow), Record(t, np.zeros((ROWS, 1)), y[:, None] + noise(1)))
    assert abs(found.info.slow[-1, 0] - 0.6) < 3 * float(found.info.slow_std[-1, 0]) < 0.1


def _friction(q, v, s):
    return -s[0] * v


def spring_with(slow: SlowVariables, substeps: int = 1) -> IntrinsicKalman:
    spring = mass_on_a_spring(6.0)
    return IntrinsicKalman(spring, 1e-6, NOISE**2 * jnp.eye(1), 4 * jnp.eye(1), (slow,), gate=None, substeps=substeps)


@pytest.mark.exhaustive
def test_of_a_very_long_time_it_is_the_random_walk():
    y = 0.3 * np.sin(2 * STAMPS[:300, None]) + noise(1)[:300]
    record = Record(STAMPS[:300], np.zeros((300, 1)), y)
    walk = external_force(0.8 * jnp.eye(1))
    without, with_time = (run(spring_with(slow), record) for slow in (walk, dataclasses.replace(walk, time=1e9)))
    for a, b in zip(jax.tree.leaves(without), jax.tree.leaves(with_time), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
