"""What velocities are worth where logs have faults and models do not know everything: prints the table of the pages.

Run `COVARIANT_DATA=... python benchmarks/degraded.py` from the repository's root; without `COVARIANT_DATA` it takes the
simulated logs only, and says so. `--only ship` or `--only ship:noise` runs one log, or one log with one fault;
`--twins` runs the logs of `twins.py` as they are, each of which has its fault already.

A log gets one fault at a time. The model file is tuned to the first two thirds of that log, which is all that `tune`
sees, and velocities are judged on the last third: against the truth where the log is simulated, and otherwise against
slopes of the positions before the fault. "Best" are gains, noise, bandwidths and windows that a search finds on the
judged rows themselves with these velocities known: nobody can know them beforehand.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter, savgol_coeffs
from twins import TWINS, Twin, ship, triple

import covariant
from covariant import calibration, engine, logs, models, observers, scoring
from covariant.calibration import DataSheet
from covariant.observers import REGISTRY, AbstractObserver

LOW_RATE = 40.0
"""Rate [Hz] to which a log is thinned."""
COUNTS = 256
"""Counts a turn of a coarse encoder."""
DEVIATIONS = 1.96
"""Standard deviations in half of a 95 % band."""
TENTH = 0.9
"""Quantile of the speed from which a row is of the fastest tenth."""


class Judged(NamedTuple):
    """A log, maybe with a fault: record, velocities (T, n) at its rows, and the rows (T,) that are judged."""

    record: covariant.Record
    v: np.ndarray
    judged: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, u: np.ndarray, y: np.ndarray, v: np.ndarray) -> "Judged":
        judged = scoring.scored_window(t) & (t >= t[0] + 2 / 3 * (t[-1] - t[0])) & np.isfinite(v).all(axis=1)
        return cls(covariant.Record(t, u, y), v, judged)

    def error(self, v: np.ndarray) -> float:
        """Root mean square over all velocities, each as a fraction of its size."""
        off = np.asarray(v)[self.judged] - self.v[self.judged]
        size = np.sqrt(np.mean(self.v[self.judged] ** 2, axis=0))
        value = float(np.sqrt(np.mean((off / size) ** 2)))
        return value if np.isfinite(value) else np.inf


def noise(log: Twin, random: np.random.Generator) -> Judged:
    """Ten times the noise."""
    t, u, y = map(np.asarray, log.record[:3])
    return Judged.of(t, u, y + random.normal(0, 10 * log.std, y.shape), log.v)


def ticks(log: Twin, random: np.random.Generator) -> Judged:
    """An encoder of 256 counts a turn; of a position in metres, as coarse against its noise."""
    t, u, y = map(np.asarray, log.record[:3])
    step = 2 * np.pi / COUNTS if log.std < 1e-3 else 10 * log.std
    return Judged.of(t, u, step * np.round(y / step), log.v)


def slow(log: Twin, random: np.random.Generator) -> Judged:
    """One row of several, so that a tenth or so are left."""
    t = np.asarray(log.record.t)
    every = max(2, round(1 / (LOW_RATE * float(np.median(np.diff(t)))))) if log.std < 1e-3 else 5
    return Judged.of(*(np.asarray(column)[::every] for column in (*log.record[:3], log.v)))


def spikes(log: Twin, random: np.random.Generator) -> Judged:
    """One reading of a hundred off by 100 to 500 standard deviations."""
    t, u, y = map(np.asarray, log.record[:3])
    size = log.std * random.uniform(100, 500, y.shape) * random.choice([-1.0, 1.0], y.shape)
    wrong = random.random(y.shape) < 0.01
    wrong[0] = False
    return Judged.of(t, u, np.where(wrong, y + size, y), log.v)


def late(log: Twin, random: np.random.Generator) -> Judged:
    """The first column of positions one row late."""
    t, u, y = map(np.asarray, log.record[:3])
    shifted = y.copy()
    shifted[1:, 0] = y[:-1, 0]
    return Judged.of(t, u, shifted, log.v)


def gaps(log: Twin, random: np.random.Generator) -> Judged:
    """A hole of 20 to 40 rows, at least .1 to .2 s, in every second or every 200 rows."""
    t, u, y = map(np.asarray, log.record[:3])
    step = float(np.median(np.diff(t)))
    hole, every = max(0.1, 20 * step), max(1.0, 200 * step)
    kept = np.ones(len(t), bool)
    for begin in np.arange(t[0] + every, t[-1], every):
        begin += random.uniform(0, every / 2)
        kept &= (t < begin) | (t > begin + hole * random.uniform(1, 2))
    return Judged.of(t[kept], u[kept], y[kept], log.v[kept])


def jitter(log: Twin, random: np.random.Generator) -> Judged:
    """Stamps that are off by a fifth of a step."""
    t, u, y = map(np.asarray, log.record[:3])
    step = float(np.median(np.diff(t)))
    return Judged.of(t + np.clip(random.normal(0, 0.2 * step, len(t)), -0.45 * step, 0.45 * step), u, y, log.v)


FAULTS: dict[str, Callable[[Twin, np.random.Generator], Judged]] = {
    "none": lambda log, random: Judged.of(*(np.asarray(column) for column in (*log.record[:3], log.v))),
    "noise": noise,
    "coarse ticks": ticks,
    "low rate": slow,
    "outliers": spikes,
    "one column late": late,
    "gaps": gaps,
    "jittered stamps": jitter,
}


def recorded(spec: str, path: Path, until: float, every: int) -> Twin:
    """A recorded log, judged by slopes of all of its positions."""
    file = models.load(spec)
    record = logs.record(path, t=file.columns.t, q=file.columns.q, u=file.columns.u)
    t, u, y = map(np.asarray, record[:3])
    v = scoring.zero_phase_velocity(t, y, t, file.reference_half, int(file.reference_order))
    kept = np.flatnonzero(t <= t[0] + until)[::every]
    return Twin(path.stem, file, covariant.Record(t[kept], u[kept], y[kept]), v[kept])


def all_logs() -> dict[str, Callable[[], Twin]]:
    """Functions that make the logs, by name."""
    simulated: dict[str, Callable[[], Twin]] = {"triple pendulum": triple, "ship": ship}
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
GRIDS = {1: (17,), 2: (9, 5), 3: (7, 5, 5)}
"""Points of a grid over the numbers of an observer, by how many these are."""


class Family(NamedTuple):
    """Observers that differ in a few numbers, over which is searched.

    Attributes:
        name: Name in the table.
        make: Constructs one of them from its numbers.
        at: Numbers that the search begins with.
        spans: Natural logarithm of the largest factor by which it first leaves each of them.
        least: Least value of each.
        informed: Whether they know the model.
    """

    name: str
    make: Callable[..., AbstractObserver]
    at: tuple[float, ...]
    spans: tuple[float, ...]
    least: tuple[float, ...]
    informed: bool = True

    def searched(self, log: Judged, model: models.MechanicalSystem) -> float:
        """The least error over all numbers, by a grid that is made finer around the best."""
        best, numbers, spans = np.inf, self.at, np.array(self.spans)
        counts = GRIDS[len(numbers)]
        # An arm costs ten times as much as a pendulum, and its optimum is as flat.
        for _ in range(5 if log.v.shape[1] <= 3 else 3):
            axes = [
                np.maximum(centre * np.exp(np.linspace(-span, span, count)), floor)
                for centre, span, count, floor in zip(numbers, spans, counts, self.least, strict=True)
            ]
            points = [tuple(map(float, point)) for point in np.stack(np.meshgrid(*axes), -1).reshape(-1, len(axes))]
            runs, _ = engine.run_logs([self.make(*point) for point in points], log.record, ("result",))
            errors = [log.error(model.motion(run.estimate).v) for run in runs]
            k = int(np.argmin(errors))
            if errors[k] < best:
                best, numbers = errors[k], points[k]
            spans = spans / 2.5
        return best


def informed(log: Judged, model: models.MechanicalSystem, tuning: Any, sheet: DataSheet) -> Iterator[Family]:
    """Observers that know the model: constant gains with a force, with and without a gate, and Kalman filters."""

    def gains(frequency: float, damping: float, rate: float) -> AbstractObserver:
        return observers.IntrinsicForce(model, 2 * damping * frequency, frequency**2, rate)

    def gated(frequency: float, damping: float, rate: float) -> AbstractObserver:
        return calibration.gated(gains(frequency, damping, rate), model, sheet)

    frequency, n = tuning.natural_frequency, log.v.shape[1]
    for name, make in (("constant gains", gains), ("constant gains, gate", gated)):
        yield Family(name, make, (frequency, 0.7, 0.1 * frequency), (2.0, 1.2, 3.0), (0.0, LEAST_DAMPING, 0.0))
    rate, std = 1 / float(np.median(np.diff(log.record.t))), sheet.measurement_std
    density = max(float(np.asarray(tuning.noise.acceleration)) ** 2, 1e-5 * std**2 * rate**3)
    speed, one = max(sheet.speeds), jnp.eye(n)
    yield Family(
        "EKF",
        lambda std, density: observers.EKF(model, density * one, std**2 * one, speed),
        (std, density),
        (2.0, 6.0),
        (0.0, 0.0),
    )
    if n <= 3 and model.manifold.commuting:
        size = float(np.sqrt(np.mean(np.gradient(log.v, log.record.t, axis=0) ** 2)))
        inertia = float(np.median(np.diag(np.asarray(model.metric(jnp.asarray(log.record.y[0]))))))

        def with_force(density: float, force: float, time: float) -> AbstractObserver:
            slow = observers.external_force(std=jnp.full(n, force), time=time)
            return observers.IntrinsicKalman(model, density * one, std**2 * one, speed**2 * one, (slow,))

        start = density, 0.3 * inertia * size, 0.3
        yield Family("Kalman filter, force", with_force, start, (6.0, 3.0, 3.0), (0.0, 0.0, 0.0))


def uninformed(log: Judged, model: models.MechanicalSystem, std: float) -> Iterator[Family]:
    """Filters without a model: those of the registry, and on a group constant gains for a body without forces."""
    n, rate = log.v.shape[1], 1 / float(np.median(np.diff(log.record.t)))
    size = float(np.sqrt(np.mean(np.gradient(log.v, log.record.t, axis=0) ** 2)))
    starts = {
        "bandwidth": ((0.1 * rate,), (3.5,)),
        "jerk": ((0.1 * size * rate,), (6.0,)),
        "motion": ((size, 0.05), (3.0, 3.0)),
    }
    for entry in REGISTRY:
        if entry.tuned_by in starts and entry.fits(model):
            at, spans = starts[entry.tuned_by]
            noise = (std,) if entry.tuned_by == "motion" else ()
            make = partial(lambda entry, noise, *numbers: entry.make(model, *numbers, *noise), entry, noise)
            yield Family(entry.name, make, at, spans, (0.0,) * len(at), False)
    if not model.manifold.commuting:
        free = models.GroupSystem(model.manifold, jnp.eye(n))

        def tracking(frequency: float, damping: float, rate: float) -> AbstractObserver:
            return observers.IntrinsicForce(free, 2 * damping * frequency, frequency**2, rate)

        start = 0.3 * rate, 0.7, 0.1 * rate
        yield Family("tracking loop", tracking, start, (2.0, 1.2, 3.0), (0.0, LEAST_DAMPING, 0.0), False)


def best_polynomial(log: Judged) -> float:
    """Least error of a Savitzky–Golay filter at the end of its window, over window and order; inf where none fits."""
    t, y = np.asarray(log.record.t), np.asarray(log.record.y)
    steps = np.diff(t)
    if y.ndim > 2 or np.ptp(steps) > 1e-3 * steps.mean():
        return np.inf
    best = np.inf
    for order in (1, 2, 3, 4):
        for window in range(order + 2 + (order + 1) % 2, 122, 2):
            weights = savgol_coeffs(window, order, deriv=1, delta=steps.mean(), pos=window - 1)
            best = min(best, log.error(lfilter(weights, 1.0, y - y[0], axis=0)))
    return best


def with_lines(file: models.ModelFile, lines: dict[str, dict[str, Any]]) -> models.ModelFile:
    """A model file with the lines that `tune` would write into it."""
    pairs = {f"{table}.{key}": value for table, numbers in lines.items() for key, value in numbers.items()}
    return models.load(file, pairs)


class Entry(NamedTuple):
    """Velocity errors of the estimators on a log, as parts of the velocities.

    Attributes:
        log, fault: What they were run on.
        file: Of the default with the model file as it is.
        tuned: Of the default after `tune`.
        kalman: Of the intrinsic Kalman filter after `tune`.
        gate: Error of constant gains behind the gate, as a multiple of that without it.
        band: Fraction of the true velocities within the 95 % band of the Kalman filter, and of the fastest tenth.
        best: Least error of each family, and whether it knows the model.
        source: Which candidate the tuned gains are.
    """

    log: str
    fault: str
    file: float
    tuned: float
    kalman: float
    gate: float
    band: tuple[float, float]
    best: dict[str, tuple[float, bool]]
    source: str

    @classmethod
    def of(cls, twin: Twin, fault: str, log: Judged) -> "Entry":
        """Tune to the log, run all estimators and search for the best numbers."""
        file = twin.file
        model = file.need_mechanical(file.name, "this table has")
        # A user who has read that the model explains little goes on in spite of it.
        result = covariant.tune(file, log.record, anyway=True)
        found, tuned = result.tuning, with_lines(file, result.lines)
        sheet = DataSheet(
            float(np.sqrt(np.mean(found.noise.measurement**2))),
            1.0,
            speed=calibration.usual_speeds(model, log.record),
        )

        def estimate(file: models.ModelFile, observer: str | None = None) -> Any:
            return covariant.estimate(file, log.record, observer=observer, anyway=True)

        kalman = estimate(tuned, "intrinsic-kalman")
        ratio = (np.abs(kalman.velocity - log.v) / kalman.velocity_std)[log.judged]
        speed = np.linalg.norm(log.v[log.judged] / np.std(log.v[log.judged], axis=0), axis=1)
        fast = speed >= np.quantile(speed, TENTH)
        gains = observers.IntrinsicForce(
            model,
            2 * found.damping * found.natural_frequency,
            found.natural_frequency**2,
            result.lines["design"].get("force_rate", 0.0),
        )
        runs = [engine.run_log(each, log.record)[0] for each in (calibration.gated(gains, model, sheet), gains)]
        gated, free = (log.error(model.motion(run.estimate).v) for run in runs)
        families = [*informed(log, model, found, sheet), *uninformed(log, model, sheet.measurement_std)]
        best = {family.name: (family.searched(log, model), family.informed) for family in families}
        return cls(
            twin.name,
            fault,
            log.error(estimate(file).velocity),
            log.error(estimate(tuned).velocity),
            log.error(kalman.velocity),
            gated / free,
            (float(np.mean(ratio < DEVIATIONS)), float(np.mean(ratio[fast] < DEVIATIONS))),
            best | {"savitzky-golay": (best_polynomial(log), False)},
            found.source,
        )

    def least(self, informed: bool) -> tuple[float, str]:
        """The least error of all families with a model, or of all without one, and the name of the family."""
        return min((error, name) for name, (error, knows) in self.best.items() if knows == informed)

    @property
    def loss(self) -> float:
        """Error of the tuned default as a multiple of the best."""
        return self.tuned / min(self.least(True), self.least(False))[0]

    def __str__(self) -> str:
        (model, its), (free, other) = self.least(True), self.least(False)
        best = min(model, free)
        return (
            f"| {self.log} | {self.fault} | {self.loss:.2f} | {self.file / best:.2f} | {self.kalman / best:.2f} | "
            f"{model:.5f} ({its}) | {free:.5f} ({other}) | {self.gate:.3f} | {self.band[0]:.2f}, {self.band[1]:.2f} | "
            f"{self.source} |"
        )


def entries(only: str, available: dict[str, Callable[[], Twin]], faults: dict[str, Any]) -> Iterable[Entry]:
    """Entries of the table, of all logs or of the one that is asked for."""
    chosen, _, fault = only.partition(":")
    for name, make in available.items():
        if not name.startswith(chosen):
            continue
        clean = make()
        for k, (kind, spoil) in enumerate(faults.items()):
            if kind.startswith(fault):
                yield Entry.of(clean, kind, spoil(clean, np.random.default_rng([7, k])))


def main() -> None:
    """Print the table: each row when it is there, and all of them at the end, losses first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="a log, or a log and a fault: ship:noise")
    parser.add_argument("--twins", action="store_true", help="the logs of twins.py, without more faults")
    asked, began, rows = parser.parse_args(), time.perf_counter(), []
    available = TWINS if asked.twins else all_logs()
    for entry in entries(asked.only, available, {"none": FAULTS["none"]} if asked.twins else FAULTS):
        rows.append(entry)
        print(entry, flush=True)
    print(
        "\n| log | fault | tuned ÷ best | model file ÷ best | Kalman ÷ best | best with a model | best without | "
        "gate | 95 % band, fastest tenth | gains from |\n|---|---|--:|--:|--:|---|---|--:|---|---|"
    )
    for entry in sorted(rows, key=lambda entry: -entry.loss):
        print(entry)
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
