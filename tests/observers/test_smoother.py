"""The smoother: the least squares of all rows where they are linear, the same in all coordinates, and consistent."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from plain import rk4

from covariant import observers
from covariant._linalg import triangular_with_rank
from covariant.models import Lagrangian
from covariant.observers import EKF, UKF, IntrinsicKalman, smooth
from covariant.observers.filters._smoother import Step, backward_map
from covariant.signals import Record

# Where everything is linear: the smoother is the least-squares solution over all rows.

ROWS = 60


@functools.cache
def log() -> Record:
    """Irregular stamps, inputs, gaps of both coordinates, of one, of the other."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.002, 0.03, ROWS))
    y = 0.05 * np.cumsum(rng.normal(size=(ROWS, 2)), 0)
    y[20:25] = y[30:36, 0] = y[40:48:2, 1] = np.nan
    return Record(t, rng.normal(size=(ROWS, 2)), y)


# Where it is not linear.

RATE = 50.0


def rod() -> Lagrangian:
    """A pendulum that swings far, with friction."""
    return Lagrangian(
        lambda q: jnp.ones((1, 1), q.dtype),
        lambda q: -20.0 * jnp.cos(q[0]),
        dissipation=lambda q, v: -0.3 * v,
        circles=(0,),
    )


def swing(rows: int = 40, noise: float = 0.02, speed: float = 0.5) -> Record:
    """A noisy log of it, perturbed at every row; true positions and velocities are in `x`."""
    rng, h = np.random.default_rng(3), 1 / RATE
    states = [np.array([1.2, speed])]
    for _ in range(rows - 1):
        a = np.asarray(rod_step(states[-1], h))
        w = rng.normal(size=2)
        half = 0.5 * h**0.5 * w[0]
        states.append(a + np.array([h * half / 2 + 0.5 * h**1.5 / 12**0.5 * w[1], half]))
    x = np.array(states)
    return Record(h * np.arange(rows), np.zeros((rows, 1)), x[:, :1] + noise * rng.normal(size=(rows, 1)), x)


def rod_step(x: np.ndarray, h: float) -> np.ndarray:
    """One Runge–Kutta step, written a second time."""
    return rk4(lambda x: np.array([x[1], -20.0 * np.sin(x[0]) - 0.3 * x[1]]), x, h)


def rod_filter(kind: str, noise: float = 0.02, **named):
    if kind == "intrinsic-kalman":
        return IntrinsicKalman(rod(), 0.25, noise**2, 4.0, substeps=1, **named)
    process, measurement = 0.25 * jnp.eye(1), noise**2 * jnp.eye(1)
    return {"ekf": EKF, "ukf": UKF}[kind](rod(), process, measurement, 2.0, substeps=1, **named)


@pytest.mark.core(1)
@pytest.mark.parametrize("seed", range(5))
def test_a_row_that_depends_on_others_up_to_rounding_has_no_gain_of_its_own(seed):
    """Its rounding errors are no axis of their own, along which rows after it would have parts."""
    rng = np.random.default_rng(seed)
    before, flow = np.tril(rng.normal(size=(4, 4))), rng.normal(size=(4, 4))
    wide = np.concatenate([flow @ before, rng.normal(size=(4, 2))], axis=1)
    wide[2] = 0.3 * wide[0] - 1.7 * wide[1]
    carried, error = wide[:, :4], wide @ rng.normal(size=6)
    expected = before @ carried.T @ np.linalg.pinv(wide @ wide.T, rcond=1e-10) @ error
    root = triangular_with_rank(jnp.asarray(wide))
    arrays = (jnp.asarray(each) for each in (before, carried, root, error, np.eye(4), False))
    np.testing.assert_allclose(backward_map(Step(*arrays)).shift, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


# In other coordinates.


@pytest.mark.parametrize(
    ("observer", "lag", "words"),
    [
        (observers.Intrinsic(rod(), 4.0, 8.0), None, "Intrinsic has no covariance of its own to smooth by"),
        (observers.Delayed(rod_filter("ekf"), 0.1, RATE), None, "Delayed has no covariance"),
        (rod_filter("ekf"), -1, "lag must be a number of rows, 0 or more; got -1"),
    ],
)
def test_what_cannot_be_smoothed_is_refused(observer, lag, words):
    with pytest.raises(ValueError, match=words):
        smooth(observer, swing(), lag=lag)
