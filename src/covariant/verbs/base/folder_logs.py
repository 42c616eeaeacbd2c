"""A fit to the logs of a folder: those that tell most, judged by others, and what changes from log to log."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import logs, models
from covariant.calibration.identification import most_informative
from covariant.models.robots import servos_in
from covariant.signals import Record
from covariant.verbs.base.among_logs import CLEAR, LogRow, by_machine, find_change
from covariant.verbs.base.fit_to_logs import fit_to_logs
from covariant.verbs.base.inputs import Job, columns_of
from covariant.verbs.base.own_numbers import find_moved, longest_stretch, read_record, rows_of_arms
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

MOST_READ, MOST_ROWS, JUDGE = 400, 6000, 1 / 3
"""Most logs among which is chosen, the rows to which is fitted, and the rows that judge, relative to these."""
FEWEST_LOGS = 6
"""Fewest logs of which some are kept to judge by; of fewer the last one, or the last part of one, is."""
TICKS, BEYOND_SAG = 10, 0.1
"""Least change of a zero that counts after a fit, in ticks or standard deviations of noise, and least change of the
error of a command [rad or m] before it, which is more than a joint sags or sticks."""


def fit_folder(
    jobs: Sequence[Job], names: Sequence[str], progress: Progress, sources: Mapping[Path, bytes]
) -> tuple[list[Job], dict[str, dict[str, Any]], dict[str, Any]]:
    """Fit to the logs of a folder, and compare the zero, the stiffness and the friction of servos from log to log.

    Where a zero changed, the fit is that of the longest stretch of logs without a change.
    """
    folder = _Folder.read(jobs, progress)
    used = folder.choose(folder.stretch)
    fitted = fit_to_logs(folder.jobs_of(used), names, progress, sources, None, used.judges)
    if folder.file.input_kind != "command" or fitted[2]["suspicion"]:
        return *fitted[:2], fitted[2] | {"chosen": used.sentence}
    numbers = {row["name"]: row["after"] for row in fitted[2]["parameters"]}
    rows = rows_of_arms(jobs, folder.columns, numbers, progress)
    stated = (folder.file.quantum, folder.file.measurement_std)
    tick = float(np.max(next((each for each in stated if each is not None), 0.0)))
    row = float(np.median([np.diff(each.t).mean() for each in folder.records.values()]))
    moved = find_moved(rows, TICKS * tick, row)
    # Once more if some logs belong to another zero, or if some were left out for a change that the fit explains.
    if not set(used.logs) <= set(moved.alike) or len(folder.stretch) < len(moved.alike):
        used = folder.choose(moved.alike)
        fitted = fit_to_logs(folder.jobs_of(used), names, progress, sources, None, used.judges)
    each = [{"log": row.name, **row.row, "odd": ", ".join(moved.odd.get(k, ()))} for k, row in enumerate(rows)]
    details = {"changes": list(moved.sentences), "each": each}
    return *fitted[:2], fitted[2] | details | {"chosen": used.sentence}


class _Used(NamedTuple):
    """Indices of the logs that are used, the number of the last of them that judge, 0 if all are used, and why."""

    logs: list[int]
    judges: int
    sentence: str


class _Folder(NamedTuple):
    """Logs of a folder that were read, by their indices, and why others could not be."""

    jobs: Sequence[Job]
    file: models.ModelFile
    columns: logs.Columns
    records: dict[int, Record]
    failed: list[str]

    @classmethod
    def read(cls, jobs: Sequence[Job], progress: Progress) -> "_Folder":
        """Read the logs, or some of very many."""
        file = models.load(jobs[0].model, jobs[0].overrides)
        columns, records, failed = columns_of(jobs[0], file), {}, []
        for k in np.unique(np.linspace(0, len(jobs) - 1, MOST_READ).round().astype(int)).tolist():
            progress(f"reading {min(len(jobs), MOST_READ)} of {len(jobs)} logs", k / len(jobs))
            try:
                records[k] = read_record(jobs[k], columns)
            except (InputError, OSError) as error:
                failed.append(str(error).rstrip("."))
        if not records:
            raise InputError(f"{len(failed)} logs, and none can be used; the first: {failed[0]}")
        return cls(jobs, file, columns, records, failed)

    @property
    def stretch(self) -> list[int]:
        """Logs of each arm's longest stretch in which no position has clearly another distance from its command."""
        servos: Any = servos_in(self.file.model) if self.file.input_kind == "command" else None
        if servos is None:
            return list(range(len(self.jobs)))
        rows, commands = np.asarray(servos.rows), np.asarray(servos.commands)
        off = {k: np.nanmedian(each.u @ commands.T - each.y @ rows.T, axis=0) for k, each in self.records.items()}
        logs: list[int] = []
        for its_logs in by_machine([LogRow(job.log_name, {}) for job in self.jobs], range(len(self.jobs))).values():
            places, ends = [k for k in its_logs if k in off], {0, len(its_logs)}
            for column in np.array([off[k] for k in places]).T:
                change = find_change(column, np.full(len(column), BEYOND_SAG / CLEAR))
                if change is not None and abs(change[1]) > BEYOND_SAG:
                    ends.add(its_logs.index(places[change[0]]))
            logs += longest_stretch(its_logs, ends)
        return sorted(logs)

    def choose(self, among: Sequence[int]) -> _Used:
        """Logs to fit, and others to judge by."""
        places = sorted(self.records.keys() & among)
        counts = np.array([len(self.records[k].t) for k in places])
        only = "" if len(among) == len(self.jobs) else f" Only the {len(among)} logs between changes of a zero count."
        most = min(MOST_ROWS * (1 + JUDGE), counts.sum())
        if len(places) < 2 or (most == counts.sum() and len(places) < FEWEST_LOGS):
            return _Used(places, 0, only.strip())
        step, each = round(1 + 1 / JUDGE), [self.records[k] for k in places]
        telling = most_informative(each, int(most))
        if len(telling) < step:  # of long logs the next one judges
            telling = most_informative(each, int(counts[telling].sum()) + 1)
        # Logs in which hardly anything moves would judge any fit to be good.
        judging = [places[k] for k in telling[step - 1 :: step] or telling[-1:]]
        chosen = [places[k] for k in telling if places[k] not in judging]
        lost = f"; {len(self.failed)} could not be used, the first: {self.failed[0]}" if self.failed else ""
        read = f"{len(places)} read of " * (len(places) < len(among))
        sentence = (
            f"Of {read}{len(among)} logs the {len(telling)} that tell most by the determinant of their information are "
            f"used: {len(chosen)} are fitted, and {len(judging)} judge{lost}."
        )
        return _Used([*chosen, *judging], len(judging), f"{sentence}{only}")

    def jobs_of(self, used: _Used) -> list[Job]:
        """Jobs of the logs that are used; one that hardly moves is no reason to refuse the others."""
        return [self.jobs[k]._replace(anyway=len(used.logs) > 1) for k in used.logs]
