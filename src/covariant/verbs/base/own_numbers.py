"""Numbers of the servos of each log by itself: zero, stiffness and dry friction of each joint, near those of all."""

import contextlib
import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant import logs, models
from covariant.calibration.identification import own_numbers
from covariant.models.robots import complete_tables
from covariant.signals import Record
from covariant.verbs.base.aligned import with_overrides
from covariant.verbs.base.among_logs import (
    FAR,
    LogRow,
    by_machine,
    find_change,
    find_drift,
    find_outliers,
    weighted_mean,
)
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

OWN = ("offset", "stiffness", "coulomb", "delay")
"""Numbers of a servo that may change from day to day."""
LEAST_CHANGE = 0.3
"""Least relative change of stiffness or friction that counts."""
FEWEST_ROWS = 10
"""Fewest positions of each joint in a log that show how it moves."""
AT_ONCE = 100
"""Logs that are held in memory at once."""


def servo_rows(
    jobs: Sequence[Job], columns: logs.Columns, fitted: Mapping[str, float], progress: Progress
) -> list[LogRow]:
    """A row for each log with the numbers of its servos that it shows, `elbow.offset` and `elbow.offset_std`.

    `fitted` are the numbers of all logs, by their names.
    """
    job, rows = jobs[0], [LogRow(job.log_name, {}) for job in jobs]
    known = with_overrides(job.overrides, fitted)
    spec = os.fspath(job.model)
    tables = complete_tables(models.document(spec, known)["servo"])
    # Servos that share a number by `like` have it each by itself here.
    own = {f"servo.{joint}.{key}": table[key] for joint, table in tables.items() for key in OWN if key in table}
    first = {f"servo.{joint}.offset": 0.0 for joint in tables} | own
    family = models.robot_family(spec, [*first], with_overrides(known, first))
    between, late = family.file.input_between, float(np.max(family.file.delay))
    for begin in range(0, len(jobs), AT_ONCE):
        progress(f"each of {len(jobs)} logs by itself", begin / len(jobs))
        records, places = [], []
        for k, job in enumerate(jobs[begin : begin + AT_ONCE], begin):
            try:
                records.append(read_record(job, columns))
                places.append(k)
            except (InputError, OSError) as error:
                rows[k].row["failed"] = str(error)
        found: Any = [], []
        with contextlib.suppress(InputError):  # where no log is long enough, none shows a number
            found = own_numbers(family, records, between, late)
        for k, values, errors in zip(places, *found, strict=False):
            for number, value, error in zip(family.names, values, errors, strict=True):
                if np.isfinite(error):
                    name = number.removeprefix("servo.")
                    rows[k].row.update({name: float(value), f"{name}_std": float(error)})
    return rows


def read_record(job: Job, columns: logs.Columns) -> Record:
    """The record of one of many logs; raises `InputError` for one with too few rows for velocities."""
    record = logs.read(job.log, columns, job.every, job.until, job.start).record
    known = np.isfinite(np.asarray(record.y)).reshape(len(record.t), -1).sum(axis=0).min()
    if known < FEWEST_ROWS:
        raise InputError(f"{job.log_name}: {known} rows have positions, and {FEWEST_ROWS} are needed")
    return record


class Moved(NamedTuple):
    """What differs from log to log, or from arm to arm.

    Attributes:
        sentences: Numbers that changed from some log on, that are others in single logs or on one arm, or that drift.
        alike: Indices of the longest stretch of logs of each arm without a change, and without other zeros.
        odd: Names of the numbers that are others in a log or on its arm, by the index of the log.
    """

    sentences: tuple[str, ...]
    alike: tuple[int, ...]
    odd: Mapping[int, list[str]]


