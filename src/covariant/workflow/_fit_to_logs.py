"""Computes a fit to logs, under inputs that are held or linear between stamps, and judges it on what is held out."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant import models
from covariant.calibration import (
    FITTED,
    Fit,
    PredictionErrors,
    Windows,
    fit,
    growth,
    held_out_logs,
    horizon,
    losses,
    prediction_errors,
    relations,
    split,
)
from covariant.workflow._aligned import Aligned, aligned
from covariant.workflow._inputs import Job, coordinates
from covariant.workflow._model_output import seen_logs
from covariant.workflow._outcome import rounded
from covariant.workflow._progress import Progress

DIGITS = 7
"""Significant digits of fitted numbers in a model file."""
WORST_GROWTH = 1.01
"""A model whose held-out error is larger than so many times the one before is not written: 1 % is no difference."""
ROUNDS, STEPS = 4, 25
"""Rounds of a search and the most steps in one, for the progress."""
CLEAR = 2.0
"""Standard errors by which held or linear inputs must explain a log better than the other ones to be preferred."""
BETWEEN = ("held", "linear")


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
    progress("reading")
    spec, overrides = jobs[0].model_name, jobs[0].overrides
    family = models.family(spec, names, overrides)
    logs = [aligned(job) for job in jobs]
    file, references = logs[0].loaded.file, [log.loaded.reference.v for log in logs if log.loaded.reference]
    part = 1 - FITTED if len(jobs) == 1 else 1.0
    length = horizon(logs[0].raw, references[0], part, len(logs)) if length is None else length
    known = file.input_between != BETWEEN[0] or "between" in models.document(spec, overrides).get("inputs", {})
    tried = BETWEEN if not known and _driven(logs) else (file.input_between,)
    try:
        parts = {word: split([log.commanded(word) for log in logs], references, length) for word in tried}
    except ValueError as error:
        raise ValueError(f"{', '.join(job.log_name for job in jobs)}: {error}") from error
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
    used = BETWEEN[1] if gain is not None and gain.clear and gain.of_linear > 0 else tried[0]
    best, held_out = fits[used], parts[used][1]
    before = prediction_errors(*family.make(best.first), parts[tried[0]][1])
    after = prediction_errors(*family.make(best.values), held_out)
    content = _document(family, best, jobs)
    if gain is not None and gain.clear:
        content.setdefault("inputs", {})["between"] = used
    inputs = {
        "between": used,
        "stated": known,
        "log_likelihood_gain": None if gain is None else float(f"{abs(gain.of_linear):.4g}"),
        "gain_standard_error": None if gain is None else float(f"{gain.standard_error:.3g}"),
        "sentence": _sentence(used, gain),
    }
    details = _details(jobs, logs, best, length, len(parts[used][0].t), before, after) | {"inputs": inputs}
    return jobs, content, details


def _driven(logs: list[Aligned]) -> bool:
    """Whether any input changes: one that is constant is the same held and linear."""
    return any(bool((np.ptp(np.asarray(log.raw.u), axis=0) > 0).any()) for log in logs)


class Gain(NamedTuple):
    """Gain in log-likelihood of linear inputs over held ones.

    Attributes:
        of_linear: Log-likelihood with linear inputs minus that with held ones.
        standard_error: Its standard error, that of a sum over windows, so that errors may be correlated within each.
    """

    of_linear: float
    standard_error: float

    @property
    def clear(self) -> bool:
        """Whether the gain exceeds `CLEAR` standard errors."""
        return abs(self.of_linear) > CLEAR * self.standard_error


def _gain(family: models.Family, windows: dict[str, Windows], fits: dict[str, Fit]) -> Gain | None:
    """None where only one way was tried. Errors are weighed as in both fits, by turns, so that none is ahead."""
    if len(fits) < 2:
        return None
    held, linear = (
        np.mean([losses(family, windows[word], fits[word], other) for other in fits.values()], axis=0)
        for word in BETWEEN
    )
    less = held - linear  # losses are negative log-likelihoods, so this is the gain of linear inputs in each window
    # The variance of a sum of independent terms is their number times that of one.
    return Gain(float(np.sum(less)), float(np.sqrt(len(less)) * np.std(less, ddof=1)))


def _sentence(used: str, gain: Gain | None) -> str:
    if gain is None:
        return ""
    other = next(word for word in BETWEEN if word != used)
    size = f"{abs(gain.of_linear):.3g} ± {gain.standard_error:.2g}"
    if not gain.clear:
        return (
            f"Inputs are taken as {used} from one stamp to the next; the log hardly tells that from {other} (the "
            f"log-likelihoods differ by {size})."
        )
    phrase = {"held": "held from one stamp to the next", "linear": "linear between stamps"}[used]
    return f"Inputs {phrase} explain the log better than {other} ones, by {size} in log-likelihood; they are used."


def _document(family: models.Family, best: Fit, jobs: list[Job]) -> dict[str, Any]:
    """The content of the new file; a text that says where the numbers are from says where they are from now."""
    content = family.with_values(np.array([float(f"{value:.{DIGITS}g}") for value in best.values]))
    source = content.get("parameters", {}).get("source")
    if isinstance(source, str):
        content["parameters"]["source"] = (
            f"fitted to {seen_logs([job.log_name for job in jobs])} from first values of: {source}"
        )
    return content


def _held_out(jobs: list[Job], logs: list[Aligned], length: float) -> str:
    """What is held out, in words."""
    if len(jobs) == 1:
        return f"the last third of {jobs[0].log_name}"
    count = held_out_logs([np.asarray(log.raw.t) for log in logs], length)
    return jobs[-1].log_name if count == 1 else f"the last {count} logs"


def _details(
    jobs: list[Job],
    logs: list[Aligned],
    best: Fit,
    length: float,
    count: int,
    before: PredictionErrors,
    after: PredictionErrors,
) -> dict[str, Any]:
    names, units = coordinates(logs[0].loaded.file)
    reference = logs[-1].loaded.reference
    numbers = zip(best.names, best.first, best.values, best.standard_errors, best.determined, strict=True)
    ratio = growth(before, after)
    return {
        "model": jobs[0].model_name,
        "logs": [job.log_name for job in jobs],
        "held_out": _held_out(jobs, logs, length),
        "horizon": float(f"{length:.4g}"),
        "windows": count,
        "scored_against": reference.label if reference else None,
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
        "undetermined": list(relations(best)),
        "coordinates": list(names),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out_errors": {
            when: {kind: rounded(np.asarray(values)) for kind, values in errors._asdict().items()}
            for when, errors in (("before", before), ("after", after))
        },
        "growth": float(f"{ratio:.4g}") if np.isfinite(ratio) else None,
        "better": bool(ratio <= WORST_GROWTH),
    }
