"""A double pendulum with two servos: its model file, and the machine itself, written out by hand."""

import functools
from math import cos, sin, tanh

import numpy as np

from covariant.signals import Record

TEXT = """system = "robot"

[parameters]
path = "double_pendulum"

[servo.shoulder]
stiffness = 40.0
damping = 1.0
feedforward = 0.4
delay = 0.037
dead_band = 0.01
limit = 6.0
back_emf = 0.5
viscous = 0.2
coulomb = 0.3
armature = 0.03
switch = true

[servo.elbow]
stiffness = 20.0
damping = 0.4
delay = 0.012
dead_band = 0.01
limit = 3.0
back_emf = 0.2
viscous = 0.1
coulomb = 0.15
armature = 0.02

[measurement]
std = 1e-3

[uncertainty]
acceleration = 2.0
motion_acceleration = 100.0
motion_time = 0.1
"""
STEP = 5e-4
"""Step of the simulation [s], of which delays and rows are multiples."""
SMOOTHING = 0.02


def _acceleration(q, v, command, on, push):
    m2, lever, gravity = 0.4, 0.4 * 0.3 * 0.13, 9.81
    first, second = 0.0052 + 0.6 * 0.17**2 + m2 * 0.3**2, 0.0025 + m2 * 0.13**2
    weight = m2 * 0.13 * gravity * sin(q[0] + q[1])
    torque = [push[0] - (0.6 * 0.17 + m2 * 0.3) * gravity * sin(q[0]) - weight, push[1] - weight]
    torque[0] += lever * sin(q[1]) * (2 * v[0] * v[1] + v[1] ** 2)
    torque[1] -= lever * sin(q[1]) * v[0] ** 2
    for i, (k, d, limit, back, viscous, coulomb, switch) in enumerate(
        ((40.0, 1.0, 6.0, 0.5, 0.2, 0.3, on), (20.0, 0.4, 3.0, 0.2, 0.1, 0.15, 1.0))
    ):
        error = command[i] - q[i]
        error -= max(-0.01, min(0.01, error))
        torque[i] += switch * (max(-limit, min(limit, k * error - d * v[i])) - back * v[i])
        torque[i] -= viscous * v[i] + coulomb * tanh(v[i] / SMOOTHING)
    both = second + lever * cos(q[1])
    m11, m22 = first + second + 2 * lever * cos(q[1]) + 0.03, second + 0.02
    over = m11 * m22 - both**2
    return (m22 * torque[0] - both * torque[1]) / over, (m11 * torque[1] - both * torque[0]) / over


def moves(row: float, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Commands with jumps, the switch of the shoulder, off for a second, and a torque of 0.4 N m on the elbow."""
    t = row * np.arange(rows)
    shoulder = 0.6 * np.sin(1.3 * t) + 0.3 * np.sign(np.sin(0.9 * t + 0.1))
    elbow = 0.5 * np.sin(2.1 * t + 1) - 0.3 * np.sign(np.sin(0.6 * t))
    on = np.where((t > 6) & (t < 7), 0.0, 1.0)
    return np.stack([shoulder, elbow, on], axis=1), 0.4 * ((t > 9) & (t < 11))


@functools.cache
def run(row: float = 0.02, rows: int = 601, pushed: bool = False) -> tuple[Record, np.ndarray]:
    """A log with commands, and its true states (T, 4)."""
    u, push = moves(row, rows)
    each, x, states = round(row / STEP), [u[0, 0], u[0, 1], 0.0, 0.0], []
    for k in range((rows - 1) * each + 1):
        if k % each == 0:
            states.append(x)
        ago = [max((k - round(late / STEP)) // each, 0) for late in (0.037, 0.012, 0.0)]
        # The servo is ahead by 0.4 / 40 s times the change of the command over a row.
        ahead = 0.01 * (u[ago[0], 0] - u[max(ago[0] - 1, 0), 0]) / row
        given = (u[ago[0], 0] + ahead, u[ago[1], 1]), u[ago[2], 2], (0.0, push[k // each] * pushed)

        def slope(x, given=given):
            return [x[2], x[3], *_acceleration(x[:2], x[2:], *given)]

        def moved(by, h, x=x):
            return [a + h * b for a, b in zip(x, by, strict=True)]

        k1 = slope(x)
        k2 = slope(moved(k1, STEP / 2))
        k3 = slope(moved(k2, STEP / 2))
        k4 = slope(moved(k3, STEP))
        x = moved([(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)], STEP)
    x = np.array(states)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(rows, 2))
    return Record(row * np.arange(rows), u, x[:, :2] + noise), x
