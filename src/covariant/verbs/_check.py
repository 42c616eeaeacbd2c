"""`check`: what is wrong with a log, or with the model file for it, before anybody estimates from it."""

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs, models
from covariant._door import parse_toml
from covariant.calibration import Beside, Diagnosis, Finding, diagnose, mended_clock
from covariant.models import Overrides
from covariant.observers import on_legs
from covariant.signals import Record, acting_inputs
from covariant.verbs.base.among_logs import AT_REST, IDLE
from covariant.verbs.base.inputs import ColumnNames, Job, Loaded, load
from covariant.verbs.base.open_numbers import open_numbers
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError


def check(
    model: Any,
    log: Any,
    *,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    progress: Progress = notebook_line,
) -> "CheckResult":
    """Compare a log with a model: clock, units, order and signs of columns, delays, ticks, noise, outliers, gaps.

    Each sensor of the model file that the log has is compared with what the positions predict of it: sign, axes, unit,
    delay, bias and noise.

    Args:
        model: A mechanical model, or the base of a robot on legs, in any of the forms that `estimate` takes.
        log, overrides, every, start, until, progress: As for `estimate`.
        columns: Names of columns by field (t, q, u) that replace those of the model file.

    Returns:
        The findings, the worst first, each with its evidence and with the line to write into the model file, or what to
        do with the log.

    Raises:
        ValueError: For a model or a log that cannot be used at all.

    Example:
        >>> import numpy as np
        >>> import covariant
        >>> t = np.arange(0.0, 20.0, 0.01)
        >>> y = 0.3 * np.cos(t) + 1e-4 * np.random.default_rng(0).normal(size=t.size)
        >>> log = covariant.Record(t, np.zeros((t.size, 1)), y[:, None])
        >>> covariant.check("oscillator", log)
        <CheckResult: nothing found in 2000 rows>
        >>> result = covariant.check("oscillator", log._replace(t=1e3 * log.t))
        >>> [(finding.what, finding.line) for finding in result.findings]
        [('unit of time', '[units] t = "ms"')]
    """
    job = Job(model, log, overrides, every, until, columns or {}, True, start)
    progress(f"comparing {job.log_name} with {job.model_name}")
    loaded, diagnosis = _diagnose(job)
    if diagnosis.wrong:
        progress("checking the log again with what it asks for")
        diagnosis = _with_remedies_that_survive(job, diagnosis)
    diagnosis = diagnosis._replace(findings=tuple(_with_names(finding, job) for finding in diagnosis.findings))
    return CheckResult(job.model_name, job.log_name, len(loaded.log.record.t), loaded.rate, diagnosis, loaded.origin)


def _diagnose(job: Job) -> tuple[Loaded, Diagnosis]:
    clock: tuple[Finding, ...] = ()
    file = models.load(job.model, job.overrides)
    why = "" if on_legs(file.model) else "logs are compared with"
    try:
        loaded = load(job, score=False, why=why)
    except logs.ClockError as error:
        record, clock = mended_clock(error.record)
        loaded = load(job._replace(log=record), score=False, why=why)
    # The quantum is that of the model file: loading removes it where positions are not such ticks.
    quantum = file.quantum
    pairs = zip(loaded.sensors, loaded.log.readings, strict=False)  # no sensors where the log has none of their columns
    sensors = [Beside(*part, read) for part, read in pairs if read is not None]
    record = loaded.log.record._replace(y=loaded.kind.complete(np.asarray(loaded.log.record.y)))
    if loaded.file.input_between == "held":  # what acted between two rows that are used counts in their interval
        record = acting_inputs(loaded.log.all_rows, rows=record)
    rows = (loaded.log.first_row, loaded.log.every)
    family = None if file.input_kind == "command" else _family_of_guesses(job)
    diagnosis = diagnose(loaded.file, record, quantum, *rows, sensors, loaded.log.v, family)
    return loaded, diagnosis._replace(findings=(*clock, *diagnosis.findings))


