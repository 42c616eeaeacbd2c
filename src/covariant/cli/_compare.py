"""`covariant compare`: all estimators on the same log, tuned from the same data sheet, and ranked."""

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from covariant._files import write_atomically
from covariant.cli._console import stages
from covariant.cli._names import Engine
from covariant.design import Trial, observer_gains, tuned_estimators
from covariant.observers import AbstractObserver
from covariant.scoring import unwrap
from covariant.workflow._inputs import (
    Job,
    Loaded,
    ReferenceVelocity,
    as_read,
    check_output,
    coordinates,
    innovation_units,
    load,
    log_sheet,
    sought_columns,
)
from covariant.workflow._outcome import Outcome, drive, report_arrays, summary, worth_telling
from covariant.workflow._pages import write_report
from covariant.workflow._states import said_of_states, tuned_states

SHORTEST_TRIAL = 200
"""Rows that the first third of a log must have, so that filters can be tuned on it."""


LONGEST_TRIAL = 20_000
"""Largest number of these rows that are used: the search takes seconds on them, and minutes on a million."""


def compare(job: Job, out: Path | None, report: Path | None, engine: Engine, as_json: bool) -> None:
    """Run all estimators that fit the model, and write, print and draw the ranking."""
    check_output(out, ".csv", log=job.log)
    check_output(report, ".html")
    loaded = load(job)
    observers, note = line_up(loaded)
    outcomes: dict[str, Outcome] = {}
    with stages("comparing", len(observers), quiet=as_json) as begin:
        for name, observer in observers.items():
            begin(name)
            outcomes[name] = drive(observer, loaded, engine, timed=True)
    ranked = rank(outcomes, loaded)
    rows = tuple(_row(name, outcomes[name], loaded) for name in ranked)
    what = loaded.model.sought.what
    result: dict[str, Any] = {
        "model": job.model,
        "log": str(job.log),
        "scored_against": scored_against(loaded),
        "design": note,
        "ranking": [
            {"estimator": name, "engine": outcomes[name].engine, **summary(outcomes[name], what)} for name in ranked
        ],
    }
    if report is not None:
        curves = report_arrays({name: outcomes[name] for name in ranked})
        title = f"Estimators compared: {Path(job.model).stem}, {job.log.name}"
        result["report"] = [str(p) for p in write_report(report, title, loaded, curves, (note,), rows)]
    if out is not None:
        write_atomically(out, lambda file: file.write(_table(ranked, outcomes, loaded)))
        result["out"] = str(out)
    told = engines(outcomes) if any(worth_telling(each.engine, engine) for each in outcomes.values()) else []
    print(json.dumps(result) if as_json else _text(result, rows, what if loaded.reference else "prediction", told))


def line_up(loaded: Loaded) -> tuple[dict[str, AbstractObserver], str]:
    """The observers that are compared by name, and sentences on how they are tuned."""
    if not loaded.file.mechanical:
        return as_read(tuned_states(loaded), loaded), said_of_states(loaded.file) + loaded.note
    reference = loaded.reference
    assert reference is not None  # it was asked for
    sheet = log_sheet(loaded)
    trial = first_part(loaded, reference)
    note = f"All tuned from one data sheet; the observers have {observer_gains(sheet, loaded.rate).summary}."
    note += loaded.note
    if trial is not None:
        end = trial.t[-1] - np.asarray(loaded.record.t)[0]
        note += f" Filters that know no model are those that are best on the first {end:.3g} s of this very log."
    return as_read(tuned_estimators(loaded.model, loaded.file.dimension, sheet, loaded.rate, trial), loaded), note


def scored_against(loaded: Loaded) -> str:
    """What errors are errors against: without a reference, the measured outputs, predicted one sample ahead."""
    return "outputs, one sample ahead" if loaded.reference is None else loaded.reference.label


