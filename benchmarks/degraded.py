"""How near `covariant tune` comes to the best gains and noise where a log has faults: prints the table of the page.

Run `COVARIANT_DATA=... python benchmarks/degraded.py` from the repository's root; without `COVARIANT_DATA` it takes the
simulated logs only, and says so. `--only ship` or `--only ship:noise` runs one log, or one log with one fault.

Each log gets one fault at a time. The model file is tuned to the first two thirds of that log, which is all that
`tune` sees, and velocities are judged on the last third: against the truth where the log is simulated, and otherwise
against slopes of the positions before the fault. "Best" are gains, and noise of an extended Kalman filter, that a
search finds on the judged rows themselves with these velocities known: nobody can know them beforehand.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import covariant
from covariant import calibration, engine, logs, models, observers, scoring, simulation
from covariant.calibration import DataSheet
from covariant.observers import AbstractObserver

LOW_RATE = 40.0
"""Rate [Hz] to which a log is thinned."""
CRAFT = models.marine.cybership()
COUNTS = 256
"""Counts a turn of a coarse encoder."""
TRIPLE = {
    "mass": (0.5, 0.4, 0.3),
    "length": (0.3, 0.25, 0.2),
    "com": (0.15, 0.12, 0.1),
    "inertia": (4e-3, 3e-3, 2e-3),
    "viscous": (0.01, 0.01, 0.005),
}
"""Parameters of the triple pendulum."""


class Clean(NamedTuple):
    """A log before its fault: model file, record, velocities (T, n) to judge by, and noise of a reading."""

    file: models.ModelFile
    record: covariant.Record
    v: np.ndarray
    std: float


class Faulty(NamedTuple):
    """A log with a fault: record, velocities (T, n) at its rows, and the rows (T,) that are judged."""

    record: covariant.Record
    v: np.ndarray
    judged: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, u: np.ndarray, y: np.ndarray, v: np.ndarray) -> "Faulty":
        judged = scoring.scored_window(t) & (t >= t[0] + 2 / 3 * (t[-1] - t[0])) & np.isfinite(v).all(axis=1)
        return cls(covariant.Record(t, u, y), v, judged)

    def error(self, v: np.ndarray) -> float:
        """Root mean square over all velocities, each as a fraction of its size."""
        off = np.asarray(v)[self.judged] - self.v[self.judged]
        size = np.sqrt(np.mean(self.v[self.judged] ** 2, axis=0))
        value = float(np.sqrt(np.mean((off / size) ** 2)))
        return value if np.isfinite(value) else np.inf


def noise(log: Clean, random: np.random.Generator) -> Faulty:
    """Ten times the noise."""
    t, u, y = map(np.asarray, log.record[:3])
    return Faulty.of(t, u, y + random.normal(0, 10 * log.std, y.shape), log.v)


def ticks(log: Clean, random: np.random.Generator) -> Faulty:
    """An encoder of 256 counts a turn; of a position in metres, as coarse against its noise."""
    t, u, y = map(np.asarray, log.record[:3])
    step = 2 * np.pi / COUNTS if log.std < 1e-3 else 10 * log.std
    return Faulty.of(t, u, step * np.round(y / step), log.v)


def slow(log: Clean, random: np.random.Generator) -> Faulty:
    """One row of several, so that a tenth or so are left."""
    t = np.asarray(log.record.t)
    every = max(2, round(1 / (LOW_RATE * float(np.median(np.diff(t)))))) if log.std < 1e-3 else 5
    return Faulty.of(*(np.asarray(column)[::every] for column in (*log.record[:3], log.v)))


def spikes(log: Clean, random: np.random.Generator) -> Faulty:
    """One reading of a hundred off by 100 to 500 standard deviations."""
    t, u, y = map(np.asarray, log.record[:3])
    size = log.std * random.uniform(100, 500, y.shape) * random.choice([-1.0, 1.0], y.shape)
    wrong = random.random(y.shape) < 0.01
    wrong[0] = False
    return Faulty.of(t, u, np.where(wrong, y + size, y), log.v)


def late(log: Clean, random: np.random.Generator) -> Faulty:
    """The first column of positions one row late."""
    t, u, y = map(np.asarray, log.record[:3])
    shifted = y.copy()
    shifted[1:, 0] = y[:-1, 0]
    return Faulty.of(t, u, shifted, log.v)


def gaps(log: Clean, random: np.random.Generator) -> Faulty:
    """A hole of 20 to 40 rows, at least .1 to .2 s, in every second or every 200 rows."""
    t, u, y = map(np.asarray, log.record[:3])
    step = float(np.median(np.diff(t)))
    hole, every = max(0.1, 20 * step), max(1.0, 200 * step)
    kept = np.ones(len(t), bool)
    for begin in np.arange(t[0] + every, t[-1], every):
        begin += random.uniform(0, every / 2)
        kept &= (t < begin) | (t > begin + hole * random.uniform(1, 2))
    return Faulty.of(t[kept], u[kept], y[kept], log.v[kept])


def jitter(log: Clean, random: np.random.Generator) -> Faulty:
    """Stamps that are off by a fifth of a step."""
    t, u, y = map(np.asarray, log.record[:3])
    step = float(np.median(np.diff(t)))
    return Faulty.of(t + np.clip(random.normal(0, 0.2 * step, len(t)), -0.45 * step, 0.45 * step), u, y, log.v)


FAULTS: dict[str, Callable[[Clean, np.random.Generator], Faulty]] = {
    "none": lambda log, random: Faulty.of(*(np.asarray(column) for column in (*log.record[:3], log.v))),
    "noise": noise,
    "coarse ticks": ticks,
    "low rate": slow,
    "outliers": spikes,
    "one column late": late,
    "gaps": gaps,
    "jittered stamps": jitter,
}


def recorded(spec: str, path: Path, until: float, every: int) -> Clean:
    """A recorded log, judged by slopes of all of its positions."""
    file = models.load(spec)
    record = logs.record(path, t=file.columns.t, q=file.columns.q, u=file.columns.u)
    t, u, y = map(np.asarray, record[:3])
    v = scoring.zero_phase_velocity(t, y, t, file.reference_half, int(file.reference_order))
    kept = np.flatnonzero(t <= t[0] + until)[::every]
    assert file.typical_std is not None
    return Clean(file, covariant.Record(t[kept], u[kept], y[kept]), v[kept], file.typical_std)


def triple() -> Clean:
    """A triple pendulum, driven at the first joint, with dry friction that its model does not know."""
    std = 2e-4
    file = models.ModelFile(
        "triple pendulum",
        models.pendulum_chain(**TRIPLE),
        measurement_std=std,
        acceleration_std=1.0,
        correlation_time=0.02,
    )
    log = covariant.simulate(
        models.pendulum_chain(**TRIPLE, coulomb=(0.01, 0.01, 0.005)),
        duration=10.0,
        rate=200.0,
        q0=[1.0, -0.5, 0.5],
        amplitude=[0.3, 0.0, 0.0],
        frequency=0.7,
        noise=std,
        seed=1,
    ).record
    return Clean(file, covariant.Record(*log[:3]), np.asarray(log.x)[:, 3:], std)


def turned(q: jax.Array) -> jax.Array:
    """The inertia (3, 3) of the ship as seen from the shore."""
    turn = models.marine.yaw_rotation(q[2])
    return turn @ CRAFT.mass @ turn.T


def pushed(t: jax.Array, q: jax.Array, u: jax.Array) -> jax.Array:
    """Forces of the thrusters, given in the ship, as seen from the shore."""
    return models.marine.yaw_rotation(q[2]) @ u


def drag(q: jax.Array, v: jax.Array) -> jax.Array:
    """Drag of the water, identified in the ship, as seen from the shore."""
    turn = models.marine.yaw_rotation(q[2])
    inside = turn.T @ v
    return -turn @ CRAFT.damping(inside) @ inside


def ship() -> Clean:
    """CyberShip II under known forces of its thrusters, pushed by wind and current that its model does not know."""
    std, random = 2e-3, np.random.default_rng(2)
    names = {"coordinates": ("north", "east", "heading"), "units": ("m", "m", "rad")}
    model = models.Lagrangian(turned, None, pushed, drag, (2,), **names)
    file = models.ModelFile(
        "ship", model, measurement_std=std, acceleration_std=0.01, correlation_time=1.0, reference_half=1.0
    )
    t = np.arange(1800) * 0.1
    pace = np.array([0.05, 0.067, 0.083])
    u = np.array([1.0, 0.5, 0.2]) * np.sin(2 * np.pi * pace * t[:, None])
    # A lasting force, and one that is forgotten within 20 s, each of half the size.
    decay = np.exp(-0.1 / 20)
    force = np.zeros((len(t), 3))
    for k in range(1, len(t)):
        force[k] = decay * force[k - 1] + np.sqrt(1 - decay**2) * random.normal(size=3)
    force = np.array([0.3, 0.2, 0.05]) * (1 + force)
    acting = simulation.hold(jnp.asarray(t), jnp.asarray(u + force))
    true = simulation.simulate(model, jnp.zeros(6), jnp.asarray(t), acting)
    y = np.asarray(true.y) + random.normal(0, std, (len(t), 3))
    return Clean(file, covariant.Record(t, u, y), np.asarray(true.x)[:, 3:], std)


def all_logs() -> dict[str, Callable[[], Clean]]:
    """Functions that make the logs, by name."""
    simulated = {"triple pendulum": triple, "ship": ship}
    data = os.environ.get("COVARIANT_DATA")
    if data is None:
        print("COVARIANT_DATA is not set: the double pendulum and the DFKI machine are left out.\n")
        return simulated
    double, dfki = Path(data) / "multiarm_pendulum/double.csv", Path(data) / "dfki_double_pendulum/A0_sysid_05.csv"
    return {
        "free double pendulum": lambda: recorded("examples/multiarm_double.toml", double, 12.0, 5),
        "DFKI A0": lambda: recorded("examples/dfki_double_pendulum.toml", dfki, 8.0, 2),
    } | simulated


LEAST_DAMPING = 0.3
"""The least damping ratio that `tune` takes, and the search too."""


def searched(
    log: Faulty,
    make: Callable[[float, float], AbstractObserver],
    at: Sequence[float],
    spans: Sequence[float],
    least: float = 0.0,
) -> float:
    """The least error over both numbers of an observer, by a grid that is made finer four times around the best."""
    n, best, numbers = log.v.shape[1], np.inf, (at[0], at[1])
    for _ in range(5):
        axes = [
            np.maximum(centre * np.exp(np.linspace(-span, span, count)), floor)
            for centre, span, count, floor in zip(numbers, spans, (9, 5), (0.0, least), strict=True)
        ]
        pairs = [(float(a), float(b)) for a in axes[0] for b in axes[1]]
        runs, _ = engine.run_logs([make(*pair) for pair in pairs], log.record, ("result",))
        errors = [log.error(np.asarray(run.estimate)[:, n:]) for run in runs]
        k = int(np.argmin(errors))
        if errors[k] < best:
            best, numbers = errors[k], pairs[k]
        spans = [span / 2.5 for span in spans]
    return best


def with_lines(file: models.ModelFile, lines: dict[str, dict[str, Any]]) -> models.ModelFile:
    """A model file with the lines that `tune` would write into it."""
    std = lines.get("measurement", {}).get("std")
    force, design = lines["uncertainty"], lines["design"]
    if std is not None:
        file = file._replace(quantum=None, measurement_std=tuple(std) if isinstance(std, list) else std)
    return file._replace(
        acceleration_std=force["acceleration"],
        correlation_time=force["correlation_time"],
        external_force=force.get("external_force"),
        damping=design["damping"],
        natural_frequency=design["natural_frequency"],
    )


class Entry(NamedTuple):
    """Velocity errors of the estimators on a log, and which candidate the tuned gains are."""

    file: float
    tuned: float
    best: float
    kalman: float
    ekf: float
    source: str

    @classmethod
    def of(cls, log: Faulty, file: models.ModelFile) -> "Entry":
        """Tune to the log, run all estimators and search for the best numbers."""
        model, n = file.need_mechanical(file.name, "this table has"), log.v.shape[1]
        result = covariant.tune(file, log.record)
        found, tuned = result.tuning, with_lines(file, result.lines)
        rate = 1 / float(np.median(np.diff(log.record.t)))
        std, density = float(np.sqrt(np.mean(found.noise.measurement**2))), float(found.noise.acceleration) ** 2
        speeds = calibration.usual_speeds(model, log.record)
        sheet = DataSheet(std, 1.0, speed=speeds)

        def error(file: models.ModelFile, observer: str) -> float:
            return log.error(covariant.estimate(file, log.record, observer=observer).velocity)

        def intrinsic(frequency: float, damping: float) -> AbstractObserver:
            observer = observers.Intrinsic(model, 2 * damping * frequency, frequency**2)
            return calibration.gated(observer, model, sheet)

        def ekf(std: float, density: float) -> AbstractObserver:
            return observers.EKF(model, density * jnp.eye(n), std**2 * jnp.eye(n), max(speeds))

        start = std, max(density, 1e-5 * std**2 * rate**3)
        return cls(
            error(file, "intrinsic"),
            error(tuned, "intrinsic"),
            searched(log, intrinsic, (found.natural_frequency, found.damping), (2.0, 1.2), LEAST_DAMPING),
            error(tuned, "intrinsic-kalman"),
            searched(log, ekf, start, (2.0, 6.0)),
            found.source,
        )

    def __str__(self) -> str:
        file, tuned, kalman = self.file / self.best, self.tuned / self.best, self.kalman / self.ekf
        return (
            f"{self.best:.5f} | {file:.2f} | {tuned:.2f} | {self.source} | {self.ekf:.5f} | {kalman:.2f} | "
            f"{self.kalman / self.best:.2f}"
        )


def rows(asked: str, available: dict[str, Callable[[], Clean]]) -> Iterable[str]:
    """Rows of the table, of all logs or of the one that is asked for."""
    chosen, _, fault = asked.partition(":")
    for name, make in available.items():
        if not name.startswith(chosen):
            continue
        clean = make()
        for k, (kind, spoil) in enumerate(FAULTS.items()):
            if kind.startswith(fault):
                yield f"| {name} | {kind} | {Entry.of(spoil(clean, np.random.default_rng([7, k])), clean.file)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="a log, or a log and a fault: ship:noise")
    began, available = time.perf_counter(), all_logs()
    print("| log | fault | best gains | model file | tuned | from | best EKF | tuned Kalman | against best gains |")
    print("|---|---|--:|--:|--:|---|--:|--:|--:|")
    for row in rows(parser.parse_args().only, available):
        print(row, flush=True)
    print(f"\n{time.perf_counter() - began:.0f} s")
