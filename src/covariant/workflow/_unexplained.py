"""Whether the innovations of a filter say that its model does not explain a log."""

import math

from covariant.observers import REGISTRY
from covariant.workflow._inputs import Job, Loaded
from covariant.workflow._outcome import Outcome, counted

MARGIN = 2.0
"""How far above the band of a right model the mean NIS is before it is called too large: noise is seldom known well."""
QUANTILE = 3.09
"""Upper 99.9 % quantile of a standard normal distribution."""


def unexplained(job: Job, loaded: Loaded, observer: str, outcome: Outcome) -> str | None:
    """One sentence where the mean NIS is larger than a right model has it; None where it is not.

    The NIS of a right model with right noise, summed over N measured numbers, is χ²-distributed with N degrees of
    freedom. Said is what exceeds `MARGIN` times its 99.9 % quantile.

    Args:
        job: The model and the log, for the message.
        loaded: Both as they were read.
        observer: Name of the observer.
        outcome: Its run.
    """
    informed = any(entry.name == observer and entry.knows_model for entry in REGISTRY)
    if not (informed and loaded.file.mechanical and math.isfinite(outcome.nis)):
        return None
    limit = MARGIN * mean_quantile(int(counted(outcome.run.info, loaded)[1]))
    if outcome.nis <= limit:
        return None
    return (
        f"NIS averages {outcome.nis:.3g} a measured number, where 1 is expected and more than {limit:.3g} is no "
        "chance: the model, or the noise of the model file, does not explain this log, and standard deviations are too "
        "small; "
        f"`covariant check {job.model_name} {job.log_name}` looks for what is wrong, `covariant tune` finds noise that "
        "fits, and pushes or friction that are not known are estimated along with the motion by intrinsic-kalman with "
        "[uncertainty] external_force_std and external_force_time, or parameters"
    )


def mean_quantile(count: int) -> float:
    """The 99.9 % quantile of the mean of so many squared standard normal numbers, to 2 % from 3 of them on.

    Source: Wilson & Hilferty 1931, The distribution of chi-square, PNAS 17(12).
    """
    ninth = 2 / (9 * max(count, 1))
    return (1 - ninth + QUANTILE * math.sqrt(ninth)) ** 3
