"""The smoother: the dense least squares of all rows where they are linear, the same in all coordinates, and consistent."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.models import Lagrangian
from covariant.observers import EKF, UKF, IntrinsicKalman, JointKalman, smooth
from covariant.signals import Record, Result

# Where everything is linear: the smoother is the least-squares solution over all rows.

MASS = np.array([[2.0, 0.5], [0.5, 1.0]])
STIFFNESS = np.array([[30.0, -10.0], [-10.0, 20.0]])
DAMPING = np.array([[0.4, 0.1], [0.1, 0.3]])
PROCESS = np.array([[2.0, 0.4], [0.4, 1.0]])
MEASUREMENT = 1e-4 * np.array([[1.0, 0.6], [0.6, 2.0]])
SPEED = 0.7
PUSH, TIME = np.array([1.5, 0.8]), 0.2
ROWS = 60


def masses() -> Lagrangian:
    return Lagrangian(
        lambda q: jnp.asarray(MASS),
        lambda q: q @ jnp.asarray(STIFFNESS) @ q / 2,
        dissipation=lambda q, v: -jnp.asarray(DAMPING) @ v,
    )


@functools.cache
def log() -> Record:
    """Irregular stamps, inputs, gaps of both coordinates, of one, of the other."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.002, 0.03, ROWS))
    y = 0.05 * np.cumsum(rng.normal(size=(ROWS, 2)), 0)
    y[20:25] = y[30:36, 0] = y[40:48:2, 1] = np.nan
    return Record(t, rng.normal(size=(ROWS, 2)), y)


def taylor(a: np.ndarray, h: float, first: int) -> np.ndarray:
    """What one Runge–Kutta step makes of a linear system: Σ hᵏ aᵏ⁻ᶠ/k! from k = first to 4."""
    powers = (h**k * np.linalg.matrix_power(a, k - first) / math.factorial(k) for k in range(first, 5))
    return np.sum(list(powers), axis=0)


def dense(record: Record, forced: bool, last: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Means (T, N) and covariances (T, N, N) of all states, by the normal equations of all rows up to `last`."""
    inverse = np.linalg.inv(MASS)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ STIFFNESS, -inverse @ DAMPING]])
    pushed = np.concatenate([np.zeros((2, 2)), inverse])
    n, rows = (6 if forced else 4), len(record.t) if last is None else last + 1
    normal, right = np.zeros((rows * n, rows * n)), np.zeros(rows * n)

    def add(slopes: dict[int, np.ndarray], value: np.ndarray, cov: np.ndarray) -> None:
        """Rows `Σ slope x = value` with this covariance, by the index of the state."""
        weight = np.linalg.inv(cov)
        for i, one in slopes.items():
            right[i * n : (i + 1) * n] += one.T @ weight @ value
            for j, other in slopes.items():
                normal[i * n : (i + 1) * n, j * n : (j + 1) * n] += one.T @ weight @ other

    first = np.zeros(n)
    first[:2] = record.y[0]
    covs = [MEASUREMENT, SPEED**2 * np.eye(2), *([np.diag(PUSH**2)] if forced else [])]
    add({0: np.eye(n)}, first, block(*covs))
    for k in range(1, rows):
        h = record.t[k] - record.t[k - 1]
        transition = taylor(a, h, 0)
        held = taylor(a, h, 1) @ pushed
        noise = np.block([[h**3 / 3 * PROCESS, h**2 / 2 * PROCESS], [h**2 / 2 * PROCESS, h * PROCESS]])
        if forced:
            decay, mean = math.exp(-h / TIME), TIME / h * (1 - math.exp(-h / TIME))
            transition = np.block([[transition, mean * held], [np.zeros((2, 4)), decay * np.eye(2)]])
            noise = block(noise, np.diag(PUSH**2) * (1 - decay**2))
        value = np.zeros(n)
        value[:4] = held @ record.u[k - 1]
        add({k: np.eye(n), k - 1: -transition}, value, noise)
        seen = np.flatnonzero(np.isfinite(record.y[k]))
        if seen.size:
            add({k: np.eye(n)[seen]}, record.y[k, seen], MEASUREMENT[np.ix_(seen, seen)])
    cov = np.linalg.inv(normal)
    blocks = np.stack([cov[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(rows)])
    return np.linalg.solve(normal, right).reshape(rows, n), blocks


def block(*parts: np.ndarray) -> np.ndarray:
    sizes = np.cumsum([0, *map(len, parts)])
    whole = np.zeros((sizes[-1], sizes[-1]))
    for part, start, end in zip(parts, sizes, sizes[1:], strict=False):
        whole[start:end, start:end] = part
    return whole


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


@pytest.mark.parametrize("name", ["ekf", "ukf", "intrinsic-kalman", "with a force"])
def test_of_a_linear_system_it_is_the_least_squares_solution_over_all_rows(name):
    smoothed = smooth(linear(name, masses()), log())
    means, covs = dense(log(), name == "with a force")
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


def test_with_a_lag_it_is_the_least_squares_solution_up_to_as_many_rows_later():
    lag = 7
    smoothed = smooth(linear("intrinsic-kalman", masses()), log(), lag=lag)
    for k in (0, 3, 19, 22, 33, ROWS - lag - 1, ROWS - 4, ROWS - 1):
        means, covs = dense(log(), forced=False, last=min(k + lag, ROWS - 1))
        np.testing.assert_allclose(smoothed.run.estimate[k], means[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(smoothed.root[k] @ smoothed.root[k].T, covs[k], rtol=1e-7, atol=1e-12)
