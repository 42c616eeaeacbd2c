"""Numbers of the servos of each log by itself: zero, stiffness and dry friction of each joint, near those of all."""

import contextlib
import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant import logs, models
from covariant.calibration.identification import own_numbers
from covariant.models.robots import complete_tables
from covariant.signals import Record
from covariant.verbs.base.aligned import with_overrides
from covariant.verbs.base.among_logs import FAR, LogRow, find_change, find_drift, find_outliers, weighted_mean
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

OWN = ("offset", "stiffness", "coulomb")
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
    """What differs from log to log.

    Attributes:
        sentences: Numbers that changed from some log on, that are others in single logs, or that drift.
        alike: Indices of the longest stretch of logs without a change, and without logs whose zero is another.
    """

    sentences: tuple[str, ...]
    alike: tuple[int, ...]


def find_moved(rows: Sequence[LogRow], ticks: float) -> Moved:
    """Compare the numbers of logs in their order; `ticks` is the least change of a zero that counts [rad or m]."""
    sentences, edges, odd_ones = [], {0, len(rows)}, set()
    for name in dict.fromkeys(name for _, row in rows for name in row if f"{name}_std" in row):
        value, std = (np.array([row.get(key, np.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        joint, _, kind = name.rpartition(".")
        least = ticks if kind == "offset" else LEAST_CHANGE * abs(float(np.nanmedian(value)))
        # What a log hardly tells would be judged by its linearisation.
        known = np.flatnonzero(std < least)
        if len(known) < 3:
            continue
        middle = float(np.median(value[known]))
        what = {"offset": f"the zero of {joint}", "coulomb": f"dry friction of {joint}"}.get(kind, f"{kind} of {joint}")

        def size(change: float, error: float, kind: str = kind, middle: float = middle) -> str:
            relative = "" if kind == "offset" else f", {change / abs(middle):+.0%} of {abs(middle):.3g}"
            return f"{change:+.3g} ± {error:.2g}{relative}"

        change = find_change(value[known], std[known])
        if change is not None and abs(change[1]) > least:
            at = int(known[change[0]])
            sentences.append(f"{what} changes by {size(*change[1:])} from {rows[at].name} on")
            edges |= {at} if kind == "offset" else set()
            continue
        odd = find_outliers(value[known], std[known])
        shared, error, _ = weighted_mean(value[known][~odd], std[known][~odd])
        for k in known[odd]:
            off, own = float(value[k] - shared), float(np.hypot(std[k], error))
            if abs(off) > max(FAR * own, least):
                sentences.append(f"{what} is another in {rows[k].name}: {size(off, own)}")
                odd_ones |= {k} if kind == "offset" else set()
        drift = find_drift(value[known], std[known])
        if drift is not None and abs(drift) > least:
            sentences.append(f"{what} drifts: {drift:+.3g} from {rows[known[0]].name} to {rows[known[-1]].name}")
    begin, end = max(itertools.pairwise(sorted(edges)), key=lambda pair: pair[1] - pair[0])
    return Moved(tuple(sentences), tuple(k for k in range(begin, end) if k not in odd_ones))
