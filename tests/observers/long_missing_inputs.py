"""Over a hole in which readings and torques are lost a filter is as uncertain as it is wrong: what takes long."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_missing_inputs import rough

from covariant import Record, models
from covariant.calibration import missing_inputs
from covariant.engine import run_log
from covariant.models import Motion, advance
from covariant.observers import IntrinsicKalman, MissingInputs, smooth
from covariant.signals import StepCode

NOISE, DISTURBANCE, RATE = 1e-3, 0.05, 100.0


LENGTHS = (0.05, 0.1, 0.25, 0.5, 1.0)


PENDULUM = models.pendulum_chain((1.0,), (1.0,), viscous=(0.1,))


SEEDS = 4


def swinging(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """A torque that swings: five frequencies up to 1.5 Hz."""
    parts = [np.sin(2 * np.pi * rng.uniform(0.2, 1.5) * t + rng.uniform(0, 2 * np.pi)) for _ in range(5)]
    return 6 * np.sum(parts, axis=0)[:, None] / np.sqrt(2.5)


@jax.jit
def moved(u, kicks):
    def step(motion, row):
        later = advance(PENDULUM, 0.0, Motion(*motion), row[0], 1 / RATE, 4)
        return (later.q, later.v + row[1]), motion

    return jax.lax.scan(step, (jnp.zeros(1), jnp.zeros(1)), (u, kicks))[1]


@functools.cache
def driven(torque, seed: int, duration: float, lengths: tuple[float, ...] = LENGTHS):
    """A driven pendulum at full motion: record with holes, true velocity, and the rows in and after each length."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, duration, 1 / RATE)
    u = torque(rng, t)
    q, v = moved(u, DISTURBANCE * rng.normal(size=u.shape) / np.sqrt(RATE))
    y = np.asarray(q) + NOISE * rng.normal(size=u.shape)
    inside, after = ({length: np.zeros(len(t), bool) for length in lengths} for _ in range(2))
    begin, k = 2.0, 0
    while begin + max(lengths) + 0.6 < t[-1]:
        length = lengths[k % len(lengths)]
        end = begin + length
        inside[length] |= (t > begin + 1e-9) & (t < end - 1e-9)
        after[length] |= (t >= end - 1e-9) & (t < end + 0.5)
        begin, k = end + 1.5, k + 1
    hole = np.any(list(inside.values()), axis=0)
    u, y = np.where(hole[:, None], np.nan, u), np.where(hole[:, None], np.nan, y)
    return Record(t, u, y), np.asarray(v), inside, after


def kalman(record: Record, inputs: MissingInputs | None) -> IntrinsicKalman:
    one = jnp.eye(1)
    return IntrinsicKalman(PENDULUM, DISTURBANCE**2 * one, NOISE**2 * one, 16 * one, inputs=inputs)


def consistency(runs, truths, masks) -> float:
    """Mean squared velocity error over its variance."""
    squares = [
        ((np.asarray(run.estimate)[mask, 1:] - v[mask]) / np.asarray(run.info.velocity_std)[mask]) ** 2
        for run, v, mask in zip(runs, truths, masks, strict=True)
    ]
    return float(np.mean(np.concatenate(squares)))


@pytest.mark.exhaustive("rough")
@pytest.mark.parametrize("torque", [swinging, rough], ids=["swinging", "rough"])
def test_a_filter_is_as_wrong_in_a_hole_and_after_it_as_it_says(torque):
    logs = [driven(torque, seed, 120.0) for seed in range(SEEDS)]
    runs = [run_log(kalman(log[0], missing_inputs(log[0])), log[0], None, "c")[0] for log in logs]
    truths = [log[1] for log in logs]
    within, since = (
        [consistency(runs, truths, [log[part][length] for log in logs]) for length in LENGTHS] for part in (2, 3)
    )
    # Forty holes of each length: the mean square of as many Gaussian numbers is within these bounds in all but 1 %.
    assert all(0.5 < value < 1.7 for value in within), within
    assert 0.7 < np.mean(within) < 1.4, within
    assert all(0.7 < value < 1.4 for value in since), since


def test_without_a_word_on_inputs_it_is_wrong_by_many_deviations():
    log = driven(swinging, 0, 120.0)
    blind = run_log(kalman(log[0], None), log[0], None, "c")[0]
    assert consistency([blind], [log[1]], [log[2][0.25]]) > 20


def test_rows_that_are_missing_are_inputs_that_are_missing():
    """The estimate after a hole is the same whether its cells are empty or its rows are gone."""
    record = driven(swinging, 1, 20.0, (0.25,))[0]
    present = np.isfinite(record.u[:, 0])
    without = Record(record.t[present], record.u[present], record.y[present])
    inputs = missing_inputs(record)
    cells, rows = (run_log(kalman(each, inputs), each, None, "c")[0] for each in (record, without))
    estimates, deviations = np.asarray(cells.estimate)[present], np.asarray(cells.info.velocity_std)[present]
    np.testing.assert_allclose(np.asarray(rows.estimate)[:, 1], estimates[:, 1], atol=0.05)
    np.testing.assert_allclose(np.asarray(rows.info.velocity_std), deviations, rtol=0.2)
    assert not (np.asarray(rows.info.result) == StepCode.OUTLIER).any()


@pytest.mark.exhaustive
def test_the_smoother_reaches_over_a_hole():
    log = driven(swinging, 2, 40.0, (0.05, 0.25))
    smoothed = smooth(kalman(log[0], missing_inputs(log[0])), log[0], keep=("velocity_std", "result"))
    for length in (0.05, 0.25):
        rows = log[2][length]
        errors = [
            np.sqrt(np.mean((np.asarray(each.estimate)[rows, 1:] - log[1][rows]) ** 2))
            for each in (smoothed.run, smoothed.filtered)
        ]
        assert errors[0] < 0.5 * errors[1]


@pytest.mark.exhaustive
def test_a_filter_whose_inputs_are_known_is_what_it_was():
    record = driven(swinging, 3, 6.0, (0.05,))[0]
    record = Record(record.t[:200], record.u[:200], record.y[:200])
    numbers = MissingInputs(jnp.zeros(1), jnp.ones(1), jnp.ones(1), jnp.ones(1), 0.05)
    with_inputs, plain = (run_log(kalman(record, each), record, None, "c")[0] for each in (numbers, None))
    np.testing.assert_allclose(with_inputs.estimate, plain.estimate, atol=1e-12)
    np.testing.assert_allclose(with_inputs.info.velocity_std, plain.info.velocity_std, rtol=1e-9)
    assert with_inputs.info.slow.shape == plain.info.slow.shape == (200, 0)
