"""`covariant compare`: every estimator on the same log, tuned from the same data sheet, ranked."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from covariant._files import write_atomically
from covariant.cli._console import stages
from covariant.cli._job import Job, Loaded, check_output, coordinates, data_sheet, load, velocity_columns
from covariant.cli._pages import write_report
from covariant.cli._results import Outcome, drive, report_arrays, summary
from covariant.design import line_up, observer_gains


def compare(job: Job, out: Path | None, report: Path | None, as_json: bool) -> None:
    """Run the whole line-up and write, print and draw the ranking."""
    check_output(out, ".csv", log=job.log)
    check_output(report, ".html")
    loaded = load(job)
    sheet = data_sheet(loaded.file)
    observers = line_up(loaded.model, loaded.file.dimension, sheet, loaded.rate)
    outcomes: dict[str, Outcome] = {}
    with stages("comparing", len(observers), quiet=as_json) as begin:
        for name, observer in observers.items():
            begin(name)
            outcomes[name] = drive(observer, loaded, timed=True)
    ranked = rank(outcomes, loaded)
    rows = tuple(_row(name, outcomes[name], loaded) for name in ranked)
    note = f"All tuned from one data sheet; the observers have {observer_gains(sheet, loaded.rate).summary}."
    result: dict[str, Any] = {
        "model": job.model,
        "log": str(job.log),
        "scored_against": loaded.reference_label,
        "design": note,
        "ranking": [{"estimator": name, **summary(outcomes[name])} for name in ranked],
    }
    if out is not None:
        write_atomically(out, lambda file: file.write(_table(ranked, outcomes, velocity_columns(loaded.file))))
        result["out"] = str(out)
    if report is not None:
        curves = report_arrays({name: outcomes[name] for name in ranked})
        title = f"Estimators compared: {Path(job.model).stem}, {job.log.name}"
        result["report"] = [str(p) for p in write_report(report, title, loaded, curves, (note,), rows)]
    print(json.dumps(result) if as_json else _text(result, rows))


def rank(outcomes: dict[str, Outcome], loaded: Loaded) -> list[str]:
    """Names by velocity error, each coordinate weighed by the size of its velocities; escaped ones last."""
    scale = np.sqrt(np.mean(loaded.reference[loaded.scored] ** 2, axis=0))

    def badness(name: str) -> float:
        relative = outcomes[name].velocity_rmse / np.where(scale > 0, scale, 1.0)
        total = float(np.sqrt(np.mean(relative**2)))
        return total if np.isfinite(total) else float("inf")

    return sorted(outcomes, key=badness)


def _row(name: str, outcome: Outcome, loaded: Loaded) -> dict[str, str | float]:
    form = "RMSE {} [{}]" if loaded.model.velocities else "RMSE d{}/dt [{}/s]"
    errors = {
        form.format(label, unit): float(value)
        for label, unit, value in zip(*coordinates(loaded.file), outcome.velocity_rmse, strict=True)
    }
    return {"estimator": name, **errors, "µs a sample": round(outcome.microseconds, 1)}


def _table(ranked: list[str], outcomes: dict[str, Outcome], velocities: tuple[str, ...]) -> bytes:
    """The ranking as CSV."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["rank", "estimator", *(f"{name}_rmse" for name in velocities), "microseconds"])
    for place, name in enumerate(ranked, start=1):
        rows.writerow([place, name, *outcomes[name].velocity_rmse, outcomes[name].microseconds])
    return text.getvalue().encode()


def _text(result: dict[str, Any], rows: tuple[dict[str, str | float], ...]) -> str:
    from covariant.report import table

    lines = [
        f"{result['log']}, velocity errors against the {result['scored_against']}",
        result["design"],
        "",
        table(rows),
    ]
    return "\n".join([*lines, *(f"wrote {path}" for path in [result.get("out"), *result.get("report", [])] if path)])