def first_part(loaded: Loaded, reference: ReferenceVelocity) -> Trial | None:
    """The first third of the log, at most `LONGEST_TRIAL` rows, with its velocities.

    None for a model that is not in coordinates, and for a log too short to tune on.
    """
    if not loaded.model.manifold.commuting:
        return None
    t = np.asarray(loaded.record.t)
    part = (t <= t[0] + (t[-1] - t[0]) / 3) & np.isfinite(reference.v).all(axis=1)
    part[np.flatnonzero(part)[LONGEST_TRIAL:]] = False
    y = unwrap(np.asarray(loaded.record.y), loaded.model.circles)[part]
    if part.sum() < SHORTEST_TRIAL or np.isfinite(y).sum(axis=0).min() < SHORTEST_TRIAL // 2:
        return None
    return Trial(t[part], y, reference.v[part])


def rank(outcomes: dict[str, Outcome], loaded: Loaded) -> list[str]:
    """Names in order of error, each column relative to the size of what it is an error of; diverged ones last."""
    reference = loaded.reference
    if reference is None:
        scale = np.nanstd(np.asarray(loaded.record.y), axis=0)
    else:
        scale = np.sqrt(np.mean(reference.v[reference.scored] ** 2, axis=0))

    def badness(name: str) -> float:
        relative = rmse(outcomes[name]) / np.where(scale > 0, scale, 1.0)
        total = float(np.sqrt(np.mean(relative**2)))
        return total if np.isfinite(total) else float("inf")

    return sorted(outcomes, key=badness)


def _row(name: str, outcome: Outcome, loaded: Loaded) -> dict[str, str | float]:
    form = "RMSE {} [{}]" if loaded.model.sought.names else "RMSE d{}/dt [{}/s]"
    labels, units = coordinates(loaded.file)
    if loaded.reference is None:
        labels, units = loaded.file.columns.q, innovation_units(loaded.file)
    errors = {
        form.format(label, unit).removesuffix(" []"): float(value)
        for label, unit, value in zip(labels, units, rmse(outcome), strict=True)
    }
    return {"estimator": name, **errors, **consistency(outcome), "µs a sample": round(outcome.microseconds, 1)}


def rmse(outcome: Outcome) -> np.ndarray:
    """Errors of what is scored: of the velocities or states, and without a reference of the predicted outputs."""
    if outcome.score is not None:
        return outcome.score.rmse
    innovation = np.asarray(outcome.run.info.innovation)
    return np.sqrt(np.mean(innovation[len(innovation) // 10 :] ** 2, axis=0))


def consistency(outcome: Outcome) -> dict[str, float]:
    """Normalised squares of innovations and of velocity errors, where 1 is expected; NaN for an estimator without."""
    return {"NIS": outcome.nis, "NEES": math.nan if outcome.score is None else outcome.score.nees}


def _table(ranked: list[str], outcomes: dict[str, Outcome], loaded: Loaded) -> bytes:
    """The ranking as CSV."""
    scored = sought_columns(loaded.file) if loaded.reference else loaded.file.columns.q
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["rank", "estimator", *(f"{name}_rmse" for name in scored), "nis", "nees", "microseconds"])
    for place, name in enumerate(ranked, start=1):
        told = ["" if math.isnan(value) else value for value in consistency(outcomes[name]).values()]
        rows.writerow([place, name, *rmse(outcomes[name]), *told, outcomes[name].microseconds])
    return text.getvalue().encode()


def engines(outcomes: dict[str, Outcome]) -> list[str]:
    """Which engine computed what, a line for each."""
    by: dict[str, list[str]] = {}
    for name, outcome in outcomes.items():
        by.setdefault(outcome.engine, []).append(name)
    return [f"engine of {', '.join(names)}: {engine}" for engine, names in by.items()]


def _text(result: dict[str, Any], rows: tuple[dict[str, str | float], ...], what: str, engines: list[str]) -> str:
    from covariant.report import table

    lines = [
        f"{result['log']}, {what} errors against the {result['scored_against']}",
        result["design"],
        "",
        table(rows),
        *engines,
    ]
    return "\n".join([*lines, *(f"wrote {path}" for path in [result.get("out"), *result.get("report", [])] if path)])