class _Number(NamedTuple):
    """A number of a servo in each of K logs, NaN where one does not show it, and its least change that counts."""

    name: str
    value: np.ndarray
    std: np.ndarray
    least: float

    @classmethod
    def of(cls, name: str, rows: Sequence[LogRow], least: Mapping[str, float]) -> "_Number":
        value, std = (np.array([row.get(key, np.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        usual = LEAST_CHANGE * abs(float(np.nanmedian(value)))
        return cls(name, value, std, least.get(name.rpartition(".")[2], usual))

    @property
    def title(self) -> str:
        joint, _, kind = self.name.rpartition(".")
        return {"offset": "the zero", "coulomb": "dry friction"}.get(kind, kind) + f" of {joint}"

    @property
    def is_zero(self) -> bool:
        return self.name.endswith(".offset")

    def known(self, places: Sequence[int]) -> np.ndarray:
        """Those of the logs that show the number; one that hardly does would be judged by its linearisation."""
        return np.array([k for k in places if self.std[k] < self.least], int)

    def size(self, change: float, error: float, middle: float) -> str:
        relative = "" if self.is_zero else f", {change / abs(middle):+.0%} of {abs(middle):.3g}"
        return f"{change:+.3g} ± {error:.2g}{relative}"


def find_moved(rows: Sequence[LogRow], ticks: float, late: float = np.inf) -> Moved:
    """Compare the numbers of logs in the order of those of each arm, and of arms; `ticks` is the least change of a zero
    that counts [rad or m], `late` of a delay [s]."""
    arms, sentences, odd, left_out = by_machine(rows, range(len(rows))), [], {}, set()
    edges = {arm: {0, len(places)} for arm, places in arms.items()}
    for name in dict.fromkeys(name for _, row in rows for name in row if f"{name}_std" in row):
        number, alike = _Number.of(name, rows, {"offset": ticks, "delay": late}), {}
        for arm, places in arms.items():
            known = number.known(places)
            said, at, others = _over_time(number, rows, known)
            sentences += said
            edges[arm] |= {places.index(known[at])} if at and number.is_zero else set()
            left_out |= {*others} if number.is_zero else set()
            # Before and after a change the numbers are those of two arms.
            longest = slice(at, None) if 2 * at < len(known) else slice(at)
            alike[arm] = [k for k in known[longest] if k not in others]
            for k in others:
                odd.setdefault(k, []).append(name)
        for arm, sentence in _among_arms(number, alike):
            sentences.append(sentence)
            left_out |= {*arms[arm]} if number.is_zero else set()
            for k in arms[arm]:
                odd.setdefault(k, []).append(name)
    stretches = {
        arm: max(itertools.pairwise(sorted(each)), key=lambda pair: pair[1] - pair[0]) for arm, each in edges.items()
    }
    within = (k for arm, (begin, end) in stretches.items() for k in arms[arm][begin:end] if k not in left_out)
    return Moved(tuple(sentences), tuple(sorted(within)), odd)


def _over_time(number: _Number, rows: Sequence[LogRow], known: np.ndarray) -> tuple[list[str], int, list[int]]:
    """Sentences on a number in logs of one arm, the place among them from which on it is another, and odd logs."""
    if len(known) < 3:
        return [], 0, []
    value, std, sentences, others = number.value[known], number.std[known], [], []
    middle = float(np.median(value))
    change = find_change(value, std)
    if change is not None and abs(change[1]) > number.least:
        size = number.size(*change[1:], middle)
        return [f"{number.title} changes by {size} from {rows[known[change[0]]].name} on"], change[0], []
    odd = find_outliers(value, std)
    shared, error, _ = weighted_mean(value[~odd], std[~odd])
    for k in known[odd].tolist():
        off, own = float(number.value[k] - shared), float(np.hypot(number.std[k], error))
        if abs(off) > max(FAR * own, number.least):
            sentences.append(f"{number.title} is another in {rows[k].name}: {number.size(off, own, middle)}")
            others.append(k)
    drift = find_drift(value, std)
    if drift is not None and abs(drift) > number.least:
        sentences.append(f"{number.title} drifts: {drift:+.3g} from {rows[known[0]].name} to {rows[known[-1]].name}")
    return sentences, 0, others


def _among_arms(number: _Number, alike: Mapping[str, Sequence[int]]) -> Iterator[tuple[str, str]]:
    """Arms on which a number is another than on the rest, each with a sentence; `alike` are the logs of each arm."""
    arms = [arm for arm, places in alike.items() if places]
    if len(arms) < 3:
        return
    each = (weighted_mean(number.value[alike[arm]], number.std[alike[arm]])[:2] for arm in arms)
    value, std = np.array(list(each)).T
    odd = find_outliers(value, std)
    shared, error, _ = weighted_mean(value[~odd], std[~odd])
    for arm, off, own in zip(np.array(arms)[odd].tolist(), value[odd] - shared, np.hypot(std, error)[odd], strict=True):
        if abs(off) > max(FAR * own, number.least):
            yield arm, f"{number.title} is another on {arm}: {number.size(off, own, shared)} beside the others"
