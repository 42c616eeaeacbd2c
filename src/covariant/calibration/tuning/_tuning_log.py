"""A log as `tune` uses it: without outliers, its first part for tuning and the rest to judge by."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant._errors import InputError
from covariant.calibration.diagnosis import outliers
from covariant.calibration.identification import FITTED
from covariant.models import MechanicalSystem
from covariant.observers import IntrinsicForce, run
from covariant.scoring import find_holes, near_holes, scored_window
from covariant.signals import Record, Run

MOST_ROWS = 8000
"""Largest number of rows of each log for tuning: the search runs an observer over them dozens of times."""
FEWEST_ROWS = 100
"""Least number of rows in each part of a log."""
Runs = Callable[[Sequence[IntrinsicForce], Sequence[Record]], Sequence[Run]]
"""Runs each of several observers over each of several records, and returns estimates and innovations."""


class TuningLog(NamedTuple):
    """A record without outliers, its reference velocities (T, n), the rows for tuning and the held-out rows."""

    record: Record
    velocity: Float[np.ndarray, "T n"]
    tuned: Bool[np.ndarray, "T"]
    held_out: Bool[np.ndarray, "T"]

    @property
    def first_part(self) -> Record:
        """The rows up to the last one for tuning, in which the observer settles too."""
        end = int(np.flatnonzero(self.tuned)[-1]) + 1
        return Record(self.record.t[:end], self.record.u[:end], self.record.y[:end])

    @property
    def rate(self) -> float:
        return 1 / float(np.median(np.diff(np.asarray(self.record.t))))


def prepared(model: MechanicalSystem, record: Record, velocity: np.ndarray) -> TuningLog:
    """Take the outliers out of a record, and divide its rows."""
    t, y = np.asarray(record.t), np.asarray(record.y)
    if model.manifold.commuting:
        wrong = outliers(t, y, model.circles)[0]
        wrong[0] = False  # a record begins with a whole measurement
        y = np.where(wrong, np.nan, y)
    border = t[0] + FITTED * (t[-1] - t[0])
    valid = scored_window(t) & np.isfinite(velocity).all(axis=1)
    holes = find_holes(t, np.asarray(np.isfinite(y.reshape(len(y), -1)).any(1)))
    for counts in (valid & ~near_holes(t, holes), valid):  # errors of holes are not those of noise and gains
        tuned, held_out = counts & (t < border), counts & (t >= border)
        if min(tuned.sum(), held_out.sum()) >= FEWEST_ROWS:
            break
    tuned[np.flatnonzero(tuned)[MOST_ROWS:]] = False
    if min(tuned.sum(), held_out.sum()) < FEWEST_ROWS:
        raise InputError(
            f"a log of {len(t)} rows over {t[-1] - t[0]:.3g} s is too short to tune on: of its first two thirds "
            f"{tuned.sum()} rows count, of the rest {held_out.sum()}, and {FEWEST_ROWS} of each are needed"
        )
    return TuningLog(Record(t, np.asarray(record.u), y), velocity, tuned, held_out)


def constant_gains(
    model: MechanicalSystem, frequency: float, damping: float, force_rate: float = 0.0
) -> IntrinsicForce:
    """The observer with the gains α = 2ζω and β = ω² that learns a force at the rate ρ; for ρ = 0 it is `Intrinsic`."""
    return IntrinsicForce(model, 2 * damping * frequency, frequency**2, force_rate)


def by_jax(observers: Sequence[IntrinsicForce], records: Sequence[Record]) -> list[Run]:
    """Run each observer over each record, one by one."""
    pairs = [(observer, record) for observer in observers for record in records]
    return [run(observer, record, ("innovation",)) for observer, record in pairs]


def followed(
    model: MechanicalSystem, logs: list[TuningLog], poles: tuple[float, float, float], runs: Runs
) -> list[Any]:
    """Configurations, velocities (T, n) and innovations (T, n) of the observer over each of the whole logs."""
    estimates = []
    for done in runs([constant_gains(model, *poles)], [log.record for log in logs]):
        motion = model.motion(done.estimate)
        estimates.append((motion.q, motion.v, np.asarray(done.info.innovation)))
    return estimates
