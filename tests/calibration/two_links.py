"""A two-link arm in closed form, the `double_pendulum` with friction, rotors and a load: many runs at once."""

from typing import NamedTuple

import numpy as np
from plain import rk4

GRAVITY, V0 = 9.81, 0.02
M1, C1, I1, M2, C2, I2, L1 = 0.6, 0.17, 0.0052, 0.4, 0.13, 0.0025, 0.3
"""Masses, centres of mass, inertias about these, and length of the first link, as in the URDF file."""


class Truth(NamedTuple):
    """Friction, rotors, a load at the end of the second link, torque constants and encoder offsets of both joints."""

    viscous: tuple[float, float] = (0.3, 0.06)
    coulomb: tuple[float, float] = (0.2, 0.08)
    asymmetry: tuple[float, float] = (0.04, -0.02)
    stribeck: tuple[float, float] = (0.0, 0.0)
    armature: tuple[float, float] = (0.01, 0.004)
    load: float = 0.0
    reach: float = 0.25
    constants: tuple[float, float] = (1.0, 1.0)
    offsets: tuple[float, float] = (0.0, 0.0)


def swing(runs: int, truth: Truth, seconds: float, rate: float = 500.0, torque_noise: float = 0.02, seed: int = 0):
    """Stamps (T,), inputs (runs, T, 2) and encoder readings (runs, T, 2) with 0.1 mrad of noise.

    Inputs are sums of two sines with other phases in each run, held between stamps; an unknown torque is correlated
    over a few samples. Fourth-order Runge–Kutta, eight steps in a sample.
    """
    rng, substeps, noise = np.random.default_rng(seed), 8, 1e-4
    t, h = np.arange(int(seconds * rate)) / rate, 1 / rate / substeps
    phases = rng.uniform(0, 2 * np.pi, (runs, 2, 2))
    parts = ((2.2, (0.35, 0.9)), (0.5, (0.5, 1.3)))
    u = np.stack(
        [
            sum(size * np.sin(2 * np.pi * f * t + phases[:, j, i, None]) for i, f in enumerate(frequencies))
            for j, (size, frequencies) in enumerate(parts)
        ],
        axis=2,
    )
    q, v, unknown = np.tile([0.3, -0.4], (runs, 1)), np.zeros((runs, 2)), np.zeros((runs, 2))
    y = np.empty_like(u)
    for k in range(len(t)):
        y[:, k] = q
        unknown = 0.8 * unknown + 0.6 * torque_noise * rng.normal(size=unknown.shape)
        torque = np.array(truth.constants) * u[:, k] + unknown
        q, v = moved(truth, q, v, torque, h, substeps)
    return t, u, y - np.array(truth.offsets) + noise * rng.normal(size=y.shape)


def moved(truth: Truth, q, v, torque, h: float, steps: int):
    """Positions and velocities after some steps of a time under a torque."""
    x = np.array([q, v])
    for _ in range(steps):
        x = rk4(lambda x: np.array([x[1], accelerate(truth, *x, torque)]), x, h)
    return x


def accelerate(truth: Truth, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Accelerations (runs, 2), from Lagrange's equations of two links that hang at q = 0."""
    (q1, q2), (v1, v2), load = q.T, v.T, truth.load
    both, second = M2 + load, M2 * C2 + load * truth.reach  # what hangs at the elbow, and its first moment
    about = I2 + M2 * C2**2 + load * truth.reach**2
    across = L1 * second * np.cos(q2)
    m11 = I1 + M1 * C1**2 + about + both * L1**2 + 2 * across + truth.armature[0]
    m12, m22 = about + across, about + truth.armature[1]
    turning = L1 * second * np.sin(q2)
    weight = second * GRAVITY * np.sin(q1 + q2)
    sign = np.tanh(v / V0)
    dry = np.array(truth.coulomb) + np.array(truth.stribeck) * np.exp(-((v / 0.1) ** 2))
    friction = np.array(truth.viscous) * v + dry * sign + np.array(truth.asymmetry) * sign**2
    r1 = torque[:, 0] + turning * (2 * v1 * v2 + v2**2) - (M1 * C1 + both * L1) * GRAVITY * np.sin(q1) - weight
    r2 = torque[:, 1] - turning * v1**2 - weight
    r1, r2 = r1 - friction[:, 0], r2 - friction[:, 1]
    return np.stack([m22 * r1 - m12 * r2, m11 * r2 - m12 * r1], axis=1) / (m11 * m22 - m12**2)[:, None]