def _family_of_guesses(job: Job) -> Callable[[], Any] | None:
    """Function that makes the family of a model with its numbers open; None for a model in memory, or without any."""
    if not isinstance(job.model, str | PathLike):
        return None
    spec = os.fspath(job.model)
    names = open_numbers(spec, job.overrides)
    if models.document(spec, job.overrides).get("system") == "robot":
        return (lambda: models.robot_family(spec, names, job.overrides)) if names else None
    return (lambda: models.family(spec, names, job.overrides)) if names else None


_SETTING = re.compile(r"""\[(\w+|servo\.[\w-]+)\] (\w+) = ("[^"]*"|\[(?:"[^"]*"|[^]"])*\]|[-+\w.]+)""")
"""A line of a model file within a remedy: its table, key and value."""
_WINDOW = re.compile(r"(start|until) = ([\d.]+) keeps")
"""A part of the log that a remedy keeps."""
_NOT_OF_A_RECORD = ("units", "columns")
"""Tables that say how a file is read, and nothing of a record."""


def _settings(line: str) -> dict[str, Any]:
    """The lines of a model file that a remedy begins with, as overrides; empty if it asks for something else first."""
    settings: dict[str, Any] = {}
    for part in line.split("; "):
        match = _SETTING.match(part)
        if match is not None:
            settings[f"{match[1]}.{match[2]}"] = parse_toml(f"x = {match[3]}")["x"]
    return settings


def _with_remedies_that_survive(job: Job, diagnosis: Diagnosis) -> Diagnosis:
    """The findings, without the remedies after which the log is called wrong for the same reason as before.

    The lines are pasted in memory, one finding after the other, as somebody would who mends the first one first.
    """
    of_record, findings, pasted = isinstance(job.log, Record), [], dict[str, Any]()
    for finding in diagnosis.findings:
        settings = _settings(finding.line) if finding.wrong else {}
        window = {key: float(value) for key, value in _WINDOW.findall(finding.line)[:1]} if finding.wrong else {}
        if not (settings or window) or (of_record and any(key.startswith(_NOT_OF_A_RECORD) for key in settings)):
            findings.append(finding)
            continue
        pasted |= settings
        changed = job._replace(overrides=_more(job.overrides, pasted), **window)
        try:
            again = _diagnose(changed)[1].findings
            before = {each.what for each in diagnosis.findings}
            survives = not any(
                (each.what, each.where) == (finding.what, finding.where)
                or (each.what == "model" and "model" not in before)
                for each in again
                if each.wrong
            )
        except (InputError, OSError):
            survives = False
        if not survives:
            pasted = {key: value for key, value in pasted.items() if key not in settings}
            line = "look at what the column is and at [parameters]: no line of the model file mends it alone"
            finding = finding._replace(line=line)
        findings.append(finding)
    return diagnosis._replace(findings=tuple(findings))


def _more(overrides: Overrides, settings: Mapping[str, Any]) -> Overrides:
    """Overrides with further ones after them."""
    if isinstance(overrides, Mapping):
        return {**overrides, **settings}
    return (*overrides, *(f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in settings.items()))


