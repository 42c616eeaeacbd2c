"""Calls a verb for each of many logs: a row of a table for each log, and a folder of estimates."""

import contextlib
import functools
import hashlib
import importlib.metadata
import importlib.util
import itertools
import json
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import models, verbs
from covariant._cases import CaseTable, Crew, content_hash, run_chunks
from covariant.logs import check_log, episodes, part_of, source_name
from covariant.verbs.base.among_logs import Among, LogRow, among_logs
from covariant.verbs.base.arguments import Scheduler
from covariant.verbs.base.model_output import model_hash
from covariant.verbs.base.outputs import write_table
from covariant.verbs.base.progress import Progress, notebook_line, time_left
from covariant.verbs.base.result import AbstractTable
from scalargraph.errors import InputError, file_name, printable

FILES = {"estimate": ".parquet", "check": "", "fit": ".toml", "smooth": "_smoothed.parquet"}
"""Ending of the file name of each log, by verb, so that verbs can share a folder; `check` writes no file."""
CHUNKS_A_WORKER = 16
"""Least number of chunks per worker: a killed run loses its current chunks, and at the end workers wait for one."""
LEAST_COST = 2e6
"""Least size of a chunk of logs [bytes]."""
ON_PAGE = 1000
"""Largest number of rows on the page, since long tables slow a browser down."""
LINKED = "a link to a file that could not be used; give the file itself to see why"
"""Reason for the failure of a log that is a link."""
BUG = "traceback"
"""Key of the traceback of a log that failed by a bug, and was not refused."""
WRITE_EVERY = 1.0
"""Seconds between two files of rows; files are slow, but a killed run loses the rows since the last one."""


