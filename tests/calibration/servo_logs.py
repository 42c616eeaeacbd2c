"""Simulated logs of an arm of two servos, right or with one fault, for counting what `diagnose` says of them.

The arm turns about the vertical with its first joint and lifts a weight with its second one. It is integrated in plain
NumPy with a step of 1 ms; dry friction stops a joint within a step where it can. Nothing of the library is used.
"""

from typing import Any, NamedTuple

import numpy as np

STEP = 1e-3
MASS, LENGTH, HUB, GRAVITY = 0.3, 0.2, 0.002, 9.81
TICK = 2 * np.pi / 4096
JOINTS = ("swivel", "lift")

URDF = f"""<robot name="arm"><link name="base"/>
<joint name="swivel" type="revolute"><parent link="base"/><child link="hub"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="10" velocity="10"/></joint>
<link name="hub"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="{HUB}" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<joint name="lift" type="revolute"><parent link="hub"/><child link="arm"/><axis xyz="0 -1 0"/>
<limit lower="-3" upper="3" effort="10" velocity="10"/></joint>
<link name="arm"><inertial><origin xyz="{LENGTH} 0 0"/><mass value="{MASS}"/>
<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>
"""
"""The joint `lift` is positive upwards, and 0 where the weight is out at the side."""


class Arm(NamedTuple):
    """Numbers of the servos, one for each joint."""

    stiffness: tuple[float, float] = (8.0, 12.0)
    damping: tuple[float, float] = (0.3, 0.35)
    friction: tuple[float, float] = (0.06, 0.09)
    armature: tuple[float, float] = (0.02, 0.025)
    offset: tuple[float, float] = (0.01, -0.015)
    limit: tuple[float, float] = (1e3, 1e3)
    delay: float = 0.02


class Made(NamedTuple):
    """A log, how it was made, and its exact motion in each row."""

    t: np.ndarray
    commands: np.ndarray
    readings: np.ndarray
    rates: np.ndarray
    arm: Arm
    exact: np.ndarray


def _commands(random: np.random.Generator, kind: str, t: np.ndarray) -> np.ndarray:
    """Commands (T, 2): a sum of sines, steps, or a chirp."""
    if kind == "steps":
        places = np.cumsum(random.uniform(0.7, 1.6, int(t[-1]) * 2))
        levels = random.uniform(-0.5, 0.5, (len(places) + 1, 2))
        return levels[np.searchsorted(places, t)]
    if kind == "chirp":
        phase = 2 * np.pi * (0.2 * t + 0.5 * (2.0 - 0.2) / t[-1] * t**2)
        return np.stack([0.3 * np.sin(phase), 0.25 * np.sin(0.83 * phase + 1)], axis=1)
    rates, phases = random.uniform(0.1, 1.6, (5, 2)), random.uniform(0, 2 * np.pi, (5, 2))
    sizes = random.uniform(0.05, 0.2, (5, 2)) / np.maximum(rates, 0.5)
    return np.einsum("kj,tkj->tj", sizes, np.sin(2 * np.pi * rates * t[:, None, None] + phases))


