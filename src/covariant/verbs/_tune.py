"""`tune`: noise and gains from logs, judged on rows that were not used, as lines for the model file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant.engine import EngineName
from covariant.verbs.base.arguments import ColumnNames, Overrides
from covariant.verbs.base.model_output import as_logs, read_sources, write_models
from covariant.verbs.base.model_text import WRITTEN_BY
from covariant.verbs.base.outputs import check_output
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult


def tune(
    model: Any,
    log: Any,
    *,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    engine: EngineName = "auto",
    progress: Progress = notebook_line,
) -> "TuneResult":
    """Tune noise and gains to logs by the prediction of their measurements, and judge them on what was held out.

    Use it where sensor noise and model error are not known. The result has lines for the model file, which `estimate`,
    `compare` and `export` use once they are written there. Parameters of the model should be right before: noise that
    is tuned with a wrong mass covers its error. Use `fit` for them. The motion in the logs should be like that of later
    use.

    Args:
        model: A model file (.toml), a robot (.urdf, .xml), `module:attribute`, the name of a system or a robot of the
            library, a `ModelFile`, or a mechanical system.
        log: A path, a `Record`, a DataFrame or an xarray Dataset, or a list of them. The last third of each is held out
            to judge the tuning by.
        columns: Names of columns by field (t, q, u) that replace those of the model file.
        overrides, every, start, until, anyway, engine, progress: As for `estimate`.

    Returns:
        Lines for the model file, and the errors on what is held out, before and after.

    Raises:
        MisfitError: Where the model explains nothing of the motion in a log.
        ValueError: For a model or a log that cannot be used, such as one that is too short.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=8.0, rate=50.0, q0=1.0, noise=1e-3).record
        >>> result = covariant.tune("oscillator", log)
        >>> sorted(result.lines["design"])
        ['damping', 'natural_frequency', 'observer']
    """
    logs, sources = as_logs(log), read_sources(model)
    # What computes is loaded after the arguments are checked.
    from covariant.verbs.base.inputs import Job
    from covariant.verbs.base.tune_to_logs import tune_to_logs

    jobs = [Job(model, one, overrides, every, until, columns or {}, anyway, start) for one in logs]
    return TuneResult(jobs, tune_to_logs(jobs, engine, progress, sources), engine, sources)


@dataclass(frozen=True, repr=False)
class TuneResult(AbstractResult):
    """Noise and gains tuned to logs: lines for the model file, and how good they are on what was held out.

    Attributes:
        jobs: The model and the logs, a `Job` each.
        tuned: The tuning, with what it was computed from, a `Tuned`.
        asked_engine: The engine that was asked for.
        sources: Files that the model was read from, as they were then; None where they are read at `save`.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=8.0, rate=50.0, q0=1.0, noise=1e-3).record
        >>> result = covariant.tune("oscillator", log)
        >>> sorted(result.lines)
        ['design', 'measurement', 'uncertainty']
        >>> bool(abs(result.lines["measurement"]["std"] - 1e-3) < 1e-4)
        True
    """

    jobs: list[Any]
    tuned: Any
    asked_engine: str
    sources: Mapping[Path, bytes] | None = None

    @property
    def tuning(self) -> Any:
        """Gains and noise as numbers, a `covariant.calibration.Tuning`."""
        return self.tuned.tuning

    @property
    def lines(self) -> dict[str, dict[str, Any]]:
        """Numbers that are written into the model file, by table, such as "measurement", and key, such as "std"."""
        return self.tuned.details["lines"]

    @property
    def summary(self) -> dict[str, Any]:
        return self.tuned.details

    @property
    def headline(self) -> str:
        design = self.lines["design"]
        gains, kalman = self.summary["held_out"]["after"]["relative"]
        return (
            f"natural frequency {design['natural_frequency']:g} rad/s, damping {design['damping']:g}; held-out errors "
            f"of {gains:.3g} (gains) and {kalman:.3g} (Kalman filter) of the velocity"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        warning = self.summary["warning"]
        return (f"Warning: {warning}.",) if warning else ()

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the model file with the tuned numbers (.toml); comments and layout stay.

        Args:
            path: The file to write.
            overwrite: Whether a file that exists may be replaced, the model file itself included.

        Returns:
            The path.

        Raises:
            ValueError: Where it may not be written, the file to replace was changed since it was read, or the model has
                no file.
        """
        names = ", ".join(Path(job.log_name).name for job in self.jobs)
        head = f"{WRITTEN_BY['tune']}{names}.\n\n"
        write_models(self.jobs[0].model, {Path(path): (head, self.tuned.content)}, overwrite, self.sources)
        return Path(path)

    def report(self, path: str | Path) -> list[Path]:
        """Write an interactive page of estimates on the last log before and after, and figures (.png) beside it.

        Args:
            path: The page to write (.html).

        Returns:
            The paths of all files, the page first.

        Raises:
            ValueError: For another suffix, or a folder that does not exist.
            ImportError: Without matplotlib or plotly; nothing is written then.
        """
        from covariant.report import write_report
        from covariant.verbs.base.tune_to_logs import tuned_page

        check_output(Path(path), ".html")
        logs = ", ".join(Path(job.log_name).name for job in self.jobs)
        title = f"Gains of {Path(self.jobs[0].model_name).stem} tuned on {logs}"
        page = tuned_page(
            title,
            self.jobs[-1],
            self.tuned,
            tuple(self.summary["notes"]),
            rows=tuple(_rows(self.summary)),
            headline=self.headline,
            warnings=self.warnings,
            code="\n".join(_lines(self.summary)).replace("\n[", "\n\n["),
        )
        return write_report(page, Path(path))

    def __str__(self) -> str:
        from covariant.report import table

        result = self.summary
        lines = [
            f"{result['rows']} rows of the first two thirds of {', '.join(result['logs'])}; errors (RMS) on the rest, "
            f"of velocities against the {result['scored_against']}:",
            "",
            table(tuple(_rows(result))),
        ]
        gains, kalman = result["held_out"]["after"]["relative"]
        errors = f"constant gains {gains:.3g}, Kalman filter {kalman:.3g}"
        lines.append(f"Velocity errors as parts of the velocity: {errors}.")
        engine = () if self.asked_engine == "auto" else (f"engine: {result['engine']}",)
        return "\n".join([*lines, *result["notes"], *self.warnings, "", *_lines(result), *engine])


def _lines(result: dict[str, Any]) -> list[str]:
    """The lines for the model file."""
    lines = []
    for table, numbers in result["lines"].items():
        lines += [f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in numbers.items())]
    return lines


def _rows(result: dict[str, Any]) -> list[dict[str, str | float]]:
    rows = []
    for when, judged in result["held_out"].items():
        if judged is None:
            continue
        row: dict[str, Any] = {"": when}
        for i, (name, unit) in enumerate(zip(result["coordinates"], result["units"], strict=True)):
            row[f"{name} one step ahead [{unit}]"] = judged["one_step"][i]
            row[f"{result['velocities'][i]}, gains [{unit}/s]"] = judged["gains_error"][i]
            row[f"{result['velocities'][i]}, Kalman [{unit}/s]"] = judged["kalman_error"][i]
        row["log-likelihood"], row["NIS"] = judged["likelihood"][0], judged["nis"][0]
        row["correlation"] = max(judged["correlation"], key=abs)
        rows.append(row)
    return rows
