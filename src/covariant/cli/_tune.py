"""`covariant tune`: noise and gains from logs, judged on rows that were not used, as lines for the model file."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from covariant import models
from covariant._files import write_atomically
from covariant.cli._console import stages
from covariant.cli._fit import check_out, when_true
from covariant.cli._names import Engine
from covariant.design import DataSheet, HeldOut, Tuning, observer_gains, tune
from covariant.engine import FEWEST_ROWS, run_logs
from covariant.observers import AbstractObserver, Intrinsic
from covariant.signals import Record, Run
from covariant.workflow._inputs import Job, Loaded, coordinates, data_sheet, with_sensor_delays
from covariant.workflow._outcome import drive, report_curves, rounded
from covariant.workflow._pages import estimate_report, write_report

DIGITS = 4
"""Significant digits of tuned numbers in a model file."""
WORSE = 1.2
"""Ratio of the velocity errors of Kalman filter and constant gains from which it is said that the filter is worse."""
COARSER = 1.5
"""Readings whose noise is more than so many times that of their ticks are taken as noisy, not as ticks."""
SEARCHED = 60
"""So many runs a search for gains makes about."""
NOT_WHITE = 0.3
"""Correlation of neighbouring innovations from which it is said that the model does not explain them."""


def tune_model(
    jobs: list[Job], out: Path | None, overwrite: bool, report: Path | None, engine: Engine, as_json: bool
) -> None:
    """Tune on the first two thirds of each log, judge on the rest, print the lines for the model file and write it."""
    spec = jobs[0].model
    text = check_out(spec, out, overwrite)
    with stages("tuning", 6, quiet=as_json) as begin:
        begin("reading")
        loaded = [when_true(job) for job in jobs]
        file = loaded[0].file
        before = None
        if file.typical_std is not None and file.acceleration_std is not None:
            before = data_sheet(file)
        known = None if file.quantum is None else np.broadcast_to(np.asarray(file.measurement_std), file.dimension)
        records, velocities = [one.record for one in loaded], [one.reference.v for one in loaded if one.reference]
        runs = _Runs(engine)
        try:
            found = tune(loaded[0].model, records, velocities, std=known, before=before, told=begin, runs=runs)
        except ValueError as error:
            raise ValueError(f"{', '.join(str(job.log) for job in jobs)}: {error}") from error
        begin("writing")
        tables = _tables(file, found, loaded[0].rate)
        result = _result(jobs, loaded, found, tables) | {"engine": runs.told}
        if out is not None:
            written = models.rewrite(text, _content(jobs[0], tables))
            head = f"# Tuned by covariant tune to {', '.join(job.log.name for job in jobs)}.\n\n"
            write_atomically(out, lambda file: file.write((head + written).encode()))
            result["out"] = str(out)
        if report is not None:
            result["report"] = _page(report, loaded[-1], found, before, result)
    shown = _text(result) if engine == "auto" else f"{_text(result)}\nengine: {runs.told}"
    print(json.dumps(result) if as_json else shown)


class _Runs:
    """Runs of observers with constant gains; once JAX had to do one it does the others, since its reason stays.

    `told` is the engine, with the reason where it is JAX.
    """

    def __init__(self, engine: Engine):
        self.engine: Engine = engine
        self.told = ""
        self._first: Sequence[AbstractObserver] = ()

    def __call__(self, observers: Sequence[AbstractObserver], records: Sequence[Record]) -> list[Run]:
        self._first = self._first or observers
        many = SEARCHED * sum(len(record.t) for record in records) >= FEWEST_ROWS
        engine = "c" if self.engine == "auto" and many else self.engine
        done, by = run_logs(observers, records, ("innovation",), engine, self._first)
        self.engine, self.told = (self.engine, by) if by == "c" else ("jax", self.told or by)
        return done


def _tables(file: models.ModelFile, found: Tuning, rate: float) -> dict[str, dict[str, Any]]:
    """What is written into the model file, by table and key."""
    time = file.correlation_time or float(f"{1 / (2 * rate):.{DIGITS}g}")
    acceleration = float(found.noise.acceleration) / np.sqrt(2 * time)
    uncertainty = {"acceleration": _short(acceleration), "correlation_time": time}
    if found.noise.force > 0:
        uncertainty["external_force"] = _short(found.noise.force)
    tables: dict[str, dict[str, Any]] = {
        "uncertainty": uncertainty,
        "design": {"damping": _short(found.damping), "natural_frequency": _short(found.natural_frequency)},
    }
    ticks = np.inf if file.quantum is None else np.asarray(file.quantum) / np.sqrt(12)
    if file.quantum is None or np.any(np.asarray(found.noise.measurement) > COARSER * ticks):
        std = [_short(value) for value in np.asarray(found.noise.measurement)]
        tables = {"measurement": {"std": std if file.model.manifold.commuting and len(std) > 1 else std[0]}, **tables}
    return tables


def _short(value: Any) -> float:
    return float(f"{float(value):.{DIGITS}g}")


def _content(job: Job, tables: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The content of the model file with the tuned numbers; a force that was not found is taken out."""
    content = models.document(job.model, job.overrides)
    for table, numbers in tables.items():
        content.setdefault(table, {}).update(numbers)
    if "external_force" not in tables["uncertainty"]:
        content["uncertainty"].pop("external_force", None)
    if "measurement" in tables:
        content["measurement"].pop("quantum", None)
    return content


