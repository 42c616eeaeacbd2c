"""Computes a fit to logs: reads them, solves with held and with linear inputs, and judges on what is held out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from covariant.calibration import Fit, PredictionErrors, RobotFit
from covariant.calibration.identification import error_growth, predicts_worse, worse_coordinates
from covariant.verbs.base.fit_logs import NAMED, FitLogs, OwnNumbers
from covariant.verbs.base.fit_problems import Part, kind_of
from covariant.verbs.base.fit_sentences import input_details, number_rows
from covariant.verbs.base.inputs import Job, coordinates
from covariant.verbs.base.model_output import check_read_once
from covariant.verbs.base.outcome import rounded
from covariant.verbs.base.placeholders import placeholders
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

DIGITS = 7
"""Significant digits of fitted numbers in a model file."""


def fit_to_logs(
    jobs: list[Job],
    names: Sequence[str],
    progress: Progress,
    sources: Mapping[Path, bytes],
    own: OwnNumbers | None = None,
    judges: int = 0,
) -> tuple[list[Job], dict[str, dict[str, Any]], dict[str, Any]]:
    """Fit parameters of a model, or numbers of a robot, to logs, and judge the fit on what is held out.

    `sources` are the files of the model as they were first read, `judges` the number of the last logs to judge by, if
    that is known. The contents of model files are by the machine whose own numbers they have, or by "".
    """
    progress("reading")
    kind = kind_of(jobs[0], names)
    problem = kind.read(jobs, names, own)
    problem = replace(problem, logs=problem.logs._replace(judges=judges))
    logs, guessed = problem.logs, placeholders(jobs[0].model, jobs[0].overrides)
    check_read_once(sources)  # from here on no file of the model is read
    try:
        parts = {word: Part.of(problem, word) for word in logs.tried}
        fits = _solve(problem, parts, progress)
    except InputError as error:
        named = ", ".join(logs.names) if len(logs.names) <= NAMED else f"{len(logs.names)} logs"
        raise InputError(f"{named}: {error}") from error
    gain = problem.gain(fits) if len(fits) > 1 else None
    used = "linear" if gain is not None and gain.clear and gain.of_linear > 0 else logs.tried[0]
    best, part = problem.refined(fits[used], parts[used], progress), parts[used]
    progress("errors on what is held out", 1.0)
    # Before the fit no way between stamps was chosen: the first is the one that the model file would use.
    before = problem.errors(None, parts[logs.tried[0]])
    after = problem.errors(best, part)
    progress("other readings of the log", 1.0)
    suspicion = problem.suspicion(best, part)
    if isinstance(best, RobotFit) and not suspicion:
        best, after = _by_joint(problem, best, part, before, after)
    better = not predicts_worse(before, after) and not suspicion
    progress("all rows" if better else "what the logs do not tell", 1.0)
    found: Any = problem.ended(best, part if better else None)
    values = np.array([float(f"{value:.{DIGITS}g}") for value in problem.lasting(found.values)])[problem.family.parts]
    contents = {
        machine: problem.family.with_values(part) for machine, part in zip(problem.machines, values, strict=True)
    }
    for content in contents.values():
        source = content.get("parameters", {}).get("source")
        if isinstance(source, str):  # a text that says where the numbers are from says where they are from now
            content["parameters"]["source"] = f"fitted to {logs.fitted_to} from first values of: {source}"
        if gain is not None and gain.clear:
            content.setdefault("inputs", {})["between"] = used
    details = _details(jobs[0], logs, guessed, found, before, after, suspicion)
    details |= {"inputs": input_details(used, logs.stated, gain), "better": better, **problem.details(found)}
    if (origin := logs.logs[0].loaded.origin) is not None:
        details["t_counts_from"] = origin
    # A log that is misread says nothing of what it determines.
    return jobs, contents, details | ({"undetermined": [], "unlike": []} if suspicion else {})


def _by_joint(
    problem: Any, best: RobotFit, part: Part, before: PredictionErrors, after: PredictionErrors
) -> tuple[RobotFit, PredictionErrors]:
    """The fit and its errors; with first values for the joints that it predicts worse, where that is better."""
    parted = best.without(problem.family, worse_coordinates(before, after))
    if parted is None:
        return best, after
    errors = problem.errors(parted, part)
    return (best, after) if predicts_worse(before, errors) else (parted, errors)


def _solve(problem: Any, parts: dict[str, Part], progress: Progress) -> dict[str, Any]:
    """The fit for each way of inputs between stamps, each search from where the one before ended."""
    tried = problem.logs.tried
    fits: dict[str, Any] = {}
    start: Any = None
    for k, word in enumerate(tried):

        def report(done: int, fraction: float, k: int = k, word: str = word) -> None:
            which = f" with {word} inputs" if len(tried) > 1 else ""
            progress(f"round {done + 1}{which}", (k + min(fraction, 1.0)) / len(tried))

        start = fits[word] = problem.fit(word, parts[word], start, report)
    return fits


def _details(
    job: Job,
    logs: FitLogs,
    guessed: dict[str, float],
    best: Fit | RobotFit,
    before: PredictionErrors,
    after: PredictionErrors,
    suspicion: str,
) -> dict[str, Any]:
    """Numbers before and after a fit, those that are still placeholders, and its errors on what is held out."""
    file = logs.logs[0].loaded.file
    names, units = coordinates(file) if file.mechanical else (file.columns.q, logs.logs[-1].loaded.kind.measured.units)
    reference = logs.logs[-1].loaded.reference
    ratio = error_growth(before, after)
    # The number of a machine, viscous@arm1, is no longer the placeholder of the file if one machine shows it.
    known = {
        name.partition("@")[0]
        for name, first, value, _, determined in number_rows(best)
        if determined or value != first
    }
    return {
        "model": job.model_name,
        "logs": logs.names,
        "fitted_to": logs.fitted_to,
        "held_out": logs.held_out,
        "horizon": float(f"{logs.length:.4g}"),
        "scored_against": reference.label if reference else None,
        "parameters": [
            {
                "name": name,
                "before": float(first),
                "after": float(f"{value:.{DIGITS}g}"),
                "standard_error": float(f"{error:.3g}") if np.isfinite(error) else None,
                "determined": bool(determined) and not suspicion,
            }
            for name, first, value, error, determined in number_rows(best)
        ],
        "placeholders": {k: value for k, value in guessed.items() if k not in known},
        "coordinates": list(names),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out_errors": {
            when: {"position": rounded(errors.position), "velocity": rounded(errors.velocity)}
            for when, errors in (("before", before), ("after", after))
        },
        "growth": float(f"{ratio:.4g}") if np.isfinite(ratio) else None,
        "suspicion": suspicion,
    }
