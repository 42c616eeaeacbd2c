"""Computes a fit to logs, under inputs that are held or linear between stamps, and judges it on what is held out."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from covariant import models
from covariant.calibration import (
    Fit,
    Windows,
    fit,
    losses,
    prediction_errors,
    relations,
    split,
)
from covariant.workflow._fit_details import DIGITS, Gain, better_way, fit_details, input_details
from covariant.workflow._fit_logs import BETWEEN, FitLogs
from covariant.workflow._fit_robot import fit_robot_to_logs, is_robot_fit
from covariant.workflow._inputs import Job
from covariant.workflow._progress import Progress

ROUNDS, STEPS = 4, 25
"""Rounds of a search and the most steps in one, for the progress."""


def fit_to_logs(
    jobs: list[Job], names: Sequence[str], length: float | None, progress: Progress
) -> tuple[list[Job], dict[str, Any], dict[str, Any]]:
    """Fit parameters of a model to logs, and judge the fit on what is held out.

    Args:
        jobs: The model and the logs, the same model in each.
        names: Names of the parameters.
        length: Length of the predictions [s]; None chooses it by the motion.
        progress: Called with a description and a fraction as the work goes on.

    Returns:
        The fields of a `FitResult`, in their order.

    Raises:
        MisfitError: Where the model explains nothing of the motion in a log.
        ValueError: For a model or a log that cannot be used.
    """
    if is_robot_fit(jobs[0], names):
        return fit_robot_to_logs(jobs, names, length, progress)
    progress("reading")
    family = models.family(jobs[0].model_name, names, jobs[0].overrides)
    logs = FitLogs.read(jobs, length)
    tried = logs.tried
    try:
        parts = {
            word: split([log.commanded(word) for log in logs.logs], logs.references, logs.length) for word in tried
        }
    except ValueError as error:
        raise ValueError(f"{logs.title}: {error}") from error
    # The first is searched once more from where the last ended: both then have had the same first values.
    searches = (*tried, *tried[:-1])
    fits: dict[str, Fit] = {}
    start = None
    for k, word in enumerate(searches):

        def report(done: int, step: int, k: int = k, word: str = word) -> None:
            which = f" with {word} inputs" if len(tried) > 1 else ""
            progress(f"round {done + 1}{which}", (k + (done + step / STEPS) / ROUNDS) / len(searches))

        fits[word] = fit(family, parts[word][0], report, start)
        start = fits[word].values
    progress("errors on what is held out", 1.0)
    gain = _gain(family, {word: part[0] for word, part in parts.items()}, fits)
    used = better_way(gain, tried)
    best, held_out = fits[used], parts[used][1]
    # Before the fit no way between stamps was chosen: the first is the one that the model file would use.
    before = prediction_errors(*family.make(best.first), parts[tried[0]][1])
    after = prediction_errors(*family.make(best.values), held_out)
    content = _document(family, best, logs.fitted_to)
    if gain is not None and gain.clear:
        content.setdefault("inputs", {})["between"] = used
    details = fit_details(jobs[0], logs, best, before, after) | input_details(used, logs.stated, gain)
    return jobs, content, details | {"windows": len(parts[used][0].t), "undetermined": list(relations(best))}


def _gain(family: models.Family, windows: dict[str, Windows], fits: dict[str, Fit]) -> Gain | None:
    """None where only one way was tried. Errors are weighed as in both fits, by turns, so that none is ahead."""
    if len(fits) < 2:
        return None
    held, linear = (
        np.mean([losses(family, windows[word], fits[word], other) for other in fits.values()], axis=0)
        for word in BETWEEN
    )
    return Gain.of(held - linear)


def _document(family: models.Family, best: Fit, fitted_to: str) -> dict[str, Any]:
    """The content of the new file; a text that says where the numbers are from says where they are from now."""
    content = family.with_values(np.array([float(f"{value:.{DIGITS}g}") for value in best.values]))
    source = content.get("parameters", {}).get("source")
    if isinstance(source, str):
        content["parameters"]["source"] = f"fitted to {fitted_to} from first values of: {source}"
    return content
