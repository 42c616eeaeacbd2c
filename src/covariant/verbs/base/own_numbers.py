"""Numbers of the servos of each log by itself: zero, stiffness and dry friction of each joint, near those of all."""

import contextlib
import itertools
import os
from collections import defaultdict
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
ABSOLUTE = ("offset", "delay")
"""Those of them of which a change counts by itself, and not by its factor."""
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
        numbers = _Number.each([rows[k] for k in places])
        near = {f"servo.{each.name}": each.mean(np.isfinite(each.std))[0] for each in numbers}
        own = iter(servo_rows([jobs[k] for k in places], columns, {**fitted, **near}, progress))
        for k in places:
            rows[k] = next(own)
    return rows


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
    least: float = np.inf

    @classmethod
    def each(cls, rows: Sequence[LogRow]) -> list["_Number"]:
        """Every number that any of the logs shows."""
        names = dict.fromkeys(name for _, row in rows for name in row if f"{name}_std" in row)
        both = ([[row.get(key, np.nan) for _, row in rows] for key in (name, f"{name}_std")] for name in names)
        return [cls(name, *np.array(columns, float)) for name, columns in zip(names, both, strict=True)]

    @property
    def kind(self) -> str:
        return self.name.rpartition(".")[2]

    @property
    def title(self) -> str:
        what = {"offset": "the zero", "coulomb": "dry friction"}.get(self.kind, self.kind)
        return f"{what} of {self.name.rpartition('.')[0]}"

    def mean(self, places: np.ndarray) -> tuple[float, float]:
        """Mean over some logs, and its standard error."""
        return weighted_mean(self.value[places], self.std[places])[:2]

    def size(self, change: float, error: float, middle: float) -> str:
        relative = "" if self.kind in ABSOLUTE else f", {change / abs(middle):+.0%} of {abs(middle):.3g}"
        return f"{change:+.3g} ± {error:.2g}{relative}"

    def others(self, value: np.ndarray, std: np.ndarray, odd: np.ndarray) -> Iterator[tuple[int, str]]:
        """Places of those odd values that are clearly other ones than the rest, and by how much."""
        shared, error, _ = weighted_mean(value[~odd], std[~odd])
        for k in np.flatnonzero(odd).tolist():
            off, own = float(value[k] - shared), float(np.hypot(std[k], error))
            if abs(off) > max(FAR * own, self.least):
                yield k, self.size(off, own, shared)


def find_moved(rows: Sequence[LogRow], ticks: float, late: float = np.inf) -> Moved:
    """Compare the numbers of logs in the order of those of each arm, and of arms; `ticks` is the least change of a zero
    that counts [rad or m], `late` of a delay [s]."""
    arms, sentences, odd, left_out = by_machine(rows, range(len(rows))), [], defaultdict(list), set()
    edges, of_kinds = {arm: {0, len(places)} for arm, places in arms.items()}, defaultdict(list)

    def tell(number: _Number, sentence: str, logs: Sequence[int]) -> None:
        sentences.append(f"{number.title} {sentence}")
        left_out.update(logs if number.kind == "offset" else ())
        for k in logs:
            odd[k].append(number.name)

    for unjudged in _Number.each(rows):
        usual = LEAST_CHANGE * abs(float(np.nanmedian(unjudged.value)))
        number = unjudged._replace(least={"offset": ticks, "delay": late}.get(unjudged.kind, usual))
        for arm, places in arms.items():
            # What a log hardly tells would be judged by its linearisation.
            known = np.array([k for k in places if number.std[k] < number.least], int)
            value, std = number.value[known], number.std[known]
            change = find_change(value, std)
            if change is not None and abs(change[1]) > number.least:
                at, size = change[0], number.size(*change[1:], float(np.median(value)))
                tell(number, f"changes by {size} from {rows[known[at]].name} on", ())
                edges[arm] |= {places.index(known[at])} if number.kind == "offset" else set()
                # Before and after a change the numbers are those of two arms.
                known = known[at:] if 2 * at < len(known) else known[:at]
            elif len(known) > 2:
                outliers = find_outliers(value, std)
                for k, size in number.others(value, std, outliers):
                    tell(number, f"is another in {rows[known[k]].name}: {size}", [int(known[k])])
                drift = find_drift(value, std)
                if drift is not None and abs(drift) > number.least:
                    tell(number, f"drifts: {drift:+.3g} from {rows[known[0]].name} to {rows[known[-1]].name}", ())
                known = known[~outliers]
            if len(known):
                of_kinds[number.kind].append((number, arm, *number.mean(known)))
    for number, arm, size in itertools.chain.from_iterable(map(_among_arms, of_kinds.values())):
        tell(number, f"is another on {arm}: {size} beside the rest", arms[arm])
    within = (k for arm, ends in edges.items() for k in longest_stretch(arms[arm], ends) if k not in left_out)
    return Moved(tuple(sentences), tuple(sorted(within)), odd)


def longest_stretch(logs: Sequence[int], ends: set[int]) -> Sequence[int]:
    """Logs of the longest stretch between ends, which are places among these logs."""
    begin, end = max(itertools.pairwise(sorted(ends)), key=lambda pair: pair[1] - pair[0])
    return logs[begin:end]


def _among_arms(each: Sequence[tuple[_Number, str, float, float]]) -> Iterator[tuple[_Number, str, str]]:
    """Of numbers of one kind, each with an arm, its mean there and the error of that, those that are others on an arm
    than on the rest, with the arm and by how much."""
    numbers, arms, *means = zip(*each, strict=True)
    value, std = np.array(means)
    names = np.array([number.name for number in numbers])
    _, first, group = np.unique(names, return_index=True, return_inverse=True)
    middle = np.array(
        [1.0 if number.kind in ABSOLUTE else np.median(value[names == number.name]) for number in numbers]
    )
    odd = find_outliers(value / abs(middle), std / abs(middle), group)
    for k, at in enumerate(first):
        own = np.flatnonzero(group == k)
        # Of two arms neither is the odd one: the second is compared with the first.
        unlike = own != at if len(own) == 2 else odd[own]
        if not unlike.all():
            yield from (
                (numbers[at], arms[own[i]], size) for i, size in numbers[at].others(value[own], std[own], unlike)
            )
