"""What a fit says of itself: its numbers, how inputs go between stamps, and errors on what is held out."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration import Fit, PredictionErrors, RobotFit, growth
from covariant.workflow._fit_logs import BETWEEN, FitLogs
from covariant.workflow._inputs import Job, coordinates
from covariant.workflow._outcome import rounded
from covariant.workflow._placeholders import placeholders

DIGITS = 7
"""Significant digits of fitted numbers in a model file."""
WORST_GROWTH = 1.01
"""A model whose held-out error is larger than so many times the one before is not written: 1 % is no difference."""
CLEAR = 2.0
"""Standard errors by which held or linear inputs must explain a log better than the other ones to be preferred."""


class Gain(NamedTuple):
    """Gain in log-likelihood of linear inputs over held ones.

    Attributes:
        of_linear: Log-likelihood with linear inputs minus that with held ones.
        standard_error: Its standard error, that of a sum over windows, so that errors may be correlated within each.
    """

    of_linear: float
    standard_error: float

    @classmethod
    def of(cls, less: Float[np.ndarray, "B"]) -> "Gain":
        """The gain from what linear inputs lower the negative log-likelihood by in each of B independent parts."""
        # The variance of a sum of independent terms is their number times that of one.
        return cls(float(np.sum(less)), float(np.sqrt(len(less)) * np.std(less, ddof=1)))

    @property
    def clear(self) -> bool:
        """Whether the gain exceeds `CLEAR` standard errors."""
        return abs(self.of_linear) > CLEAR * self.standard_error


def better_way(gain: Gain | None, tried: Sequence[str]) -> str:
    """How inputs go between stamps: linearly where that is clearly better, else in the first of the ways tried."""
    return "linear" if gain is not None and gain.clear and gain.of_linear > 0 else tried[0]


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


def input_details(used: str, stated: bool, gain: Gain | None) -> dict[str, Any]:
    """How inputs were taken to go between stamps, and how well the logs show that.

    Args:
        used: "held" or "linear".
        stated: Whether the model file says so.
        gain: Gain of linear inputs over held ones; None where only one way was tried.

    Returns:
        The entry "inputs" of a result's details.
    """
    return {
        "inputs": {
            "between": used,
            "stated": stated,
            "log_likelihood_gain": None if gain is None else float(f"{abs(gain.of_linear):.4g}"),
            "gain_standard_error": None if gain is None else float(f"{gain.standard_error:.3g}"),
            "sentence": _sentence(used, gain),
        }
    }


def fit_details(
    job: Job, logs: FitLogs, best: Fit | RobotFit, before: PredictionErrors, after: PredictionErrors
) -> dict[str, Any]:
    """Numbers before and after a fit, those that are still placeholders, and its errors on what is held out.

    Args:
        job: The model and a log.
        logs: The logs as they were read.
        best: The fit.
        before: Errors of the model before the fit.
        after: Errors of the fitted model.

    Returns:
        Plain data for the details of a result.
    """
    names, units = coordinates(logs.file)
    reference = logs.logs[-1].loaded.reference
    numbers = zip(best.names, best.first, best.values, best.standard_errors, best.determined, strict=True)
    ratio = growth(before, after)
    known = {name for name, determined in zip(best.names, best.determined, strict=True) if determined}
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
                "determined": bool(determined),
            }
            for name, first, value, error, determined in numbers
        ],
        "placeholders": {k: value for k, value in placeholders(job.model, job.overrides).items() if k not in known},
        "coordinates": list(names),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out_errors": {
            when: {kind: rounded(np.asarray(values)) for kind, values in errors._asdict().items()}
            for when, errors in (("before", before), ("after", after))
        },
        "growth": float(f"{ratio:.4g}") if np.isfinite(ratio) else None,
        "better": bool(ratio <= WORST_GROWTH),
    }
