"""Smoothed logs with long holes at full motion: right turns, certainty, velocities, and readings that repeat."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_smoothed_holes import BEFORE, HOLE, ROWS, rod_ekf, turning
from test_smoother import rod

import covariant
from covariant.models import Lagrangian
from covariant.observers import UKF, IntrinsicKalman, smooth
from covariant.scoring import unwrap

H, TICK = 0.01, 2 * np.pi / 4096
READING = TICK**2 / 12 + 1e-8


def run_off(seed: int, hole: int) -> tuple[covariant.Record, np.ndarray]:
    """A log of a rod with 5 % more gravity, 30 % more friction and an acceleration that no model has, and the truth."""
    rng = np.random.default_rng(seed)
    x, w = np.array([rng.uniform(-3, 3), rng.choice([-1, 1]) * rng.uniform(6, 12)]), 6 * rng.normal()
    states, d = [], H / 10
    for _ in range(160 + hole):
        states.append(x)
        for _ in range(10):
            w += -w * d / 0.3 + 6 * (2 * d / 0.3) ** 0.5 * rng.normal()
            a = -21.0 * np.sin(x[0]) - 0.39 * x[1] + w
            x = x + d * np.array([x[1] + d / 2 * a, a])
    true = np.array(states)
    y = (np.round(true[:, :1] / TICK) * TICK + np.pi) % (2 * np.pi) - np.pi
    y[100 : 100 + hole] = np.nan
    return covariant.Record(H * np.arange(len(y)), np.zeros((len(y), 1)), y), true


@pytest.mark.parametrize(
    ("hole", "runs", "bound"),
    [(50, 6, 0.2), (100, 8, 0.25)]
    + [pytest.param(*each, marks=pytest.mark.exhaustive) for each in ((50, 30, 0.15), (100, 200, 0.2))],
)
def test_turns_are_right_and_velocities_close(hole, runs, bound):
    """Readings fewer than eight and turns below a probability of .95 count as unknown; none that is sure is wrong."""
    kalman = IntrinsicKalman(rod(), 4.5**2, READING, 100.0, substeps=1)
    errors, within, sure, inside = [], [], 0, slice(100, 100 + hole)
    for seed in range(runs):
        record, true = run_off(seed, hole)
        smoothed = smooth(kalman, record)
        x, filtered = (np.asarray(run.estimate) for run in (smoothed.run, smoothed.filtered))
        v = x[inside, 1] - true[inside, 1]
        errors.append([np.mean(v**2), np.mean((filtered - true)[inside, 1] ** 2)])
        within.append(np.abs(v) < 1.96 * np.asarray(smoothed.std)[inside, 1])
        right = abs((x[100 + hole] - x[99] - true[100 + hole] + true[99])[0]) < 1
        certain = all(each.probability > 0.95 for each in smoothed.holes)
        assert right or not certain
        sure += certain
    smoother, filtered = np.sqrt(np.mean(errors, axis=0))
    assert smoother < bound * filtered
    assert np.mean(within) > 0.9
    assert sure > 0.9 * runs


def test_readings_that_repeat_are_found_on_their_turn():
    """A coordinate that is no circle, whose jumps by a period were removed as if the hole were short."""
    free = Lagrangian(rod().space.matrix, rod().potential, dissipation=lambda q, v: -0.3 * v)
    record = turning()
    y = unwrap(np.asarray(record.y), (), (2 * np.pi,))
    smoothed = smooth(rod_ekf(free), record._replace(y=y), period=(2 * np.pi,))
    (hole,) = smoothed.holes
    # The filter refuses the first readings on the wrong turn, which count as missing.
    begin, end = np.searchsorted(record.t, [hole.begin, hole.end])
    true = np.asarray(record.x)
    assert begin == BEFORE - 1 <= end <= BEFORE + HOLE + 3
    assert abs(hole.turns - (true[end, 0] - true[begin, 0]) / (2 * np.pi)) < 0.01
    assert hole.probability > 0.95
    off = np.asarray(smoothed.run.estimate) - true - [(y - true[:, :1])[0, 0], 0.0]
    assert (np.abs(off) < 5 * np.asarray(smoothed.std)).all()


def test_missing_rows_are_as_rows_without_readings():
    record = turning()
    rows = np.r_[0:BEFORE, BEFORE + HOLE : ROWS]
    fewer = smooth(rod_ekf(rod()), covariant.Record(*(a[rows] for a in (record.t, record.u, record.y))))
    whole = smooth(rod_ekf(rod()), record)
    np.testing.assert_allclose(fewer.run.estimate, np.asarray(whole.run.estimate)[rows], rtol=0, atol=1e-3)
    np.testing.assert_allclose(fewer.holes[0], whole.holes[0], rtol=1e-3)


def test_sigma_points_lead_across_too():
    process, noise = 4.0 * jnp.eye(1), 0.002**2 * jnp.eye(1)
    by_points = smooth(UKF(rod(), process, noise, 10.0, substeps=1), turning())
    by_slopes = smooth(rod_ekf(rod()), turning())
    inside = slice(BEFORE, BEFORE + HOLE)
    off = np.asarray(by_points.run.estimate - by_slopes.run.estimate)[inside] / np.asarray(by_slopes.std)[inside]
    assert np.abs(off).max() < 0.05


def test_the_command_says_which_turn(tmp_path):
    model = tmp_path / "pendulum.toml"
    model.write_text(
        'system = "pendulum_chain"\n[parameters]\nmass = [1.0]\nlength = [0.5]\nviscous = [0.05]\n'
        '[columns]\nt = "t"\nq = ["q1"]\nu = ["u1"]\n[measurement]\nstd = 2e-3\n[uncertainty]\nacceleration = 10.0\n'
    )
    log = covariant.simulate(model, duration=5.0, rate=100.0, q0=[1.0], v0=[14.0], noise=2e-3, seed=1).record
    y = np.array(log.y)
    y[200:300] = np.nan
    result = covariant.smooth(model, log._replace(y=y))
    (turn,) = result.turns
    moved = (np.asarray(log.x)[300, 0] - np.asarray(log.x)[199, 0]) / (2 * np.pi)
    assert abs(turn["turns"] - moved) < 0.02
    assert turn["probability"] > 0.95
    assert "hole from 1.99 to 3 s: q1 moved by" in str(result)
    assert result.summary["turns"] == [turn]
