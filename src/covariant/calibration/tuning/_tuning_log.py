"""A log as `tune` uses it: without outliers, its first part for tuning and the rest to judge by."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis import ROUNDING, outliers
from covariant.calibration.identification import FITTED
from covariant.models import MechanicalSystem
from covariant.observers import IntrinsicForce, run
from covariant.scoring import find_holes, near_holes, scored_window
from covariant.signals import Record, Run
from scalargraph.errors import InputError

MOST_ROWS = 8000
"""Largest number of rows of each log for tuning: the search runs an observer over them dozens of times."""
FEWEST_ROWS = 100
"""Smallest number of rows in each part, for tuning and held out, summed over all logs."""
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


def tuning_logs(
    model: MechanicalSystem, records: Sequence[Record], velocities: Sequence[np.ndarray], names: Sequence[str]
) -> list[TuningLog]:
    """Take the outliers out of records, and divide their rows; raise `InputError` for what no tuning can use.

    All logs together need enough rows: one that has none in one of its parts is left out.
    """
    logs = [prepared(model, *each) for each in zip(records, velocities, strict=True)]
    counts = np.array([(log.tuned.sum(), log.held_out.sum()) for log in logs])
    used = np.all(counts > 0, axis=1)
    if (least := counts[used].sum(axis=0)).min() < FEWEST_ROWS:
        each = ", ".join(
            f"{name} of {len(log.tuned)} rows has {tuned} and {held_out}"
            for name, log, (tuned, held_out) in zip(names, logs, counts, strict=True)
        )
        raise InputError(
            f"{'is' if len(logs) == 1 else 'are'} too short to tune on: of the first two thirds {least[0]} rows count, "
            f"and {least[1]} of the rest, where {FEWEST_ROWS} of each are needed; the start of a log, in which an "
            f"observer settles, never counts. {each}"
        )
    usable = [log for log, each in zip(logs, used.tolist(), strict=True) if each]
    _refuse_rest(model, usable)
    return usable


def prepared(model: MechanicalSystem, record: Record, velocity: np.ndarray) -> TuningLog:
    """A record without outliers, with its rows for tuning and the held-out ones."""
    t, y = np.asarray(record.t), np.asarray(record.y)
    if model.manifold.commuting:
        wrong = outliers(t, y, model.circles)[0]
        wrong[0] = False  # a record begins with a whole measurement
        y = np.where(wrong, np.nan, y)
    span = t[-1] - t[0]
    border = t[0] + FITTED * span
    # Of a short log less is left out, since many of them together may be enough.
    settling = min(1.0, span / 5)
    valid = scored_window(t, settling, settling / 5) & np.isfinite(velocity).all(axis=1)
    holes = find_holes(t, np.asarray(np.isfinite(y.reshape(len(y), -1)).any(1)))
    for counts in (valid & ~near_holes(t, holes), valid):  # errors of holes are not those of noise and gains
        tuned, held_out = counts & (t < border), counts & (t >= border)
        if min(tuned.sum(), held_out.sum()) >= FEWEST_ROWS:
            break
    tuned[np.flatnonzero(tuned)[MOST_ROWS:]] = False
    return TuningLog(Record(t, np.asarray(record.u), y), velocity, tuned, held_out)


def _readings(logs: Sequence[TuningLog]) -> Float[np.ndarray, "T n"]:
    """The readings of all logs, one below the other; the entries of an attitude side by side."""
    return np.concatenate([np.asarray(log.record.y).reshape(len(log.record.t), -1) for log in logs])


def _refuse_rest(model: MechanicalSystem, logs: Sequence[TuningLog]) -> None:
    """Raise `InputError` where a coordinate stands still, or an attitude: no error is a part of a velocity of zero."""
    y = _readings(logs)
    still = np.nanmin(y, axis=0) == np.nanmax(y, axis=0)
    if not (still.any() if model.manifold.commuting else still.all()):
        return
    names = model.coordinates or tuple(f"q{i + 1}" for i in range(y.shape[1]))
    which = ", ".join(name for name, one in zip(names, still, strict=False) if one)
    raise InputError(
        f"{'nothing moves' if still.all() else f'{which} does not move'} in the logs, so that they tell neither noise "
        "nor gains; log a motion of all coordinates"
    )


def refuse_noise_free(size: Float[np.ndarray, "n"], logs: Sequence[TuningLog]) -> None:
    """Raise `InputError` where innovations of the size (n,) are rounding errors, as those of a simulation are."""
    y = _readings(logs)
    motion = np.nanmax(y, axis=0) - np.nanmin(y, axis=0)  # of each coordinate, which may have units of their own
    relative = float(np.max(size / (motion if motion.shape == size.shape else motion.max())))
    if relative < ROUNDING:
        raise InputError(
            f"the model predicts each reading up to {relative:.1g} of the motion, as in a simulation without noise: "
            "such a log tells neither noise nor gains. Give a log of the machine, or simulate one with noise"
        )


def constant_gains(
    model: MechanicalSystem, frequency: float, damping: float, force_rate: float = 0.0
) -> IntrinsicForce:
    """The observer with the gains α = 2ζω and β = ω² that learns a force at the rate ρ; for ρ = 0 it is `Intrinsic`."""
    return IntrinsicForce(model, 2 * damping * frequency, frequency**2, force_rate)


def by_jax(observers: Sequence[IntrinsicForce], records: Sequence[Record]) -> list[Run]:
    """Run each observer over each record, one by one."""
    return [run(observer, record, ("innovation",)) for observer in observers for record in records]


def followed(
    model: MechanicalSystem, logs: list[TuningLog], poles: tuple[float, float, float], runs: Runs
) -> list[Any]:
    """Configurations, velocities (T, n) and innovations (T, n) of the observer over each of the whole logs."""
    estimates = []
    for done in runs([constant_gains(model, *poles)], [log.record for log in logs]):
        motion = model.motion(done.estimate)
        estimates.append((motion.q, motion.v, np.asarray(done.info.innovation)))
    return estimates