def simulate(
    arm: Arm, t: np.ndarray, commands: np.ndarray, strength: Any = None, gain: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and rates (T, 2) at stamps; `strength(t)` multiplies torques, and `gain(t)` the stiffness."""
    substeps = int(np.ceil((t[1] - t[0]) / STEP - 1e-9))
    q, v = commands[0] * 1.0, np.zeros(2)
    positions, rates, drawn = [], [], MASS * LENGTH**2
    k, d, f, rotor, offset, limit = (np.array(x) for x in arm[:6])
    for row in range(len(t)):
        positions.append(q)
        rates.append(v)
        dt = (t[min(row + 1, len(t) - 1)] - t[row]) / substeps
        for sub in range(substeps if row + 1 < len(t) else 0):
            now = t[row] + sub * dt
            command = commands[max(np.searchsorted(t, now - arm.delay + 1e-9, side="right") - 1, 0)]
            on = 1.0 if strength is None else np.asarray(strength(now))
            stiffness = k if gain is None else k * gain(now)
            cosine, sine = np.cos(q[1]), np.sin(q[1])
            inertia = np.array([HUB + drawn * cosine**2, drawn]) + rotor
            coupling = drawn * cosine * sine * np.array([-2 * v[0] * v[1], v[0] ** 2])
            weight = np.array([0.0, MASS * GRAVITY * LENGTH * cosine])
            torque = on * np.clip(stiffness * (command + offset - q) - d * v, -limit, limit)
            free = v + dt / inertia * (torque - coupling - weight)
            v = np.sign(free) * np.maximum(np.abs(free) - dt * f / inertia, 0.0)
            q = q + dt * v
    return np.array(positions), np.array(rates)


def read(positions: np.ndarray) -> np.ndarray:
    """Readings of encoders."""
    return np.round(positions / TICK) * TICK


def made(
    seed: int,
    kind: str = "",
    arm: Arm | None = None,
    strength: Any = None,
    gain: Any = None,
    duration: float = 20.0,
    rate: float = 0.0,
) -> Made:
    """A log without faults; where they are not stated, its kind, rate and servos depend on the seed."""
    random = np.random.default_rng(300 + seed)
    kind = kind or ("sines", "steps", "chirp")[seed % 3]
    rate = rate or (50.0, 100.0, 200.0)[int(random.integers(3))]
    factors = random.uniform(0.7, 1.4, (4, 2))
    arm = arm or Arm()._replace(
        **{name: tuple(np.array(getattr(Arm(), name)) * factors[i]) for i, name in enumerate(Arm._fields[:4])},
        delay=float(random.uniform(0.01, 0.05)),
    )
    t = np.arange(0.0, duration, 1 / rate)
    commands = _commands(random, kind, t)
    q, v = simulate(arm, t, commands, strength, gain)
    return Made(t, commands, read(q), v, arm, q)


class Fault(NamedTuple):
    """A log with a fault: the name of its finding, and the joint concerned, or "" for both."""

    t: np.ndarray
    commands: np.ndarray
    readings: np.ndarray
    name: str
    joint: str
    arm: Arm


def with_fault(kind: str, seed: int) -> Fault:
    """A log with a fault of one joint; the time from which it holds depends on the seed as well."""
    random = np.random.default_rng(seed + 77)
    joint, time = int(random.integers(2)), float(random.uniform(7, 14))
    one, log, until = np.eye(2)[joint], made(seed), 99.0
    t, c, y, arm = log.t, log.commands.copy(), log.readings.copy(), log.arm
    rows = np.arange(len(t))
    match kind:
        case "off":
            until = time + float(random.uniform(2, 5)) if random.random() < 0.5 else until
            y = made(seed, strength=lambda now: 1 - one * (time <= now < until)).readings
        case "gain":
            factor = float(random.choice([0.4, 0.6, 1.7, 2.5])) - 1
            y = made(seed, gain=lambda now: 1 + factor * one * (now >= time)).readings
        case "zero":
            y[t >= time, joint] += TICK * int(random.choice([-1, 1]) * random.uniform(15, 60))
        case "limit":
            late = c[np.maximum(rows - int(np.ceil(arm.delay / t[1])), 0)]
            torque = np.array(arm.stiffness) * (late + arm.offset - log.exact) - np.array(arm.damping) * log.rates
            least = 0.6 * np.quantile(np.abs(torque), 0.995, axis=0)
            least[1] = max(least[1], 0.75)  # it carries its weight
            arm = arm._replace(limit=tuple(np.where(one > 0, least, 1e3)))
            y = made(seed, arm=arm, rate=1 / t[1]).readings
        case "sign":
            c[:, joint] *= -1
        case "degrees":
            c = np.rad2deg(c)
        case "degrees of one":
            c[:, joint] = np.rad2deg(c[:, joint])
        case "ticks":
            c = np.round(c / TICK) + 2048
        case "swapped":
            c = c[:, ::-1]
        case "wrapped":
            c[:, joint] = (c[:, joint] + 0.2) % (2 * np.pi) - 0.2
        case "row early":
            c = c[np.minimum(rows + 1, len(t) - 1)]
        case "row late":
            c = c[np.maximum(rows - 1, 0)]
        case "held":
            y = y[rows // 2 * 2]
    both = kind in ("degrees", "ticks", "swapped", "row early", "row late", "held")
    return Fault(t, c, y, NAMES[kind], "" if both else JOINTS[joint], arm)


NAMES = {
    "off": "servo off",
    "gain": "gain of a servo",
    "zero": "zero of a servo",
    "limit": "limit of a servo",
    "sign": "sign of a command",
    "degrees": "unit of a command",
    "degrees of one": "unit of a command",
    "ticks": "unit of a command",
    "swapped": "swapped commands",
    "wrapped": "period of a command",
    "row early": "delay of a command",
    "row late": "delay of a command",
    "held": "repeated rows",
}
"""Findings by the fault that they name."""
