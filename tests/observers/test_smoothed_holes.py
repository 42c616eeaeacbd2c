"""A smoother across a hole at full motion: the most probable motion, on the right turn."""

import functools

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from test_smoother import RATE, rod, rod_step

from covariant.observers import EKF, smooth
from covariant.signals import Record

BEFORE, HOLE, ROWS = 20, 45, 80
DENSITY, NOISE, SPEED = 4.0, 0.002, 10.0


@functools.cache
def turning() -> Record:
    """A rod that turns, read modulo a turn, with a hole of .9 s; true positions and velocities are in `x`."""
    rng, h = np.random.default_rng(5), 1 / RATE
    states = [np.array([0.5, 10.5])]
    for _ in range(ROWS - 1):
        w = (DENSITY * h) ** 0.5 * rng.normal(size=2)
        states.append(rod_step(states[-1], h) + np.array([h * w[0] / 2 + h * w[1] / 12**0.5, w[0]]))
    x = np.array(states)
    y = (x[:, :1] + NOISE * rng.normal(size=(ROWS, 1)) + np.pi) % (2 * np.pi) - np.pi
    y[BEFORE : BEFORE + HOLE] = np.nan
    return Record(h * np.arange(ROWS), np.zeros((ROWS, 1)), y, x)


def rod_ekf(model) -> EKF:
    return EKF(model, DENSITY * jnp.eye(1), NOISE**2 * jnp.eye(1), SPEED, substeps=1)


@functools.cache
def best_motion() -> np.ndarray:
    """The most probable states (T, 2) by least squares over all of them at once, with the readings on the true turn."""
    record, h = turning(), 1 / RATE
    y = record.y[:, 0] + 2 * np.pi * np.round((record.x[:, 0] - record.y[:, 0]) / (2 * np.pi))
    read = np.isfinite(y)
    root = np.linalg.cholesky(DENSITY * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]))

    def residuals(flat):
        x = flat.reshape(-1, 2)
        moved = np.stack([rod_step(one, h) for one in x[:-1]])
        process = np.linalg.solve(root, (x[1:] - moved).T).ravel()
        return np.concatenate([(x[:, 0] - y)[read] / NOISE, [x[0, 1] / SPEED], process])

    found = scipy.optimize.least_squares(residuals, record.x.ravel(), xtol=1e-13, ftol=1e-13, gtol=1e-11)
    return found.x.reshape(-1, 2)


def test_across_a_hole_it_is_the_most_probable_motion():
    """Found without the true turn, although the filter is elsewhere at the end of the hole."""
    record, smoothed = turning(), smooth(rod_ekf(rod()), turning())
    x, best = np.asarray(smoothed.run.estimate), best_motion()
    best = best + np.array([2 * np.pi * np.round((x[0, 0] - best[0, 0]) / (2 * np.pi)), 0.0])
    errors = np.abs(x - best) / np.asarray(smoothed.std)
    assert errors.max() < 0.05
    missed = np.asarray(smoothed.filtered.estimate)[BEFORE + HOLE - 1] - best[BEFORE + HOLE - 1]
    assert abs(missed[1]) > 0.5
    (hole,) = smoothed.holes
    moved = (record.x[BEFORE + HOLE, 0] - record.x[BEFORE - 1, 0]) / (2 * np.pi)
    assert (hole.begin, hole.end, hole.coordinate) == (record.t[BEFORE - 1], record.t[BEFORE + HOLE], 0)
    assert abs(hole.turns - moved) < 0.01
    assert hole.probability > 0.95
