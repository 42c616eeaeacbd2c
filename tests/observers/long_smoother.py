"""What takes long of `test_smoother.py`."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from plants import FIRST_COV, MEASUREMENT, PROCESS, SPEED, least_squares, masses, masses_steps, van_loan
from scipy.linalg import block_diag
from test_smoother import RATE, ROWS, log, rod, rod_filter, rod_step, swing

from covariant import models, observers
from covariant.models import Lagrangian
from covariant.observers import EKF, UKF, IntrinsicKalman, JointKalman, smooth
from covariant.observers.filters import _smoother
from covariant.signals import Record, StepCode

PUSH, TIME = np.array([1.5, 0.8]), 0.2


def with_a_force(t: np.ndarray, u: np.ndarray):
    """The steps of the masses with two more states, forces that are forgotten."""
    for h, (transition, change, noise) in zip(np.diff(t), masses_steps(t, u), strict=True):
        held = np.stack([masses_steps(np.array([0.0, h]), [axis])[0][1] for axis in np.eye(2)], axis=1)
        decay, mean = math.exp(-h / TIME), TIME / h * (1 - math.exp(-h / TIME))
        transition = np.block([[transition, mean * held], [np.zeros((2, 4)), decay * np.eye(2)]])
        yield transition, np.append(change, np.zeros(2)), block_diag(noise, np.diag(PUSH**2) * (1 - decay**2))


def of_masses(forced: bool = False, last: int = ROWS - 1):
    """The least squares of all rows up to the last one."""
    steps = list((with_a_force if forced else masses_steps)(log().t, log().u))[:last]
    cov = block_diag(FIRST_COV, np.diag(PUSH**2)) if forced else FIRST_COV
    first = np.append(log().y[0], np.zeros(len(cov) - 2))
    return least_squares(first, cov, steps, log().y, np.eye(2, len(cov)), MEASUREMENT)


def linear(name: str, model: Lagrangian):
    noise = jnp.asarray(PROCESS), jnp.asarray(MEASUREMENT)
    speed = SPEED**2 * jnp.eye(2)
    force = observers.external_force(std=PUSH, time=TIME)
    return {
        "ekf": lambda: EKF(model, *noise, SPEED, substeps=1, gate=None),
        "ukf": lambda: UKF(model, *noise, SPEED, substeps=1, gate=None),
        "intrinsic-kalman": lambda: IntrinsicKalman(model, *noise, speed, gate=None, substeps=1),
        "with a force": lambda: IntrinsicKalman(model, *noise, speed, force, gate=None, substeps=1),
    }[name]()


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["ekf", "ukf", "intrinsic-kalman", "with a force"])
def test_of_a_linear_system_it_is_the_least_squares_solution_over_all_rows(name):
    smoothed = smooth(linear(name, masses()), log())
    means, covs = of_masses(forced=name == "with a force")
    x = np.asarray(smoothed.run.estimate)
    if name == "with a force":
        x = np.concatenate([x, smoothed.run.info.slow], axis=1)
        np.testing.assert_allclose(smoothed.run.info.slow_std, np.sqrt(covs[:, [4, 5], [4, 5]]), rtol=1e-9)
    np.testing.assert_allclose(x, means, rtol=0, atol=1e-9)
    found = np.asarray(smoothed.root @ jnp.swapaxes(smoothed.root, 1, 2))
    sizes = np.sqrt(np.einsum("tii->ti", covs))
    np.testing.assert_allclose(
        found / sizes[:, :, None] / sizes[:, None], covs / sizes[:, :, None] / sizes[:, None], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(smoothed.run.info.velocity_std, sizes[:, 2:4], rtol=1e-9)


@pytest.mark.exhaustive
def test_with_a_lag_it_is_the_least_squares_solution_up_to_as_many_rows_later():
    lag = 7
    smoothed = smooth(linear("intrinsic-kalman", masses()), log(), lag=lag)
    for k in (0, 3, 19, 22, 33, ROWS - lag - 1, ROWS - 4, ROWS - 1):
        means, covs = of_masses(last=min(k + lag, ROWS - 1))
        np.testing.assert_allclose(smoothed.run.estimate[k], means[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(smoothed.root[k] @ smoothed.root[k].T, covs[k], rtol=1e-7, atol=1e-12)


@pytest.mark.exhaustive
def test_without_a_model_each_joint_is_smoothed_by_itself():
    """Singer's model of the acceleration, its transition and noise by the exponential of a matrix (Van Loan)."""
    std, time, noise = 3.0, 0.05, 0.01
    smoothed = smooth(JointKalman(std, time, noise, gate=None), log())
    rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / time]])
    density = np.diag([0.0, 0.0, 2 * std**2 / time])
    moves = (van_loan(rates, density, h) for h in np.diff(log().t))
    steps = [(transition, np.zeros(3), added) for transition, added in moves]
    covs = np.diag([noise**2, (std * time) ** 2, std**2])
    for i in range(2):
        y = log().y[:, i : i + 1]
        means, cov = least_squares(np.array([y[0, 0], 0.0, 0.0]), covs, steps, y, np.eye(1, 3), noise**2 * np.eye(1))
        np.testing.assert_allclose(smoothed.run.estimate[:, i::2], means[:, :2], rtol=0, atol=1e-8)
        np.testing.assert_allclose(smoothed.std[:, i::2], np.sqrt(np.einsum("tii->ti", cov)), rtol=1e-6)


