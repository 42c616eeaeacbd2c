"""Computes a fit of a robot's numbers to logs, by residual torques, and judges it on what is held out."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from covariant import models
from covariant.calibration import (
    FITTED,
    PredictionErrors,
    RobotFit,
    Windows,
    fit_robot,
    prediction_errors,
    robot_misfit,
    split,
)
from covariant.signals import Record, acting_inputs, lag_inputs
from covariant.workflow._aligned import Aligned
from covariant.workflow._fit_details import DIGITS, Gain, better_way, fit_details, input_details
from covariant.workflow._fit_logs import FitLogs
from covariant.workflow._inputs import Job, MisfitError
from covariant.workflow._progress import Progress

EXPECTED = 12
"""Usual number of rounds, for the progress."""
MIRRORED = (
    "on which side of its link the load is: with the offsets of joints open too, a mirrored load with other offsets "
    "may explain these logs as well, and the solution nearest to the first values is given"
)


def is_robot_fit(job: Job, names: Sequence[str]) -> bool:
    """Whether numbers are those of a robot's joints and links, and not plain entries of [parameters]."""
    try:
        system = models.document(job.model_name, job.overrides).get("system")
    except ValueError:  # whoever makes the family says what is wrong, with the name of the file
        return False
    if system != "robot":
        return False
    return not names or any("[" not in name and not name.strip().startswith("inputs.") for name in names)


def fit_robot_to_logs(
    jobs: list[Job], names: Sequence[str], length: float | None, progress: Progress
) -> tuple[list[Job], dict[str, Any], dict[str, Any]]:
    """Fit numbers of a robot to logs, and judge the fit on what is held out.

    Args:
        jobs: The model and the logs, the same model in each.
        names: Names of the numbers, as for `models.robot_family`.
        length: Length of the predictions of what is held out [s]; None chooses it by the motion.
        progress: Called with a description and a fraction as the work goes on.

    Returns:
        The fields of a `FitResult`, in their order.

    Raises:
        MisfitError: Where nothing moves in a log, or it is in other units.
        ValueError: For a model or a log that cannot be used.
    """
    progress("reading")
    family = models.robot_family(jobs[0].model_name, names, jobs[0].overrides)
    # A robot without its friction may explain little of a log, as the fit is for that; so it has a check of its own.
    logs = FitLogs.read([job._replace(anyway=True) for job in jobs], length)
    if not jobs[0].anyway:
        _refuse_misfit(family, logs)
    tried, half = logs.tried, logs.file.reference_half
    records = {word: [_acting(log, word) for log in logs.logs] for word in tried}
    fits: dict[str, RobotFit] = {}
    start = None
    try:
        held_out = {word: split(records[word], logs.references, logs.length)[1] for word in tried}
        for k, word in enumerate(tried):
            report = _reporter(progress, k, len(tried), word if len(tried) > 1 else "")
            start = fits[word] = fit_robot(family, _fitted(records[word][: logs.seen]), half, report, start)
    except ValueError as error:
        raise ValueError(f"{logs.title}: {error}") from error
    progress("errors on what is held out", 1.0)
    gain = Gain.of(fits["held"].losses - fits["linear"].losses) if len(fits) > 1 else None
    used = better_way(gain, tried)
    best = fits[used]
    before, after = _errors(family, best, held_out[logs.tried[0]], held_out[used])
    content = family.with_values(np.array([float(f"{value:.{DIGITS}g}") for value in best.values]))
    if gain is not None and gain.clear:
        content.setdefault("inputs", {})["between"] = used
    details = fit_details(jobs[0], logs, best, before, after)
    return jobs, content, details | input_details(used, logs.stated, gain) | _of_robot(best)


def _refuse_misfit(family: models.RobotFamily, logs: FitLogs) -> None:
    """Raise `MisfitError` where nothing moves in a log, or another unit of the log explains its torques."""
    for name, log in zip(logs.names, logs.logs, strict=True):
        finding = robot_misfit(family, log.loaded.file, log.raw)
        if finding is not None:
            raise MisfitError(f"{name}: {finding.evidence}. {finding.line}; `anyway=True` goes on")


def _acting(log: Aligned, between: str) -> Record:
    """The record with the inputs that act in each step."""
    return acting_inputs(lag_inputs(log.raw, log.loaded.file.input_lag), between, log.late)


def _fitted(records: Sequence[Record]) -> list[Record]:
    """What a fit sees of the logs that are not held out: of a single one its first part."""
    if len(records) > 1:
        return list(records)
    t, u, y = (np.asarray(column) for column in (records[0].t, records[0].u, records[0].y))
    seen = t < t[0] + FITTED * (t[-1] - t[0])
    return [Record(t[seen], u[seen], y[seen])]


def _reporter(progress: Progress, k: int, count: int, word: str) -> Callable[[int], None]:
    def report(done: int) -> None:
        which = f" with {word} inputs" if word else ""
        progress(f"round {done + 1}{which}", (k + min(done / EXPECTED, 1.0)) / count)

    return report


def _errors(
    family: models.RobotFamily, best: RobotFit, first: Windows, after: Windows
) -> tuple[PredictionErrors, PredictionErrors]:
    """Errors of predictions of what is held out by the model as it was, and by the fitted one."""
    # At the first values the family has the program of the fitted model; but a load that it adds was not there.
    added = any(n.group == "payload" for n in family.numbers)
    before: Any = family.file.model if added else family.make(np.zeros(len(family.names)))
    return prediction_errors(before, 0.0, first), prediction_errors(family.make(best.coordinates), 0.0, after)


def _mirrored(names: Sequence[str]) -> bool:
    """Whether the place of a load and an offset are open, which have two solutions."""
    places = any(name.startswith("payload.") and not name.endswith(".mass") for name in names)
    return places and any(name.startswith("offsets.") for name in names)


def _of_robot(best: RobotFit) -> dict[str, Any]:
    """What the log does not determine, in sentences, and which combinations it does."""
    unknown = [name for name, error in zip(best.names, best.standard_errors, strict=True) if np.isnan(error)]
    found = best.combinations
    sentences = []
    if unknown:
        shown = "does not show by itself" if len(unknown) == 1 else "does not show by themselves"
        sentences.append(f"this log {shown} {', '.join(unknown)}: the nearest values to the first ones are kept")
    sentences += [f"only the combination {text} is determined" for text in found.determined]
    numbers = zip(best.names, best.values, best.standard_errors, best.determined, strict=True)
    sentences += [
        f"{name} cannot be told from zero by this log: {value:.3g} ± {error:.2g}"
        for name, value, error, determined in numbers
        if np.isfinite(error) and not determined
    ]
    if _mirrored(best.names):
        sentences.append(MIRRORED)
    return {
        "undetermined": sentences,
        "combinations": list(found.determined),
        "redundant": list(found.absorbed),
        "rank": found.rank,
        "window": float(f"{2 * best.half:.4g}"),
        "residual_torque": [float(f"{size:.4g}") for size in best.torque],
    }