def over_logs(
    verb: str,
    model: Any,
    logs: Sequence[Any],
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    scheduler: Scheduler | None = None,
    progress: Progress = notebook_line,
    **settings: Any,
) -> "LogsResult":
    """Call a verb for each of many logs, and report the logs that differ from the others.

    A log that cannot be used becomes a row with the reason, and the others are processed nevertheless. So is a log that
    ends in a bug; `bugs` of the result has the tracebacks. With a folder `out` the results are written as they come,
    and a run that was stopped or killed continues when it is called again. It recognises finished logs by the content
    of log, model and settings, so that a log that has changed is computed again.

    Args:
        verb: "estimate", "check", "fit" or "smooth".
        model: As for the verb.
        logs: Logs, each as for the verb.
        out: Folder for the table (such as `check.csv`), a page (`check.html`), and a file for each log: its estimates
            (.parquet) or its fitted model file (.toml). The table contains the names of these files. Each depends on
            the place of its log relative to the folder, and on no other log.
        workers: Processes; 1 by default. With 1, or for models or logs in memory, all is computed in this process.
        scheduler: Address of a Dask scheduler, or a `distributed.Client`, whose workers compute; they need access to
            logs, model and folder.
        progress: Called with a description and the fraction of the work that is done.
        **settings: Other arguments of the verb, the same for all logs.

    Returns:
        A table with a row for each log, and sentences on the logs that differ from the others.

    Raises:
        ValueError: The verb is unknown, there are no logs, or the number of workers is not possible.

    Example:
        >>> import covariant
        >>> from covariant import models, many, verbs
        >>> logs = [covariant.simulate("oscillator", duration=2.0, noise=1e-4, q0=[q]).record for q in (1.0, 2.0)]
        >>> result = many.over_logs("estimate", "oscillator", [*logs, "lost.csv"], alpha=40.0, beta=800.0)
        >>> result
        <LogsResult: estimate of 3 logs, 1 failed>
        >>> result.columns["rows"].tolist()
        [1001.0, 1001.0, nan]
    """
    if verb not in FILES:
        raise InputError(f"over_logs: {verb!r} is not one of {', '.join(FILES)}")
    if verb == "fit" and settings.get("each"):
        raise InputError(
            "`each` is for logs that are fitted together, by `fit` without a folder; with one, no number is shared"
        )
    if not logs:
        raise InputError("over_logs: there are no logs; give a list of them")
    logs = [part for log in logs for part in episodes(log, strict=False)]
    in_memory = not all(isinstance(each, str | os.PathLike) for each in (model, *logs))
    crew = Crew(workers, scheduler).check()
    if scheduler is None and (in_memory or workers is None):
        crew = Crew(1)
    crew = crew._replace(processes=crew.workers != 1)
    folder = None if out is None else Path(out).absolute()  # the workers of a cluster have their own working folders
    if folder is not None:
        if folder.is_file():
            raise InputError(f"{out}: there is a file of this name; give a folder")
        folder.mkdir(parents=True, exist_ok=True)
    table = None if folder is None or in_memory else CaseTable(folder / "cases")
    cases = _cases(verb, model, logs, folder, settings)
    rows = {} if table is None else _finished(cases, table)
    costs = {case.key: case.cost for case in cases}
    total, done, began = sum(costs.values()), sum(costs[key] for key in rows), time.monotonic()
    # By key, since a log may be given twice; the largest first, so that no worker ends long after the others.
    todo = sorted({case.key: case for case in cases if case.key not in rows}.values(), key=lambda case: -case.cost)
    most = max(LEAST_COST, (total - done) / (CHUNKS_A_WORKER * crew.size))
    begins = zip(itertools.accumulate((case.cost for case in todo), initial=0.0), todo, strict=False)
    chunks = [[case for _, case in each] for _, each in itertools.groupby(begins, lambda each: each[0] // most)]
    first, written, failed = done, began, Counter("failed" in row for row in rows.values())

    def report() -> None:
        progress(
            f"{verb}: {len(rows)} of {len(costs)} logs{f', {failed[True]} failed' * (True in failed)}"
            + time_left(began, first, done, total),
            done / max(total, 1),
        )

    report()
    fresh: dict[str, dict[str, Any]] = {}
    try:
        work = _Work(verb, model, settings)
        with contextlib.closing(run_chunks(work, chunks, crew, lambda chunk: [[case] for case in chunk])) as results:
            for chunk, result in results:
                if isinstance(result, BrokenExecutor):
                    result = {case.key: {"failed": str(result)} for case in chunk}
                # Failed logs are tried again, since the cause may be gone, such as a full disk.
                fresh |= {key: row for key, row in result.items() if "failed" not in row}
                rows |= result
                failed.update("failed" in row for row in result.values())
                done += sum(case.cost for case in chunk)
                report()
                if table is not None and fresh and time.monotonic() - written > WRITE_EVERY:
                    table.write(fresh)
                    fresh, written = {}, time.monotonic()
    except KeyboardInterrupt as stopped:
        goes_on = "; the same command goes on where it stopped" * (table is not None)
        raise KeyboardInterrupt(f"stopped{goes_on}") from stopped
    finally:
        if table is not None and fresh:
            table.write(fresh)
    for row in rows.values():
        row.pop("saved", None)
    bugs = {case.name: rows[case.key].pop(BUG) for case in cases if BUG in rows[case.key]}
    each = [LogRow(case.name, rows[case.key]) for case in cases]
    result = LogsResult(verb, file_name(str(model)), each, None if out is None else Path(out), bugs)
    if folder is not None:
        write_table(folder / f"{verb}.csv", result.columns)
        result.report(folder / f"{verb}.html")
    return result


class _Case(NamedTuple):
    """A log with its row.

    Attributes:
        log: The log.
        name: Its name.
        key: Hash of everything on which its row depends.
        path: File to write for it.
        cost: Its size [bytes].
        linked: Whether it is reached by a link, below the common folder of all logs.
    """

    log: Any
    name: str
    key: str
    path: Path | None
    cost: float
    linked: bool


def _cases(verb: str, model: Any, logs: Sequence[Any], folder: Path | None, settings: Any) -> list[_Case]:
    versions = {name: importlib.metadata.version(name) for name in ("covariant", "jax", "numpy")}
    whole = [verb, str(model), model_hash(model), versions, json.dumps(settings, sort_keys=True, default=repr)]
    cases, places = [], [os.path.abspath(Path(log).parent) for log in logs if isinstance(log, str | os.PathLike)]
    common = Path(os.path.commonpath(places) if places else ".")
    keys = [part_of(log)[0] if isinstance(log, str | os.PathLike) else id(log) for log in logs]
    # A file with many episodes is hashed once.
    files = {key: log if isinstance(key, int) else key for key, log in zip(keys, logs, strict=True)}
    parts = Counter(keys)
    with ThreadPoolExecutor() as pool:  # neither reading nor hashing holds the lock of the interpreter
        contents = dict(zip(files, pool.map(_content, files.values()), strict=True))
    for k, (log, file) in enumerate(zip(logs, keys, strict=True)):
        content, size = contents[file]
        name = source_name(log) if isinstance(log, str | os.PathLike) else f"{source_name(log)} {k + 1}"
        unique = name if folder is None or name != source_name(log) else _file_name(Path(log), folder)
        path = folder / f"{unique}{FILES[verb]}" if folder is not None and FILES[verb] else None
        linked = isinstance(log, str | os.PathLike) and _is_linked(Path(log), common)
        cases.append(_Case(log, name, content_hash([*whole, content, unique]), path, size / parts[file], linked))
    return cases


def _is_linked(log: Path, common: Path) -> bool:
    log = Path(os.path.abspath(log))
    return any(part.is_symlink() for part in (log, *log.parents) if common in part.parents)


def _file_name(log: Path, folder: Path) -> str:
    """File name of a log in a folder, without ending: the name of the log, and a hash of its place."""
    log = Path(os.path.abspath(log))
    # Relative to the folder, so that the names stay the same if logs and folder are moved together.
    place = os.path.relpath(log, folder) if log.drive == folder.drive else str(log)
    file, episode = part_of(log)
    number = "" if episode is None else f"_{episode}"
    return file_name(f"{log.parent.name}_{file.stem}{number}_{content_hash(place)[:8]}")


def _content(log: object) -> tuple[str, float]:
    """Hash of the content of a log, and its size [bytes]."""
    if not isinstance(log, str | os.PathLike):
        return f"{id(log)}", LEAST_COST
    digest, size, path = hashlib.sha256(), 1.0, Path(log)
    try:
        check_log(path)
        # A folder that is not a log may contain anything, so it is not read.
        bag = sorted(path.iterdir()) if (path / "metadata.yaml").exists() else []
        for file in filter(Path.is_file, bag or [path]):
            with file.open("rb") as content:
                digest.update(hashlib.file_digest(content, "sha256").digest())
            size += file.stat().st_size
    except (OSError, InputError) as error:
        return f"{path}: {error}", size  # what reads it says the same
    return digest.hexdigest(), size


def _finished(cases: Sequence[_Case], table: CaseTable) -> dict[str, dict[str, Any]]:
    """Rows of the cases that are finished and whose files exist unchanged."""
    rows = table.rows()
    there = {case.key: case.path for case in cases if case.key in rows}
    return {
        key: rows[key] for key, path in there.items() if "file" not in rows[key] or _saved(path) == rows[key]["saved"]
    }


def _saved(path: Path | None) -> int | None:
    """When a file was written [ns], to notice that a later run with another model or settings replaced it."""
    return path.stat().st_mtime_ns if path is not None and path.exists() else None


def _remove_earlier(path: Path | None) -> None:
    """Remove the file of a log that was written for another content of log or model."""
    with contextlib.suppress(OSError):  # of a full or broken disk, which the row says
        if path is not None:
            path.unlink(missing_ok=True)


class _Work(NamedTuple):
    """A verb with its model and settings, for any chunk of logs."""

    verb: str
    model: Any
    settings: dict[str, Any]

    def __call__(self) -> Callable[[Sequence[_Case]], dict[str, dict[str, Any]]]:
        kept: dict[Any, models.ModelFile] = {}

        def rows(chunk: Sequence[_Case]) -> dict[str, dict[str, Any]]:
            with models.loaded_once(kept):
                return {case.key: self.row(case) for case in chunk}

        return rows

    def row(self, case: _Case) -> dict[str, Any]:
        """Row of a log, or the reason why it failed."""
        try:
            result = getattr(verbs, self.verb)(self.model, case.log, progress=lambda *_: None, **self.settings)
            row = result.row
            if case.path is not None and getattr(result, "better", True):
                result.save(case.path, overwrite=True)
                return row | {"file": case.path.name, "saved": _saved(case.path)}
            _remove_earlier(case.path)
        except Exception as error:  # one log shall not stop the others
            _remove_earlier(case.path)
            refused = isinstance(error, InputError | OSError)
            kind = "" if refused else f"{type(error).__name__}: "
            reason = " ".join(f"{kind}{error}".split()).removeprefix(f"{case.name}: ") or type(error).__name__
            # The reason may quote the file, and a link may lead to a file that must not be shown with the logs.
            row = {"failed": LINKED if case.linked else printable(reason, keep="")}
            return row if refused else row | {BUG: traceback.format_exc()}
        return row


@dataclass(frozen=True, repr=False)
class LogsResult(AbstractTable):
    """Result of a verb over many logs: a row for each, and sentences on the logs that differ from the others.

    Attributes:
        verb: The verb, such as "check".
        model_name: The model, by its path or name.
        each: Rows of the logs, each with the name of its log, in their order.
        out: Folder of the table, the page and the files of the logs, if they were written.
        bugs: Tracebacks of the logs that failed by a bug and were not refused, by the name of the log.

    Example:
        >>> import covariant
        >>> logs = [covariant.simulate("oscillator", duration=2.0, noise=1e-4, q0=[q]).record for q in (1.0, 2.0)]
        >>> result = covariant.estimate("oscillator", logs, alpha=40.0, beta=800.0)
        >>> result.failed, sorted(result.columns)[:3]
        ({}, ['innovation_rms1', 'log', 'observer'])
    """

    verb: str
    model_name: str
    each: list[LogRow]
    out: Path | None = None
    bugs: Mapping[str, str] = field(default_factory=dict)

    @property
    def failed(self) -> dict[str, str]:
        """Reason why a log has no result, by its name."""
        return {name: row["failed"] for name, row in self.each if "failed" in row}

    @property
    def wrong(self) -> bool:
        """Whether a log failed, or contradicts the model file."""
        return bool(self.failed) or any(row.get("wrong") for _, row in self.each)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        rows = self._rows
        names = sorted({name for row in rows for name in row if name != "log"})
        texts = {name for row in rows for name, value in row.items() if isinstance(value, str)}
        empty = {name: ("", object) if name in texts else (np.nan, float) for name in ("log", *names)}
        return {name: np.array([row.get(name, none) for row in rows], dtype) for name, (none, dtype) in empty.items()}

    @property
    def _rows(self) -> list[dict[str, Any]]:
        """The rows, each with the name of its log and of its unusual numbers."""
        odd = self._among.odd
        return [
            {
                "log": name,
                **{key: row[key] for key in row if key != BUG},
                **({"odd": ", ".join(odd[k])} if k in odd else {}),
            }
            for k, (name, row) in enumerate(self.each)
        ]

    @property
    def warnings(self) -> tuple[str, ...]:
        return self._among.sentences

    @functools.cached_property
    def _among(self) -> Among:
        return among_logs(self.each)

    @property
    def summary(self) -> dict[str, Any]:
        found = {
            "verb": self.verb,
            "model": self.model_name,
            "logs": self._rows,
            "failed": self.failed,
            "among": self._among.sentences,
        }
        return found if self.out is None else found | {"out": str(self.out)}

    @property
    def headline(self) -> str:
        wrong = sum(bool(row.get("wrong")) for _, row in self.each)
        return f"{self.verb} of {len(self.each)} logs, {len(self.failed)} failed" + f", {wrong} wrong" * bool(wrong)

    @property
    def _blocks(self) -> list[Any]:
        # The rows to look at first.
        rows = sorted(self._rows, key=lambda row: not ("failed" in row or row.get("wrong") or "odd" in row))
        more = [f"{len(rows) - ON_PAGE} more logs are in the table (.csv)."] if len(rows) > ON_PAGE else []
        return ["# Logs", rows[:ON_PAGE], *more]

    written = (".csv",)

    def _write(self, path: Path) -> None:
        write_table(path, self.columns)

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.verbs.base.pages import write_result_page

        title = f"{self.verb.capitalize()} of {len(self.each)} logs by {Path(self.model_name).stem}"
        return write_result_page(path, title, self, self._blocks, {"model": self.model_name})

    def __str__(self) -> str:
        wrote = [] if self.out is None else [f"wrote {self.out / self.verb}.csv, {self.out / self.verb}.html"]
        return "\n".join([f"{self.headline}, by {self.model_name}", *self.warnings, *wrote])