@functools.cache
def best_motion(noise: float) -> np.ndarray:
    """The most probable states (T, 2) of the log of the rod, by Gauss–Newton steps over all of them at once."""
    record, h = swing(noise=noise), 1 / RATE
    root = np.linalg.cholesky(0.25 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]))

    def residuals(flat):
        x = flat.reshape(-1, 2)
        moved = np.stack([rod_step(one, h) for one in x[:-1]])
        process = np.linalg.solve(root, (x[1:] - moved).T).ravel()
        return np.concatenate([(x[:, 0] - record.y[:, 0]) / noise, [x[0, 1] / 2.0], process])

    start = np.asarray(record.x).ravel()
    return scipy.optimize.least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-12).x.reshape(-1, 2)


KINDS = ["ekf", "ukf", "intrinsic-kalman"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_most_probable_motion_up_to_its_linearisation(kind):
    """Within a hundredth of a standard deviation, and with a tenth of the noise within a thousandth or so."""
    for noise, bound in ((0.02, 1e-2), (0.002, 2e-3)):
        smoothed = smooth(rod_filter(kind, noise), swing(noise=noise))
        errors = np.abs(np.asarray(smoothed.run.estimate) - best_motion(noise)).max(axis=0)
        assert (errors < bound * np.asarray(smoothed.std).mean(axis=0)).all()


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_the_covariance_is_never_above_that_of_the_filter(kind):
    smoothed, filtered = (smooth(rod_filter(kind), swing(), lag=lag) for lag in (None, 0))
    np.testing.assert_allclose(filtered.run.estimate, smoothed.filtered.estimate, rtol=0, atol=1e-12)
    before, after = (run.root @ jnp.swapaxes(run.root, 1, 2) for run in (filtered, smoothed))
    assert np.linalg.eigvalsh(before - after).min() > -1e-12
    assert (smoothed.std[:-1] < filtered.std[:-1]).all()
    np.testing.assert_allclose(smoothed.run.info.velocity_std, smoothed.std[:, 1:], rtol=1e-12)


@pytest.mark.exhaustive
def test_where_the_filter_starts_anew_rows_before_know_nothing_of_those_after():
    y = np.array(swing().y)
    y[20:] += 0.9  # the encoder slips, and the gate lets ten rows pass before it believes that
    other = np.array(y)
    other[31:] += 0.01
    slipped, changed = (smooth(rod_filter("intrinsic-kalman"), swing()._replace(y=y)) for y in (y, other))
    restarted = np.flatnonzero(np.asarray(slipped.run.info.result) == StepCode.RESTARTED)
    assert restarted.tolist() == [30]
    np.testing.assert_array_equal(slipped.run.estimate[:30], changed.run.estimate[:30])
    assert (np.abs(slipped.run.estimate - changed.run.estimate)[30] > 1e-4).all()
    np.testing.assert_array_equal(slipped.run.estimate[29], slipped.filtered.estimate[29])


SIZE, TICK = 8, 0.05
"""Rows of a block, and a tick, of the logs of faults."""


def faulty(ticks: bool) -> Record:
    """A gap over a seam of blocks, refused readings on both sides of one, and a slip from a row before one on."""
    y = np.array(swing().y)
    y[SIZE - 2 : SIZE + 2] = np.nan
    y[[2 * SIZE - 1, 2 * SIZE]] += 0.7
    y[2 * SIZE + 4 :] += 0.9
    return swing()._replace(y=np.round(y / TICK) * TICK if ticks else y)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("ticks", "lag"), [(True, None), (False, 2 * SIZE + 3)])
def test_blocks_make_no_difference(monkeypatch, ticks, lag):
    """Over gaps, refused readings, new starts and ticks at their seams, and with a lag of more than a block."""
    encoder = {"quantum": (TICK,)} if ticks else {}
    observer, record = rod_filter("intrinsic-kalman", gate=observers.Gate(patience=4), **encoder), faulty(ticks)
    whole = smooth(observer, record, lag=lag)
    results = np.asarray(whole.filtered.info.result)
    assert {StepCode.COASTED, StepCode.OUTLIER, StepCode.RESTARTED} <= set(results.tolist())
    monkeypatch.setattr("covariant.observers.filters._smoother.BLOCK", SIZE)
    lengths = []
    block = _smoother._block
    monkeypatch.setattr(_smoother, "_block", lambda *a: (lengths.append(len(a[2].dt)), block(*a))[1])
    blocked = smooth(observer, record, lag=lag)
    assert lengths == [SIZE + 1 + (lag or 0)] * 5  # the rows that are in memory at once
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), blocked, whole)


