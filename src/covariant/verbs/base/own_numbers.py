"""Numbers of the servos of each log by itself: zero, stiffness and dry friction of each joint, near those of all."""

import contextlib
import itertools
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
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


def rows_of_arms(
    jobs: Sequence[Job], columns: logs.Columns, fitted: Mapping[str, float], progress: Progress
) -> list[LogRow]:
    """The rows of `servo_rows`; of several arms near the numbers of each, since one step from those of all falls short
    of an arm that differs."""
    rows = servo_rows(jobs, columns, fitted, progress)
    arms = by_machine(rows, range(len(rows)))
    for places in arms.values() if len(arms) > 1 else ():
        own = [rows[k] for k in places]
        numbers = [_Number.of(name, own) for name in names_in(own)]
        near = {f"servo.{each.name}": each.mean(np.flatnonzero(np.isfinite(each.std)))[0] for each in numbers}
        for k, row in zip(
            places, servo_rows([jobs[k] for k in places], columns, {**fitted, **near}, progress), strict=True
        ):
            rows[k] = row
    return rows


def names_in(rows: Sequence[LogRow]) -> list[str]:
    """Names of the numbers that any of the logs shows."""
    return list(dict.fromkeys(name for _, row in rows for name in row if f"{name}_std" in row))


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
    def of(cls, name: str, rows: Sequence[LogRow], least: Mapping[str, float] = MappingProxyType({})) -> "_Number":
        value, std = (np.array([row.get(key, np.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        usual = LEAST_CHANGE * abs(float(np.nanmedian(value)))
        return cls(name, value, std, least.get(name.rpartition(".")[2], usual))

    @property
    def title(self) -> str:
        joint = self.name.removesuffix(f".{self.kind}")
        return {"offset": "the zero", "coulomb": "dry friction"}.get(self.kind, self.kind) + f" of {joint}"

    @property
    def kind(self) -> str:
        return self.name.rpartition(".")[2]

    @property
    def relative(self) -> bool:
        """Whether a change counts by its factor."""
        return self.kind not in ("offset", "delay")

    def known(self, places: Sequence[int]) -> np.ndarray:
        """Those of the logs that show the number; one that hardly does would be judged by its linearisation."""
        return np.array([k for k in places if self.std[k] < self.least], int)

    def mean(self, places: np.ndarray) -> tuple[float, float]:
        """Mean over some logs, and its standard error."""
        return weighted_mean(self.value[places], self.std[places])[:2]

    def size(self, change: float, error: float, middle: float) -> str:
        relative = f", {change / abs(middle):+.0%} of {abs(middle):.3g}" if self.relative else ""
        return f"{change:+.3g} ± {error:.2g}{relative}"


def find_moved(rows: Sequence[LogRow], ticks: float, late: float = np.inf) -> Moved:
    """Compare the numbers of logs in the order of those of each arm, and of arms; `ticks` is the least change of a zero
    that counts [rad or m], `late` of a delay [s]."""
    arms, sentences, odd, left_out = by_machine(rows, range(len(rows))), [], defaultdict(list), set()
    edges, of_kinds = {arm: {0, len(places)} for arm, places in arms.items()}, defaultdict(list)
    for name in names_in(rows):
        number = _Number.of(name, rows, {"offset": ticks, "delay": late})
        for arm, places in arms.items():
            known = number.known(places)
            said, at, others = _over_time(number, rows, known)
            sentences += said
            edges[arm] |= {places.index(known[at])} if at and number.kind == "offset" else set()
            left_out |= {*others} if number.kind == "offset" else set()
            for k in others:
                odd[k].append(name)
            # Before and after a change the numbers are those of two arms.
            longer = known[at:] if 2 * at < len(known) else known[:at]
            alike = np.setdiff1d(longer, others).astype(int)
            if len(alike):
                of_kinds[number.kind].append(_OfArm(number, arm, *number.mean(alike)))
    for each, sentence in itertools.chain.from_iterable(map(_among_arms, of_kinds.values())):
        sentences.append(sentence)
        left_out |= {*arms[each.arm]} if each.number.kind == "offset" else set()
        for k in arms[each.arm]:
            odd[k].append(each.number.name)
    within = (k for arm, ends in edges.items() for k in longest_stretch(arms[arm], ends) if k not in left_out)
    return Moved(tuple(sentences), tuple(sorted(within)), odd)


def longest_stretch(logs: Sequence[int], ends: set[int]) -> Sequence[int]:
    """Logs of the longest stretch between ends, which are places among these logs."""
    begin, end = max(itertools.pairwise(sorted(ends)), key=lambda pair: pair[1] - pair[0])
    return logs[begin:end]


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


class _OfArm(NamedTuple):
    """Mean of a number over the logs of an arm, and its standard error."""

    number: _Number
    arm: str
    mean: float
    error: float


def _among_arms(each: Sequence[_OfArm]) -> Iterator[tuple[_OfArm, str]]:
    """Numbers of one kind that are others on an arm than on the rest, each with a sentence."""
    names = list(dict.fromkeys(one.number.name for one in each))
    group = np.array([names.index(one.number.name) for one in each])
    value, std = np.array([(one.mean, one.error) for one in each]).T
    middle = np.array([np.median(value[group == k]) for k in group])
    scale = np.abs(middle) if each[0].number.relative else np.ones(len(each))
    # Of two arms neither is the odd one: the second is compared with the first.
    pairs = np.bincount(group)[group] == 2
    later = np.isin(np.arange(len(group)), np.unique(group, return_index=True)[1], invert=True)
    odd = np.where(pairs, later, find_outliers(value / scale, std / scale, group))
    for k in np.flatnonzero(odd):
        others = (group == group[k]) & ~odd
        shared, error, _ = weighted_mean(value[others], std[others]) if others.any() else (np.nan,) * 3
        off, own, number = float(value[k] - shared), float(np.hypot(std[k], error)), each[k].number
        if abs(off) > max(FAR * own, number.least):
            yield (
                each[k],
                f"{number.title} is another on {each[k].arm}: {number.size(off, own, shared)} beside the rest",
            )