def _result(jobs: list[Job], loaded: list[Loaded], found: Tuning, tables: dict[str, Any]) -> dict[str, Any]:
    names, units = coordinates(loaded[0].file)
    delay = models.load(jobs[0].model, jobs[0].overrides).delay
    free = found.model_free
    return {
        "model": jobs[0].model,
        "logs": [str(job.log) for job in jobs],
        "rows": found.rows,
        "scored_against": loaded[0].reference.label if loaded[0].reference else None,
        "lines": tables,
        "coordinates": list(names),
        "velocities": list(loaded[0].model.sought.names or (f"d{name}/dt" for name in names)),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out": {
            when: None if judged is None else _judged(judged)
            for when, judged in (("before", found.before), ("after", found.after))
        },
        "model_free": None if free is None else {"estimator": free[0], "relative": rounded(np.array([free[1]]))[0]},
        "warning": warning(found, np.atleast_1d(np.equal(delay, np.max(delay)))),
    }


def _judged(judged: HeldOut) -> dict[str, Any]:
    return {name: (rounded(np.atleast_1d(value))) for name, value in judged._asdict().items()}


def warning(found: Tuning, as_logged: np.ndarray | bool = True) -> str | None:
    """One line where the model is no better than none, or does not explain the innovations.

    - `as_logged` (n,): which positions are as they were read; where they are interpolated neighbours are correlated.
    """
    gains, kalman = found.after.relative
    remedy = "run `covariant fit`"
    name, free = found.model_free or ("", np.inf)
    without = f"{name} knows none and leaves {free:.3g} of the velocity"
    if min(gains, kalman) >= free:
        return f"the model does not help here: {without}, the best with the model {min(gains, kalman):.3g}; {remedy}"
    if gains >= free:
        return (
            f"with constant gains the model does not help here: {without}, constant gains {gains:.3g}; {remedy}, or "
            f"estimate with --observer intrinsic-kalman ({kalman:.3g})"
        )
    if kalman > WORSE * gains:
        return (
            f"the noise is not white: the most likely Kalman filter leaves {kalman:.3g} of the velocity and constant "
            f"gains {gains:.3g}; estimate with --observer intrinsic"
        )
    worst = float(np.max(np.abs(found.after.correlation) * as_logged))
    if worst > NOT_WHITE:
        return f"the innovations are not white (correlation {worst:.2f}), so the model is wrong somewhere; {remedy}"
    return None


def _page(path: Path, loaded: Loaded, found: Tuning, before: DataSheet | None, result: dict[str, Any]) -> list[str]:
    """The page of the constant-gain observer on the last log, before and after."""
    omega = found.natural_frequency
    gains = {"after": (2 * found.damping * omega, omega**2)}
    if before is not None:
        old = observer_gains(before, loaded.rate)
        gains = {"before": (old.alpha, old.beta), **gains}
    observers = with_sensor_delays({when: Intrinsic(loaded.model, *numbers) for when, numbers in gains.items()}, loaded)
    curves = report_curves({when: drive(observer, loaded) for when, observer in observers.items()})
    title = f"Gains of {Path(result['model']).stem} tuned on {', '.join(Path(log).name for log in result['logs'])}"
    notes = tuple(line for line in (result["warning"], *_lines(result)) if line)
    page = estimate_report(title, loaded, curves, notes, tuple(_rows(result)))
    return [str(written) for written in write_report(path, page)]


def _lines(result: dict[str, Any]) -> list[str]:
    """The lines for the model file."""
    lines = []
    for table, numbers in result["lines"].items():
        lines += [f"[{table}]", *(f"{key} = {value}" for key, value in numbers.items())]
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
        rows.append(
            row
            | {
                "log-likelihood": judged["likelihood"][0],
                "NIS": judged["nis"][0],
                "correlation": max(judged["correlation"], key=abs),
            }
        )
    return rows


def _text(result: dict[str, Any]) -> str:
    from covariant.report import table

    lines = [
        f"{result['rows']} rows of the first two thirds of {', '.join(result['logs'])}; errors (RMS) on the rest, of "
        f"velocities against the {result['scored_against']}:",
        "",
        table(tuple(_rows(result))),
    ]
    free = result["model_free"]
    if free is not None:
        gains, kalman = result["held_out"]["after"]["relative"]
        lines.append(
            f"Velocity errors as parts of the velocity: constant gains {gains:.3g}, Kalman filter {kalman:.3g}; "
            f"without a model {free['relative']:.3g} ({free['estimator']})."
        )
    if result["warning"]:
        lines.append(f"Warning: {result['warning']}.")
    wrote = [path for path in [result.get("out"), *result.get("report", [])] if path]
    return "\n".join([*lines, "", *_lines(result), *(["", *(f"wrote {path}" for path in wrote)] if wrote else [])])