@pytest.mark.exhaustive
def test_only_what_is_asked_for_is_stored():
    whole, less = (smooth(rod_filter("ekf"), swing(), keep=keep) for keep in (None, ("velocity_std",)))
    assert less.root is less.run.info.innovation is None
    np.testing.assert_array_equal(less.std, whole.std)
    np.testing.assert_allclose(whole.std**2, np.einsum("tij,tij->ti", whole.root, whole.root), rtol=1e-12)


@pytest.mark.exhaustive
def test_in_single_precision_it_stays_single_and_close():
    fine = smooth(rod_filter("intrinsic-kalman"), swing())
    single = jax.tree.map(lambda a: np.asarray(a, np.float32), swing())
    observer = jax.tree.map(
        lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a, rod_filter("intrinsic-kalman")
    )
    coarse = smooth(observer, single)
    assert coarse.run.estimate.dtype == coarse.root.dtype == jnp.float32
    np.testing.assert_allclose(coarse.run.estimate, fine.run.estimate, rtol=0, atol=2e-3 * np.asarray(fine.std).max())
    np.testing.assert_allclose(coarse.std, fine.std, rtol=1e-3)


@pytest.mark.exhaustive
def test_missing_rows_are_smoothed_across():
    y = np.array(swing().y)
    y[12:24] = np.nan
    smoothed = smooth(rod_filter("intrinsic-kalman"), swing()._replace(y=y))
    assert (smoothed.run.info.result[12:24] == StepCode.COASTED).all()
    assert (np.abs(smoothed.run.estimate - swing().x) < 4 * smoothed.std).all()
    # Both ends of the gap count: its middle is the least certain, and less certain than either end.
    spread = np.asarray(smoothed.run.info.velocity_std)[:, 0]
    assert spread[23] < 0.6 * smoothed.filtered.info.velocity_std[23, 0]
    assert spread[12:24].max() < 0.8 * smoothed.filtered.info.velocity_std[12:24].max()


@pytest.mark.exhaustive
def test_a_motion_without_uncertainty_is_refused_where_it_spoils_another():
    """What is certain but for rounding, beside a coordinate that is not."""
    model = Lagrangian(lambda q: jnp.eye(2), lambda q: jnp.sum(q**2), coordinates=("a", "b"))
    observer = UKF(model, jnp.diag(jnp.array([0.0, 0.5])), 4e-4 * jnp.eye(2), 0.0, gate=None, substeps=1)
    t = 0.01 * np.arange(120)
    y = np.cos(1.4 * t)[:, None] + 0.02 * np.random.default_rng(1).normal(size=(120, 2))
    with pytest.raises(ValueError, match="no uncertainty but for rounding"):
        smooth(observer, Record(t, np.zeros((120, 2)), y))


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["ekf", "intrinsic-kalman"])
def test_a_start_and_a_model_that_are_certain_leave_one_motion(kind):
    """Only the first position is uncertain, and every covariance is singular."""
    process, measurement = jnp.zeros((1, 1)), 4e-4 * jnp.eye(1)
    observer = {
        "ekf": lambda: EKF(rod(), process, measurement, 0.0, substeps=1, gate=None),
        "intrinsic-kalman": lambda: IntrinsicKalman(rod(), process, measurement, process, substeps=1, gate=None),
    }[kind]()
    smoothed = smooth(observer, swing(speed=0.0))
    x = np.asarray(smoothed.run.estimate)
    np.testing.assert_allclose(x[0, 1], 0.0, atol=1e-12)
    assert (smoothed.std <= smooth(observer, swing(speed=0.0), lag=0).std + 1e-12).all()
    moved = np.stack([rod_step(one, 1 / RATE) for one in x[:-1]])
    np.testing.assert_allclose(x[1:], moved, rtol=0, atol=2e-3)  # a motion of the model, to its linearisation


@pytest.mark.exhaustive
def test_one_program_serves_logs_of_similar_lengths(monkeypatch):
    """Which takes seconds to compile; and rows that are added change nothing."""
    lengths, block = set(), _smoother._block

    def counted(observer, state, rows, *rest):
        lengths.add(len(rows.dt))
        return block(observer, state, rows, *rest)

    monkeypatch.setattr(_smoother, "_block", counted)
    ekf = EKF(models.oscillator(), jnp.eye(1), 1e-4 * jnp.eye(1), SPEED, substeps=1)
    t, u, y = log()[:3]
    for count in (56, 49):
        part = Record(t[:count], u[:count, :1], y[:count, :1])
        result = smooth(ekf, part)
        assert len(result.run.t) == len(result.run.estimate) == len(result.std) == count
        np.testing.assert_allclose(result.run.estimate[-1], result.filtered.estimate[-1], rtol=1e-12)
    assert lengths == {57}
    monkeypatch.setattr(_smoother, "rounded_up", lambda count: count)
    for exact, rounded in zip(jax.tree.leaves(smooth(ekf, part)), jax.tree.leaves(result), strict=True):
        np.testing.assert_allclose(exact, rounded, rtol=1e-9, atol=1e-12)
