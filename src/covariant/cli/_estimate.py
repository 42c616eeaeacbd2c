"""`covariant estimate`: a log in, velocities out."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs
from covariant.cli._console import note, working
from covariant.cli._job import Job, Loaded, check_output, data_sheet, load
from covariant.cli._pages import write_report
from covariant.cli._results import Outcome, drive, report_arrays, rounded, summary
from covariant.design import line_up, observer_gains
from covariant.models import Lagrangian
from covariant.observers import AbstractObserver, Copy, Geodesic, Intrinsic
from covariant.scoring import rmse

BY_GAINS: dict[str, Callable[..., AbstractObserver]] = {
    "intrinsic": Intrinsic,
    "intrinsic2": lambda model, alpha, beta: Intrinsic(model, alpha, beta, order=2),
    "geodesic": Geodesic,
    "copy": Copy,
}
OBSERVERS = (*BY_GAINS, "ekf", "filtered-derivative", "savitzky-golay")


def estimate(
    job: Job,
    out: Path | None,
    observer: str,
    alpha: float | None,
    beta: float | None,
    report: Path | None,
    as_json: bool,
) -> None:
    """Run one observer on a log and write, print and draw what it found."""
    _check(observer, alpha, beta)
    check_output(out, ".csv", ".parquet", log=job.log)
    check_output(report, ".html")
    with working("reading", quiet=as_json):
        loaded = load(job)
    chosen, notes = _choose(loaded, observer, alpha, beta)
    with working(f"estimating with {observer}", quiet=as_json):
        outcome = drive(chosen, loaded)
    result = _result(job, loaded, observer, outcome, notes)
    if outcome.failed:
        raise ValueError(f"{job.log}: the estimate left the finite numbers; lower the gains or check model and units")
    if out is not None:
        logs.write(out, columns(outcome))
        result["out"] = str(out)
    if report is not None:
        result["report"] = [
            str(p)
            for p in write_report(report, _title(job), loaded, _curves(observer, outcome), (*notes, _error(result)))
        ]
    print(json.dumps(result) if as_json else _text(result))


def _check(observer: str, alpha: float | None, beta: float | None) -> None:
    if observer not in OBSERVERS:
        raise ValueError(f"unknown observer {observer!r}; choose one of {', '.join(OBSERVERS)}")
    if (alpha is None) != (beta is None):
        raise ValueError("--alpha and --beta belong together: give both or neither")
    if alpha is not None and beta is not None:
        if observer not in BY_GAINS:
            raise ValueError(f"--alpha and --beta do not apply to {observer}")
        if not (0 < alpha < math.inf and 0 < beta < math.inf):
            raise ValueError(f"--alpha and --beta must be positive numbers; got {alpha} and {beta}")


def _choose(
    loaded: Loaded, observer: str, alpha: float | None, beta: float | None
) -> tuple[AbstractObserver, tuple[str, ...]]:
    model: Lagrangian = loaded.file.model
    if alpha is not None:
        return BY_GAINS[observer](model, alpha, beta), (f"Given gains: alpha = {alpha:g} 1/s, beta = {beta:g} 1/s².",)
    sheet = data_sheet(loaded.file)
    designed = observer_gains(sheet, loaded.rate).summary
    return line_up(model, len(loaded.file.columns.q), sheet, loaded.rate)[observer], (f"Designed {designed}.",)


def columns(outcome: Outcome) -> dict[str, np.ndarray]:
    """The columns of an output file: t, q1…, v1…."""
    q, v = np.split(np.asarray(outcome.run.estimate), 2, axis=1)
    named = {f"q{i + 1}": column for i, column in enumerate(q.T)}
    return {"t": np.asarray(outcome.run.t)} | named | {f"v{i + 1}": column for i, column in enumerate(v.T)}


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
        v = np.split(np.asarray(outcome.run.estimate), 2, axis=1)[1]
        both = loaded.scored & np.isfinite(loaded.log.v).all(1)
        result["difference_to_logged_velocity"] = rounded(rmse(v[both], loaded.log.v[both]))
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
