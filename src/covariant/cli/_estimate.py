"""`covariant estimate`: velocities from a log."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs
from covariant.cli._console import note, working
from covariant.cli._job import Job, Loaded, check_output, data_sheet, load, numbered, velocity_columns
from covariant.cli._pages import write_report
from covariant.cli._results import Outcome, drive, report_arrays, rounded, summary
from covariant.design import ESTIMATORS, estimators, gated, observer_gains, tuned_estimators, with_gains
from covariant.observers import AbstractObserver
from covariant.scoring import rmse


def estimate(
    job: Job,
    out: Path | None,
    observer: str | None,
    alpha: float | None,
    beta: float | None,
    report: Path | None,
    as_json: bool,
) -> None:
    """Run one observer on a log, by default the first that fits the model, and write, print and draw its estimates."""
    _check(observer, alpha, beta)
    check_output(out, ".csv", ".parquet", log=job.log)
    check_output(report, ".html")
    with working("reading", quiet=as_json):
        loaded = load(job)
    observer = observer or estimators(loaded.model)[0]
    chosen, notes = _choose(job, loaded, observer, alpha, beta)
    with working(f"estimating with {observer}", quiet=as_json):
        outcome = drive(chosen, loaded)
    result = _result(job, loaded, observer, outcome, notes)
    if outcome.failed:
        raise ValueError(f"{job.log}: the estimate left the finite numbers; lower the gains or check model and units")
    if out is not None:
        logs.write(out, columns(loaded, outcome))
        result["out"] = str(out)
    if report is not None:
        result["report"] = [
            str(p)
            for p in write_report(report, _title(job), loaded, _curves(observer, outcome), (*notes, _error(result)))
        ]
    print(json.dumps(result) if as_json else _text(result))


def _check(observer: str | None, alpha: float | None, beta: float | None) -> None:
    if observer is not None and observer not in ESTIMATORS:
        raise ValueError(f"unknown observer {observer!r}; choose one of {', '.join(ESTIMATORS)}")
    if (alpha is None) != (beta is None):
        raise ValueError("--alpha and --beta belong together: give both or neither")
    if alpha is not None and beta is not None and not (0 < alpha < math.inf and 0 < beta < math.inf):
        raise ValueError(f"--alpha and --beta must be positive numbers; got {alpha} and {beta}")


def _choose(
    job: Job, loaded: Loaded, observer: str, alpha: float | None, beta: float | None
) -> tuple[AbstractObserver, tuple[str, ...]]:
    model = loaded.model
    if observer not in estimators(model):
        raise ValueError(f"--observer {observer} does not fit {job.model}; these do: {', '.join(estimators(model))}")
    if alpha is not None and beta is not None:
        made = with_gains(model, alpha, beta)
        if observer not in made:
            raise ValueError(f"--alpha and --beta do not apply to {observer}; they do to {', '.join(made)}")
        given = f"Given gains: alpha = {alpha:g} 1/s, beta = {beta:g} 1/s²."
        if loaded.file.measurement_std is None or loaded.file.acceleration_std is None:
            return made[observer], (f"{given} No measurement is refused: the model file tells no noise.",)
        return gated(made[observer], model, data_sheet(loaded.file)), (given,)
    sheet = data_sheet(loaded.file)
    designed = observer_gains(sheet, loaded.rate).summary
    made = tuned_estimators(model, loaded.file.dimension, sheet, loaded.rate, names=(observer,))
    return made[observer], (f"Designed {designed}.{loaded.note}",)


def columns(loaded: Loaded, outcome: Outcome) -> dict[str, np.ndarray]:
    """The columns of an output file: t, q1…, v1…; on a group t, the configuration as in the log, and the velocities.

    A filter that knows how accurate it is adds the standard deviations of the velocities, v1_std….
    """
    file, x = loaded.file, outcome.run.estimate
    if not file.model.manifold.commuting:
        configuration = logs.to_columns(file.columns, np.asarray(x.q))
    else:
        q = np.split(np.asarray(x), 2, axis=1)[0]
        configuration = dict(zip(numbered("q", file.dimension), q.T, strict=True))
    velocities = dict(zip(velocity_columns(file), outcome.velocity.T, strict=True))
    std = getattr(outcome.run.info, "velocity_std", None)
    if std is not None:
        velocities |= {f"{name}_std": column for name, column in zip(velocities, np.asarray(std).T, strict=True)}
    return {"t": np.asarray(outcome.run.t)} | configuration | velocities


def _result(job: Job, loaded: Loaded, observer: str, outcome: Outcome, notes: tuple[str, ...]) -> dict[str, Any]:
    result = {
        "model": job.model,
        "log": str(job.log),
        "observer": observer,
        "rows": len(outcome.run.t),
        "scored_against": loaded.reference_label,
        "design": notes[0],
        **summary(outcome),
    }
    if loaded.log.v is not None:
        both = loaded.scored & np.isfinite(loaded.log.v).all(1)
        result["difference_to_logged_velocity"] = rounded(rmse(outcome.velocity[both], loaded.log.v[both]))
        result["logged_velocity_rmse"] = rounded(rmse(loaded.log.v[both], loaded.reference[both]))
    return result


def _text(result: dict[str, Any]) -> str:
    lines = [
        f"{result['log']}: {result['rows']} rows, {result['observer']} observer",
        result["design"],
        _error(result),
    ]
    if "logged_velocity_rmse" in result:
        lines.append(f"the same for the velocity in the log: {_numbers(result['logged_velocity_rmse'])}")
    for name, count in result["results"].items():
        if name != "ok":
            lines.append(f"{count} of {result['rows']} samples: {note(name)}")
    lines += [f"wrote {path}" for path in [result.get("out"), *result.get("report", [])] if path]
    return "\n".join(lines)


def _error(result: dict[str, Any]) -> str:
    return f"velocity RMSE against the {result['scored_against']}: {_numbers(result['velocity_rmse'])}"


def _numbers(values: list[float | None]) -> str:
    return ", ".join("—" if v is None else f"{v:.4g}" for v in values)


def _title(job: Job) -> str:
    return f"Velocities of {Path(job.model).stem} from {job.log.name}"


def _curves(observer: str, outcome: Outcome) -> dict[str, Any]:
    return report_arrays({observer: outcome})
