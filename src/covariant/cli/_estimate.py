"""`covariant estimate`: velocities from a log."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs
from covariant.cli._console import working
from covariant.cli._names import Engine
from covariant.design import (
    ESTIMATORS,
    STATE_ESTIMATORS,
    estimators,
    gated,
    observer_gains,
    tuned_estimators,
    with_gains,
)
from covariant.observers import AbstractObserver
from covariant.scoring import rmse
from covariant.signals import Result
from covariant.workflow._inputs import (
    Job,
    Loaded,
    as_read,
    check_output,
    innovation_units,
    load,
    log_sheet,
    numbered,
    sought_columns,
    sought_units,
)
from covariant.workflow._outcome import (
    Outcome,
    deviations,
    drive,
    known,
    report_arrays,
    rounded,
    summary,
    worth_telling,
)
from covariant.workflow._pages import write_report
from covariant.workflow._states import said_of_states, tuned_states


def estimate(
    job: Job,
    out: Path | None,
    observer: str | None,
    alpha: float | None,
    beta: float | None,
    score: bool,
    report: Path | None,
    engine: Engine,
    as_json: bool,
) -> None:
    """Run one observer on a log, by default the first that fits the model, and write, print and draw its estimates.

    Its velocities are scored where `score` asks for it, and where the log has true ones.
    """
    _check(observer, alpha, beta)
    check_output(out, *logs.WRITTEN, log=job.log)
    check_output(report, ".html")
    with working("reading", quiet=as_json):
        loaded = load(job, score)
    observer = observer or estimators(loaded.model)[0]
    chosen, notes = _choose(job, loaded, observer, alpha, beta)
    with working(f"estimating with {observer}", quiet=as_json):
        outcome = drive(chosen, loaded, engine)
    result = _result(job, loaded, observer, outcome, notes)
    if outcome.failed:
        raise ValueError(f"{job.log}: the estimate left the finite numbers; lower the gains or check model and units")
    if report is not None:
        curves, said = report_arrays({observer: outcome}), (*notes, *_found(result, loaded))
        title = _title(job, loaded.model.sought.what)
        result["report"] = [str(p) for p in write_report(report, title, loaded, curves, said)]
    if out is not None:
        logs.write(out, columns(loaded, outcome, out), loaded.log.origin_ns)
        result["out"] = str(out)
    print(json.dumps(result) if as_json else _text(result, loaded, engine))


def _check(observer: str | None, alpha: float | None, beta: float | None) -> None:
    known_ones = (*ESTIMATORS, *STATE_ESTIMATORS)
    if observer is not None and observer not in known_ones:
        raise ValueError(f"unknown observer {observer!r}; choose one of {', '.join(known_ones)}")
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
            raise ValueError(f"--alpha and --beta do not apply to {observer}; they do to {', '.join(made) or 'none'}")
        given = f"Given gains: alpha = {alpha:g} 1/s, beta = {beta:g} 1/s²."
        if loaded.file.measurement_std is None or loaded.file.acceleration_std is None:
            return as_read(made, loaded)[observer], (
                f"{given} No measurement is refused: the model file tells no noise.",
            )
        behind = {observer: gated(made[observer], model, log_sheet(loaded))}
        return as_read(behind, loaded)[observer], (given,)
    if not loaded.file.mechanical:
        return as_read(tuned_states(loaded, (observer,)), loaded)[observer], (
            said_of_states(loaded.file) + loaded.note,
        )
    sheet = log_sheet(loaded)
    designed = observer_gains(sheet, loaded.rate).summary
    made = tuned_estimators(model, loaded.file.dimension, sheet, loaded.rate, names=(observer,))
    unused = ""
    asked = [
        what
        for what, given in (
            ("the external force of [uncertainty]", sheet.external_force),
            ("the bias of [measurement]", loaded.file.bias),
            ("the parameters of [uncertainty]", loaded.file.family),
        )
        if given is not None
    ]
    if asked and not getattr(made[observer], "slow_names", ()):
        unused = f" It does not estimate {' and '.join(asked)}; intrinsic-kalman does."
    return as_read(made, loaded)[observer], (f"Designed {designed}.{loaded.note}{unused}",)


def columns(loaded: Loaded, outcome: Outcome, out: Path) -> dict[str, np.ndarray]:
    """The columns of an output file: t, q1…, v1…; on a group t, the configuration as in the log, and the velocities.

    In messages of ROS coordinates are joints by their names in the log: shoulder/position, shoulder/velocity….

    A filter that knows how accurate it is adds the standard deviations of the velocities, v1_std…. One that estimates
    more than the motion adds what it estimates, as external_force1… and external_force1_std….
    """
    file, x = loaded.file, outcome.run.estimate
    joints = {}
    if file.mechanical and file.model.manifold.commuting and out.suffix in logs.MESSAGES:
        named = [name.removesuffix("/position") for name in file.columns.q]
        joints = {field: tuple(f"{name}/{field}" for name in named) for field in ("position", "velocity")}
    if not file.mechanical:
        configuration = {}
    elif not file.model.manifold.commuting:
        configuration = logs.to_columns(file.columns, np.asarray(x.q))
    else:
        q = np.split(np.asarray(x), 2, axis=1)[0]
        configuration = dict(zip(joints.get("position") or numbered("q", file.dimension), q.T, strict=True))
    found = {"t": np.asarray(outcome.run.t)} | configuration
    for names, values, std in (
        (joints.get("velocity") or sought_columns(file), outcome.velocity, deviations(outcome.run.info)),
        (outcome.slow_names, *(known(outcome.run.info, name) for name in ("slow", "slow_std"))),
    ):
        for suffix, each in (("", values), ("_std", std)):
            if each is not None and each.size:
                found |= {f"{name}{suffix}": column for name, column in zip(names, each.T, strict=True)}
    return found


def _result(job: Job, loaded: Loaded, observer: str, outcome: Outcome, notes: tuple[str, ...]) -> dict[str, Any]:
    reference, logged = loaded.reference, loaded.log.v
    result = {
        "model": job.model,
        "log": str(job.log),
        "observer": observer,
        "rows": len(outcome.run.t),
        **({} if loaded.origin is None else {"t_counts_from": loaded.origin}),
        "engine": outcome.engine,
        **({} if reference is None else {"scored_against": reference.label}),
        "design": notes[0],
        **summary(outcome, loaded.model.sought.what),
    }
    if reference is not None and logged is not None:
        both = reference.scored & np.isfinite(logged).all(1)
        result["difference_to_logged_velocity"] = rounded(rmse(outcome.velocity[both], logged[both]))
        result["logged_velocity_rmse"] = rounded(rmse(logged[both], reference.v[both]))
    return result


def _text(result: dict[str, Any], loaded: Loaded, engine: Engine) -> str:
    lines = [
        f"{result['log']}: {result['rows']} rows, {result['observer']} observer",
        *([f"t counts from {result['t_counts_from']}"] if "t_counts_from" in result else []),
        result["design"],
        *_found(result, loaded),
    ]
    if "logged_velocity_rmse" in result:
        speeds = _with_units(result["logged_velocity_rmse"], sought_units(loaded.file))
        lines.append(f"the same for the velocity in the log: {speeds}")
    if worth_telling(result["engine"], engine):
        lines.append(f"engine: {result['engine']}")
    for name, count in result["results"].items():
        if name != "ok":
            lines.append(f"{count} of {result['rows']} samples: {Result[name.upper()].message}")
    lines += [f"wrote {path}" for path in [result.get("out"), *result.get("report", [])] if path]
    return "\n".join(lines)


def _found(result: dict[str, Any], loaded: Loaded) -> list[str]:
    """Sentences on the errors, and on the innovations, which need no reference."""
    lines = []
    what = loaded.model.sought.what
    if f"{what}_rmse" in result:
        errors = _with_units(result[f"{what}_rmse"], sought_units(loaded.file))
        lines.append(f"{what} RMSE against the {result['scored_against']}: {errors}")
    lines.append(f"innovation RMS: {_with_units(result['innovation_rms'], innovation_units(loaded.file))}")
    told = [f"{name.upper()} {result[name]:.3g}" for name in ("nis", "nees") if result.get(name) is not None]
    if told:
        lines.append(f"{' and '.join(told)} a number; 1 is expected where model and noise are as told")
    return lines


def _with_units(values: list[float | None], units: tuple[str, ...]) -> str:
    written = ("—" if v is None else f"{v:.4g} {unit}".rstrip() for v, unit in zip(values, units, strict=True))
    return ", ".join(written)


def _title(job: Job, what: str) -> str:
    return f"{'States' if what == 'state' else 'Velocities'} of {Path(job.model).stem} from {job.log.name}"
