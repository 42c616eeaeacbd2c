"""`covariant fit`: the numbers of a model file that predict a log best, written into a new model file."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from covariant import models, scoring
from covariant._files import write_atomically
from covariant.cli._console import stages
from covariant.identification import (
    FITTED,
    Fit,
    PredictionErrors,
    fit,
    growth,
    horizon,
    prediction_errors,
    relations,
    split,
)
from covariant.signals import acting_inputs, lag_inputs, read_together
from covariant.workflow._inputs import Job, Loaded, ReferenceVelocity, check_output, coordinates, load
from covariant.workflow._outcome import rounded

WORST_GROWTH = 1.01
"""A model whose held-out error is larger than so many times the one before is not written: 1 % is no difference."""
DIGITS = 7
"""Significant digits of fitted numbers in a model file."""


def fit_model(
    jobs: list[Job],
    parameters: str,
    out: Path | None,
    overwrite: bool,
    length: float | None,
    as_json: bool,
) -> None:
    """Fit, judge on what is held out, write and print; exits with code 1 where the fitted model is worse."""
    spec, overrides = jobs[0].model, jobs[0].overrides
    text = check_out(spec, out, overwrite)
    if length is not None and not 0 < length < np.inf:
        raise ValueError(f"--horizon must be a positive number of seconds; got {length}")
    family = models.family(spec, parameters.split(","), overrides)
    with stages("fitting", 5, quiet=as_json) as begin:
        begin("reading")
        loaded = [when_true(job) for job in jobs]
        records, references = [one.log.record for one in loaded], [one.reference.v for one in loaded if one.reference]
        part = 1 - FITTED if len(jobs) == 1 else 1.0
        length = horizon(records[0], references[0], part) if length is None else length
        try:
            training, held_out = split(records, references, length)
        except ValueError as error:
            raise ValueError(f"{', '.join(str(job.log) for job in jobs)}: {error}") from error
        found = fit(family, training, lambda k, step: begin(f"round {k + 1}") if step == 0 else None)
        begin("held-out errors")
        before, after = (prediction_errors(*family.make(values), held_out) for values in (found.first, found.values))
    result = _result(jobs, loaded, found, length, len(training.t), before, after)
    if out is not None and result["better"]:
        written = models.rewrite(text, _document(family, found, jobs))
        head = _head(jobs, found)
        write_atomically(out, lambda file: file.write((head + written).encode()))
        result["out"] = str(out)
    print(json.dumps(result) if as_json else _text(result))
    if not result["better"]:
        raise SystemExit(1)


def when_true(job: Job) -> Loaded:
    """Model and log, its rows at the times at which the positions were true, and its inputs as they act between these.

    The inputs of its `log` are without their lag, those of its `record` with it. Where one coordinate is later than
    another they are interpolated to the times of the latest.
    """
    file = models.load(job.model, job.overrides)
    delay = np.asarray(file.delay, float)
    loaded = load(job._replace(overrides=(*job.overrides, "measurement.delay=0")), why="this command takes")
    if np.ptp(delay) > 0:
        loaded = _together(loaded, delay)
    between, late = file.input_between, file.input_delay + float(delay.max())
    raw, lagging = loaded.log.record, lag_inputs(loaded.log.record, file.input_lag)
    log = loaded.log._replace(record=acting_inputs(raw, between, late))
    return loaded._replace(log=log, record=acting_inputs(lagging, between, late))


def _together(loaded: Loaded, delay: np.ndarray) -> Loaded:
    """The log with all positions as they were at one time, and reference velocities at these times."""
    file, log = loaded.file, loaded.log
    y = scoring.unwrap(np.asarray(log.record.y), loaded.model.circles)
    record = read_together(log.record._replace(y=y), np.broadcast_to(delay, y.shape[1]))
    t = np.asarray(record.t)
    slopes = scoring.zero_phase_velocity(t, np.asarray(record.y), t, file.reference_half, int(file.reference_order))
    reference = ReferenceVelocity(slopes, "zero-phase reference", scoring.scored_window(t))
    return loaded._replace(log=log._replace(record=record, v=None, truth=None), reference=reference)


def check_out(spec: str, out: Path | None, overwrite: bool) -> str:
    """The text of the model file that is to be changed; raises `ValueError` for a file that may not be written."""
    path = Path(spec)
    if out is None:
        return ""
    check_output(out, ".toml")
    if path.suffix == ".toml":
        if out.exists() and path.exists() and out.samefile(path) and not overwrite:
            raise ValueError(f"{out}: this is the model file itself; write to another file, or say --overwrite")
        if out.exists() and not overwrite:
            raise ValueError(f"{out}: there is such a file already; write to another file, or say --overwrite")
        return path.read_text(encoding="utf-8")
    if ":" in spec:
        raise ValueError(f"--out: {spec} is code, which is not rewritten; leave --out away and put the numbers there")
    return f'system = "{spec}"\n'


def _document(family: models.Family, found: Fit, jobs: list[Job]) -> dict[str, Any]:
    """The content of the new file; a text that says where the numbers are from says where they are from now."""
    content = family.with_values(np.array([float(f"{value:.{DIGITS}g}") for value in found.values]))
    source = content.get("parameters", {}).get("source")
    if isinstance(source, str):
        content["parameters"]["source"] = f"fitted to {_seen(jobs)} from first values of: {source}"
    return content


def _seen(jobs: list[Job]) -> str:
    """The logs that the fit has seen."""
    return jobs[0].log.name if len(jobs) == 1 else ", ".join(job.log.name for job in jobs[:-1])


def _head(jobs: list[Job], found: Fit) -> str:
    """Comment lines that say what has been fitted, how well it is known, and what is still a first value."""
    known = zip(found.names, found.values, found.standard_errors, strict=True)
    lines = [f"# Fitted by covariant fit to {_seen(jobs)}; ± is one standard error:"]
    lines += [
        f"#   {name} = {value:.5g}" + (f" ± {error:.2g}" if error == error else "") for name, value, error in known
    ]
    return "\n".join([*lines, *(f"#   {sentence}." for sentence in relations(found)), "", ""])


def _result(
    jobs: list[Job],
    loaded: list[Loaded],
    found: Fit,
    length: float,
    count: int,
    before: PredictionErrors,
    after: PredictionErrors,
) -> dict[str, Any]:
    names, units = coordinates(loaded[0].file)
    numbers = zip(found.names, found.first, found.values, found.standard_errors, found.determined, strict=True)
    ratio = growth(before, after)
    return {
        "model": jobs[0].model,
        "logs": [str(job.log) for job in jobs],
        "held_out": str(jobs[-1].log) if len(jobs) > 1 else f"the last third of {jobs[0].log}",
        "horizon": float(f"{length:.4g}"),
        "windows": count,
        "scored_against": loaded[-1].reference.label if loaded[-1].reference else None,
        "parameters": [
            {
                "name": name,
                "before": float(first),
                "after": float(f"{value:.{DIGITS}g}"),
                "standard_error": float(f"{error:.3g}") if np.isfinite(error) else None,
                "determined": bool(determined),
            }
            for name, first, value, error, determined in numbers
        ],
        "undetermined": list(relations(found)),
        "coordinates": list(names),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out_errors": {
            when: {kind: rounded(np.asarray(values)) for kind, values in errors._asdict().items()}
            for when, errors in (("before", before), ("after", after))
        },
        "growth": float(f"{ratio:.4g}") if np.isfinite(ratio) else None,
        "better": bool(ratio <= WORST_GROWTH),
    }


def _text(result: dict[str, Any]) -> str:
    from covariant.report import table

    numbers = [
        {
            "parameter": row["name"],
            "before": f"{row['before']:.5g}",
            "after": f"{row['after']:.5g}",
            "± standard error": "—" if row["standard_error"] is None else f"{row['standard_error']:.2g}",
            "determined": row["determined"],
        }
        for row in result["parameters"]
    ]
    errors = [
        {
            "coordinate": f"{name} [{unit}]" if unit else name,
            **{
                f"{kind.replace('_', ' ')}, {when}": result["held_out_errors"][when][kind][i]
                for kind in ("one_step", "position", "velocity")
                for when in ("before", "after")
            },
        }
        for i, (name, unit) in enumerate(zip(result["coordinates"], result["units"], strict=True))
    ]
    lines = [
        f"{result['windows']} windows of {result['horizon']:.3g} s of {', '.join(result['logs'])}",
        "",
        table(numbers),
        *(f"Not determined: {sentence}." for sentence in result["undetermined"]),
        f"Errors (RMS) of predictions over {result['horizon']:.3g} s of {result['held_out']}, velocities against the "
        f"{result['scored_against']} [unit/s]:",
        "",
        table(errors),
    ]
    if not result["better"]:
        lines.append("The fitted model is worse on what it has not seen, so it is not written: look for columns, units")
        lines.append("or signs that are wrong, or give longer logs, other first values, or fewer parameters.")
    elif result.get("out"):
        lines.append(f"wrote {result['out']}")
    return "\n".join(lines)