@dataclass(frozen=True, repr=False)
class CheckResult(AbstractResult):
    """Comparison of a log with a model: the findings, and what was looked for.

    Attributes:
        model: Name of the model.
        log: Name of the log.
        rows: Number of rows that were read.
        rate: Sampling rate [Hz], from the median interval.
        diagnosis: The findings, the worst first, and what was looked for.
        t_counts_from: Date in UTC from which the stamps count; None unless the log has dates.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=10.0, rate=50.0, q0=1.0, noise=1e-3).record
        >>> result = covariant.check("oscillator", log._replace(t=1e3 * log.t))
        >>> result.wrong, result.findings[0].what
        (True, 'unit of time')
    """

    model: str
    log: str
    rows: int
    rate: float
    diagnosis: Diagnosis
    t_counts_from: str | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings, the worst first."""
        return self.diagnosis.findings

    @property
    def wrong(self) -> bool:
        """Whether estimates are wrong as long as neither the log nor the model file is corrected."""
        return self.diagnosis.wrong

    @property
    def row(self) -> dict[str, Any]:
        """Verdict and findings: the row of this log in a table of many."""
        named: dict[bool, list[str]] = {True: [], False: []}
        for finding in self.findings:
            named[finding.wrong].append(f"{finding.what} of {finding.where}" if finding.where else finding.what)
        lines = [finding.line for finding in self.findings if finding.wrong and finding.line]
        row = {"rows": float(self.rows), "rate": self.rate, "verdict": "WRONG" if self.wrong else "ok"}
        if named[True] and all(each.what in AT_REST for each in self.findings if each.wrong):
            row["verdict"] = IDLE  # one machine of many may rest
            named = {True: [], False: [*named[True], *named[False]]}
        row |= {"wrong": "; ".join(named[True]), "notes": "; ".join(named[False]), "what to do": "; ".join(lines)}
        return row | ({} if self.t_counts_from is None else {"t_counts_from": self.t_counts_from})

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "model": self.model,
            "log": self.log,
            "rows": self.rows,
            "wrong": self.wrong,
            "findings": [finding._asdict() for finding in self.findings],
            "looked_for": self.diagnosis.looked_for,
            "skipped": self.diagnosis.skipped,
        }

    @property
    def headline(self) -> str:
        if not self.findings:
            return f"nothing found in {self.rows} rows"
        wrong = sum(finding.wrong for finding in self.findings)
        return f"{wrong} wrong, {len(self.findings) - wrong} worth knowing, in {self.rows} rows"

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings that are wrong, a sentence each."""
        return tuple(f"{_name(each)}: {each.evidence}; {each.line}" for each in self.findings if each.wrong)

    @property
    def _blocks(self) -> list[Any]:
        rows = [
            {
                "": "WRONG" if each.wrong else "note",
                "finding": _name(each),
                "evidence": each.evidence,
                "what to do": each.line or None,
            }
            for each in self.findings
        ]
        return [rows] if rows else []

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.verbs.base.pages import write_result_page

        skipped = ", ".join(self.diagnosis.skipped)
        facts = {"model": self.model, "log": f"{self.log}, {self.rows} rows at {self.rate:.4g} Hz"}
        facts |= {"looked for": ", ".join(self.diagnosis.looked_for)} | ({"not looked for": skipped} if skipped else {})
        title = f"{Path(self.log).name} checked against {Path(self.model).stem}"
        return write_result_page(path, title, self, self._blocks, facts)

    def __str__(self) -> str:
        wrong = sum(finding.wrong for finding in self.findings)
        notes, checks = len(self.findings) - wrong, len(self.diagnosis.looked_for)
        counted = f"{notes} note{'s' * (notes != 1)}, {checks} check{'s' * (checks != 1)}"
        verdict = f"WRONG: the log is not what the model file says it is ({wrong} wrong, {counted})"
        looked = f"looked for: {', '.join(self.diagnosis.looked_for)}"
        if self.diagnosis.skipped:
            looked += f"; not looked for, since this log shows no accelerations: {', '.join(self.diagnosis.skipped)}"
        return "\n".join(
            [
                verdict if self.wrong else f"OK: nothing wrong ({counted})",
                f"{self.log}: {self.rows} rows at {self.rate:.4g} Hz, compared with {self.model}",
                *(line for finding in self.findings for line in ("", *_lines(finding))),
                *([""] if self.findings else []),
                looked,
            ]
        )


def _with_names(finding: Finding, job: Job) -> Finding:
    """The finding whose command names this model and this log, where both have a name."""
    if not all(isinstance(each, str | PathLike) for each in (job.model, job.log)):
        return finding
    return finding._replace(line=finding.line.replace("MODEL LOG", shlex.join([job.model_name, job.log_name])))


def _name(finding: Finding) -> str:
    return f"{finding.what} of {finding.where}" if finding.where else finding.what


def _lines(finding: Finding) -> list[str]:
    mark = "WRONG" if finding.wrong else "note"
    lines = [f"{mark:<6}{_name(finding)}", f"      {finding.evidence}"]
    return [*lines, f"      -> {finding.line}"] if finding.line else lines
