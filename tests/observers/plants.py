"""Machines that several tests watch, and the filter and smoother of textbooks for those that are linear."""

import math

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, Lagrangian

MASS = np.array([[2.0, 0.5], [0.5, 1.0]])
STIFFNESS = np.array([[30.0, -10.0], [-10.0, 20.0]])
DAMPING = np.array([[0.4, 0.1], [0.1, 0.3]])
PROCESS = np.array([[2.0, 0.4], [0.4, 1.0]])
MEASUREMENT = 1e-4 * np.array([[1.0, 0.6], [0.6, 2.0]])
SPEED = 0.7
"""Standard deviation of the first velocities."""
FIRST_COV = scipy.linalg.block_diag(MEASUREMENT, SPEED**2 * np.eye(2))
POSITIONS = np.eye(2, 4)


def masses() -> Lagrangian:
    """Two masses on springs and dampers, both coupled."""
    return Lagrangian(
        lambda q: jnp.asarray(MASS),
        lambda q: q @ jnp.asarray(STIFFNESS) @ q / 2,
        dissipation=lambda q, v: -jnp.asarray(DAMPING) @ v,
    )


def sphere_pendulum() -> Lagrangian:
    """A pendulum on a sphere, in its angles from the pole and around it: coordinates with a connection."""
    return Lagrangian(
        lambda q: jnp.diag(jnp.stack([jnp.ones(()), jnp.sin(q[0]) ** 2])),
        lambda q: 9.81 * jnp.cos(q[0]),
        coordinates=("inclination", "azimuth"),
    )


def body() -> GroupSystem:
    """A rigid body of three different moments of inertia."""
    return GroupSystem(SO3, jnp.diag(jnp.array([1.0, 2.0, 3.5])))


def taylor(a: np.ndarray, h: float, first: int = 0) -> np.ndarray:
    """What one Runge–Kutta step makes of a linear system: Σ hᵏ aᵏ⁻ᶠ/k! from k = first to 4."""
    powers = (h**k * np.linalg.matrix_power(a, k - first) / math.factorial(k) for k in range(first, 5))
    return np.sum(list(powers), axis=0)


def masses_steps(t: np.ndarray, u: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Transition, known change and noise covariance of each step of the masses, written a second time."""
    inverse, steps = np.linalg.inv(MASS), []
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ STIFFNESS, -inverse @ DAMPING]])
    for h, held in zip(np.diff(t), u, strict=False):
        noise = np.kron([[h**3 / 3, h**2 / 2], [h**2 / 2, h]], PROCESS)
        steps.append((taylor(a, h), taylor(a, h, 1)[:, 2:] @ inverse @ held, noise))
    return steps


def van_loan(rate: np.ndarray, density: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise covariance over a time of `x' = A x` with white noise (Van Loan 1978)."""
    n = len(rate)
    whole = scipy.linalg.expm(h * np.block([[-rate, density], [np.zeros((n, n)), rate.T]]))
    return whole[n:, n:].T, whole[n:, n:].T @ whole[:n, n:]


def kalman(first, cov, steps, y, output, noise):
    """Means (T, N) and covariances (T, N, N) after each row (Kalman 1960), whose missing entries are left out.

    The first row is that of the first mean and covariance.
    """
    x, means, covs = first, [first], [cov]
    for (transition, change, added), reading in zip(steps, y[1:], strict=True):
        x, cov = transition @ x + change, transition @ cov @ transition.T + added
        seen = np.isfinite(reading)
        c = output[seen]
        gain = np.linalg.solve(c @ cov @ c.T + noise[np.ix_(seen, seen)], c @ cov).T
        x, cov = x + gain @ (reading[seen] - c @ x), cov - gain @ c @ cov
        means.append(x)
        covs.append(cov)
    return np.array(means), np.array(covs)


def least_squares(first, first_cov, steps, y, output, noise):
    """Means and covariances of all states from all rows, by one orthogonal factorisation of them at once."""
    n, rows, slopes, values = len(first), len(steps) + 1, [], []

    def add(parts: dict[int, np.ndarray], value: np.ndarray, cov: np.ndarray) -> None:
        """Rows `Σ part x = value` with this covariance, by the index of the state."""
        slope = np.zeros((len(value), rows * n))
        for i, part in parts.items():
            slope[:, i * n : (i + 1) * n] = part
        root = np.linalg.cholesky(cov)
        slopes.append(scipy.linalg.solve_triangular(root, slope, lower=True))
        values.append(scipy.linalg.solve_triangular(root, value, lower=True))

    add({0: np.eye(n)}, first, first_cov)
    for k, (transition, change, cov) in enumerate(steps, 1):
        add({k: np.eye(n), k - 1: -transition}, change, cov)
        seen = np.flatnonzero(np.isfinite(y[k]))
        if seen.size:
            add({k: output[seen]}, y[k, seen], noise[np.ix_(seen, seen)])
    q, r = np.linalg.qr(np.concatenate(slopes))
    inverse = scipy.linalg.solve_triangular(r, np.eye(rows * n))
    roots = inverse.reshape(rows, n, rows * n)
    return (inverse @ q.T @ np.concatenate(values)).reshape(rows, n), roots @ np.swapaxes(roots, 1, 2)
