"""`over_logs`: a verb over many logs, each by itself: a row of a table for each, and a folder of estimates."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from covariant import workflow
from covariant._cases import CaseTable, Crew, chunks_of, content_hash, run_chunks
from covariant.logs import source_name
from covariant.workflow._among_logs import LogRow, among_logs
from covariant.workflow._arguments import Scheduler
from covariant.workflow._model_output import read_sources
from covariant.workflow._outcome import summary
from covariant.workflow._outputs import write_table
from covariant.workflow._progress import Progress, notebook_line
from covariant.workflow._result import AbstractTable

FILES = {"estimate": ".parquet", "smooth": ".parquet", "fit": ".toml"}
"""Ending of the file of each log, by the verb; `check` has none."""
CHUNKS_A_WORKER = 16
"""Chunks that a worker gets at least: what is lost when the run is killed, and what it waits for at the end."""
LEAST_COST = 2e6
"""Bytes of logs that are a chunk at least."""


def over_logs(
    verb: str,
    model: Any,
    logs: Sequence[Any],
    *,
    out: str | Path | None = None,
    workers: int | None = 1,
    scheduler: Scheduler | None = None,
    progress: Progress = notebook_line,
    **settings: Any,
) -> "LogsResult":
    """Call a verb for each of many logs, and look for logs that are unlike the others.

    A log that cannot be used is a row that says why, and the others go on. With a folder `out` the results are written
    as they come, and a run that was stopped or killed goes on when it is called again: what is there is found by the
    content of log, model and settings, so that a log that has changed is computed anew.

    Args:
        verb: "estimate", "check", "fit" or "smooth".
        model: As for the verb.
        logs: Logs, each as for the verb.
        out: Folder for the table (such as `check.csv`), a page (`check.html`), and a file for each log: its estimates
            (.parquet) or its fitted model file (.toml).
        workers: Processes; None for one for each processor. With 1, and for models or logs in memory, all is computed
            in this process.
        scheduler: Address of a Dask scheduler, or a `distributed.Client`, whose workers compute; they need access to
            logs, model and folder.
        progress: Called with a description and the fraction of the work that is done.
        **settings: Other arguments of the verb, the same for all logs.

    Returns:
        A table with a row for each log, and sentences on the logs that are unlike the others.

    Raises:
        ValueError: For an unknown verb, no logs, or workers that make no sense.

    Example:
        >>> import covariant
        >>> from covariant import workflow
        >>> logs = [covariant.simulate("oscillator", duration=2.0, noise=1e-4, q0=[q]).record for q in (1.0, 2.0)]
        >>> result = workflow.over_logs("estimate", "oscillator", [*logs, "lost.csv"], alpha=40.0, beta=800.0)
        >>> result
        <LogsResult: estimate of 3 logs, 1 failed>
        >>> result.columns["rows"].tolist()
        [1001.0, 1001.0, nan]
    """
    if verb not in ("estimate", "check", "fit", "smooth"):
        raise ValueError(f"over_logs: {verb!r} is not one of estimate, check, fit, smooth")
    if verb == "fit" and settings.get("each"):
        raise ValueError(
            "`each` is for logs that are fitted together, by `fit` without a folder; with one, no number is shared"
        )
    if not logs:
        raise ValueError("over_logs: there are no logs; give a list of them")
    in_memory = not all(isinstance(each, str | os.PathLike) for each in (model, *logs))
    crew = Crew(1 if in_memory and scheduler is None else workers if scheduler is None else None, scheduler).check()
    crew = crew._replace(processes=crew.workers != 1)
    folder = None if out is None else Path(out).absolute()  # the workers of a cluster have their own working folders
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    table = None if folder is None or in_memory else CaseTable(folder / "cases")
    cases = _cases(verb, model, logs, folder, settings)
    rows = {} if table is None else _finished(cases, table)
    todo, costs = [case for case in cases if case.key not in rows], {case.key: case.cost for case in cases}
    total, done, began = sum(costs.values()), sum(costs[key] for key in rows), time.monotonic()
    # The largest first, so that no worker ends long after the others.
    todo.sort(key=lambda case: -case.cost)
    workers = crew.workers or os.cpu_count() or 1
    chunks = chunks_of(
        todo, [case.cost for case in todo], max(LEAST_COST, (total - done) / (CHUNKS_A_WORKER * workers))
    )
    first = done

    def report() -> None:
        failed = sum("failed" in row for row in rows.values())
        left = (time.monotonic() - began) * (total - done) / (done - first) if done > first else None
        progress(
            f"{verb}: {len(rows)} of {len(cases)} logs{f', {failed} failed' * bool(failed)}"
            + ("" if left is None else f", {left:.0f} s left"),
            done / max(total, 1),
        )

    report()
    while chunks:
        broken: list[list[_Case]] = []
        with closing(run_chunks(_Work(verb, model, settings), chunks, crew)) as results:
            for chunk, result in results:
                if isinstance(result, BrokenExecutor):
                    if len(chunk) > 1:  # one of its logs killed the process
                        broken += [[case] for case in chunk]
                        continue
                    result = {chunk[0].key: {"failed": str(result)}}
                # What another run may find otherwise, such as a full disk, is not kept.
                lasting = {key: row for key, row in result.items() if row.pop("lasting", False)}
                if table is not None and lasting:
                    table.write(lasting)
                rows |= result
                done += sum(costs[case.key] for case in chunk)
                report()
        chunks = broken
    result = LogsResult(verb, str(model), [LogRow(case.name, rows[case.key]) for case in cases])
    if folder is not None:
        write_table(folder / f"{verb}.csv", result.columns)
        result.report(folder / f"{verb}.html")
    return result


Verb = TypeVar("Verb", bound=Callable[..., Any])


def each_log(verb: Verb) -> Verb:
    """Make a verb of one log one of many: with a list of logs it is `over_logs`."""

    @functools.wraps(verb)
    def call(model: Any, log: Any, **settings: Any) -> Any:
        if type(log) not in (list, tuple):  # a Record is a tuple of another type
            return verb(model, log, **settings)
        return over_logs(verb.__name__, model, log, **settings)

    return cast(Verb, call)


class _Case(NamedTuple):
    """A log, its name, the hash of all that its row depends on, its file to write, and its size [bytes]."""

    log: Any
    name: str
    key: str
    path: Path | None
    cost: float


def _cases(verb: str, model: Any, logs: Sequence[Any], folder: Path | None, settings: Any) -> list[_Case]:
    versions = {name: importlib.metadata.version(name) for name in ("covariant", "jax", "numpy")}
    whole = [verb, str(model), _model_hash(model), versions, json.dumps(settings, sort_keys=True, default=repr)]
    names = [source_name(log) for log in logs]
    names = [f"{name} {k + 1}" if name in ("record", "table", "dataset") else name for k, name in enumerate(names)]
    stems, places = (
        [Path(name).stem for name in names],
        [f"{Path(name).parent.name}_{Path(name).stem}" for name in names],
    )
    of_stems, of_places, cases = Counter(stems), Counter(places), []
    for log, name, stem, place in zip(logs, names, stems, places, strict=True):
        # Not by number, so that a name does not depend on the order.
        long = place if of_places[place] == 1 else f"{place}_{content_hash(name)[:8]}"
        unique = stem if of_stems[stem] == 1 else long
        path = folder / f"{unique}{FILES[verb]}" if folder is not None and verb in FILES else None
        content, cost = _content(log)
        cases.append(_Case(log, name, content_hash([*whole, content, unique]), path, cost))
    return cases


def _content(log: Any) -> tuple[str, float]:
    """Hash of the content of a log, and its size [bytes]."""
    if not isinstance(log, str | os.PathLike):
        return f"{id(log)}", 1.0
    digest, size, path = hashlib.sha256(), 1.0, Path(log)
    try:
        # A folder that is no log may hold anything, and is not read.
        bag = sorted(path.iterdir()) if (path / "metadata.yaml").exists() else []
        for file in filter(Path.is_file, bag or [path]):
            with file.open("rb") as content:
                digest.update(hashlib.file_digest(content, "sha256").digest())
            size += file.stat().st_size
    except OSError as error:
        return f"{path}: {error}", size  # what reads it says the same
    return digest.hexdigest(), size


def _model_hash(model: Any) -> list[str]:
    """Hashes of the files that a model is read from."""
    contents = list(read_sources(model).values())
    module = str(model).partition(":")[0]
    if isinstance(model, str) and ":" in model and all(part.isidentifier() for part in module.split(".")):
        spec = importlib.util.find_spec(module)
        if spec is not None and spec.origin is not None:
            contents.append(Path(spec.origin).read_bytes())
    return [hashlib.sha256(content).hexdigest() for content in contents]


def _finished(cases: Sequence[_Case], table: CaseTable) -> dict[str, dict[str, Any]]:
    """Rows of the cases that are done, and whose files are there."""
    if not table.folder.is_dir():
        return {}
    rows = {key: {name: value for name, value in row.items() if value is not None} for key, row in table.rows().items()}
    there = [case for case in cases if case.key in rows]
    return {
        case.key: rows[case.key]
        for case in there
        if case.path is None or case.path.exists() or not rows[case.key].get("file")
    }


class _Work(NamedTuple):
    """A verb with its model and settings, for any chunk of logs."""

    verb: str
    model: Any
    settings: dict[str, Any]

    def __call__(self) -> Callable[[Sequence[_Case]], dict[str, dict[str, Any]]]:
        return lambda chunk: {case.key: self.row(case) for case in chunk}

    def row(self, case: _Case) -> dict[str, Any]:
        """Row of a log, or why it has none."""
        try:
            result = getattr(workflow, self.verb)(self.model, case.log, progress=_silent, **self.settings)
            row = _row(result)
            if case.path is not None and getattr(result, "better", True):
                result.save(case.path, overwrite=True)
                row["file"] = case.path.name
        except Exception as error:  # one log shall not stop the others
            # Refusals are of type ValueError, and depend on log and model alone.
            kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
            reason = " ".join(f"{kind}{error}".split()).removeprefix(f"{case.name}: ") or type(error).__name__
            return {"failed": reason, "lasting": isinstance(error, ValueError)}
        return row | {"lasting": True}


def _silent(description: str, fraction: float | None = None) -> None:
    pass


def _row(result: Any) -> dict[str, Any]:
    """Numbers and short texts of a result, by column."""
    if isinstance(result, workflow.FitResult):
        values = zip(result.columns["parameter"], result.values, result.standard_errors, strict=True)
        numbers = [(name, float(value), f"{name}_std", float(std)) for name, value, std in values]
        row = {key: number for each in numbers for key, number in (each[:2], each[2:])}
        return row | {"better": "yes" if result.better else "no"}
    if isinstance(result, workflow.CheckResult):
        named = {True: [], False: []}
        for finding in result.findings:
            named[finding.wrong].append(f"{finding.what} of {finding.where}" if finding.where else finding.what)
        lines = [finding.line for finding in result.findings if finding.wrong and finding.line]
        row = {"rows": float(result.rows), "rate": result.rate, "verdict": "WRONG" if result.wrong else "ok"}
        return row | {"wrong": "; ".join(named[True]), "notes": "; ".join(named[False]), "what to do": "; ".join(lines)}
    # Without the comparison with filters that know no model, which takes three quarters of the time of `estimate`.
    of_filter = result.filtered if isinstance(result, workflow.SmoothResult) else result
    numbers = summary(of_filter.outcome, of_filter.loaded.kind.what)
    row = {"observer": of_filter.observer_name, "rows": float(len(of_filter.t))} | dict(_flat(numbers))
    return row | ({} if of_filter.loaded.origin is None else {"t_counts_from": of_filter.loaded.origin})


def _flat(summary: Mapping[str, Any], before: str = ""):
    for name, value in summary.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}_")
        elif isinstance(value, list):
            numbers = [each for each in value if isinstance(each, int | float)]
            yield from _flat({f"{name}{k + 1}": each for k, each in enumerate(numbers)}, before)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{before}{name}", float(value)
        elif isinstance(value, str):
            yield f"{before}{name}", value


@dataclass(frozen=True, repr=False)
class LogsResult(AbstractTable):
    """A verb over many logs: a row for each, and sentences on those that are unlike the others.

    Attributes:
        verb: The verb, such as "check".
        model_name: The model, by its path or name.
        each: Rows of the logs, each with the name of its log, in their order.

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

    @property
    def failed(self) -> dict[str, str]:
        """Why a log has no result, by its name."""
        return {name: row["failed"] for name, row in self.each if "failed" in row}

    @property
    def wrong(self) -> bool:
        """Whether a log failed, or is not what the model file says it is."""
        return bool(self.failed) or any(row.get("wrong") for _, row in self.each)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        names = dict.fromkeys(name for _, row in self.each for name in row)
        texts = {name for _, row in self.each for name, value in row.items() if isinstance(value, str)}
        return {"log": np.array([name for name, _ in self.each], dtype=object)} | {
            name: np.array([row.get(name, "") for _, row in self.each], dtype=object)
            if name in texts
            else np.array([row.get(name, np.nan) for _, row in self.each], float)
            for name in sorted(names)
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        return (*(f"{name}: {reason}" for name, reason in self.failed.items()), *self._among)

    @functools.cached_property
    def _among(self) -> tuple[str, ...]:
        return among_logs(self.each)

    @property
    def summary(self) -> dict[str, Any]:
        rows = [{"log": name, **row} for name, row in self.each]
        return {"verb": self.verb, "model": self.model_name, "logs": rows, "failed": self.failed, "among": self._among}

    @property
    def headline(self) -> str:
        wrong = sum(bool(row.get("wrong")) for _, row in self.each)
        return f"{self.verb} of {len(self.each)} logs, {len(self.failed)} failed" + f", {wrong} wrong" * bool(wrong)

    @property
    def _blocks(self) -> list[Any]:
        return ["# Logs", [{"log": name, **row} for name, row in self.each]]

    written = (".csv",)

    def _write(self, path: Path) -> None:
        write_table(path, self.columns)

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.workflow._pages import write_result_page

        title = f"{self.verb.capitalize()} of {len(self.each)} logs by {Path(self.model_name).stem}"
        return write_result_page(path, title, self, self._blocks, {"model": self.model_name})

    def __str__(self) -> str:
        return "\n".join([f"{self.headline}, by {self.model_name}", *self.warnings])
