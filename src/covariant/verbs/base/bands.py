"""Says where the standard deviations of a filter are too small for its log, by the innovations of the log itself."""

from statistics import NormalDist
from typing import Any

import numpy as np

from covariant.signals import StepCode
from covariant.verbs.base.inputs import INFORMED, Job, Loaded
from covariant.verbs.base.model_text import advice
from covariant.verbs.base.outcome import MARGIN, Outcome, force_names, known

TENTH = 0.1
"""Share of the rows that is looked at by itself: those of the fastest motion, and of the largest estimated force."""
BAND = 0.95
"""Probability with which a number is within its band where model and noise are right."""
TOO_FEW = 0.85
"""Share of innovations within the band from which the band is called too narrow: noise is seldom known well."""
FEWEST = 30
"""Rows from which a share is judged."""


def narrow_bands(job: Job, loaded: Loaded, observer: str, outcome: Outcome) -> tuple[str, ...]:
    """Sentences on what a filter found to be larger than its model file says, and on rows where its band is too narrow.

    An innovation is within its 95 % band in all but 5 % of the rows, whichever rows they are, where model and noise are
    right. Called narrow is a band that holds fewer than `TOO_FEW`, and fewer than chance allows once in 1000 logs.
    """
    if not (observer in INFORMED and loaded.file.mechanical):
        return ()
    info = outcome.run.info
    return tuple(text for text in (_larger(job, info, outcome), *_narrow(loaded, info, outcome)) if text)


def _larger(job: Job, info: Any, outcome: Outcome) -> str | None:
    if (scale := known(info, "noise_scale")) is None:
        return None
    sizes = np.sqrt(np.broadcast_to(scale, outcome.run.t.shape))
    usual, most = float(np.mean(sizes)), float(np.quantile(sizes, 1 - TENTH))
    # Within a factor of 2 on average, or of 4 in a tenth of the rows, noise may be that little known.
    if usual <= MARGIN and most <= MARGIN**2:
        return None
    remedies = {"tune": "`covariant tune` finds sizes that fit", "fit": "`covariant fit` finds a better model"}
    return (
        f"what the model does not know is {usual:.2g} times as large in this log as the model file says, and "
        f"{most:.2g} times or more in a tenth of the rows; the filter follows with its gains and standard deviations. "
        + (advice(job.model, **remedies) or "`covariant check` looks for what the model lacks")
    )


def _narrow(loaded: Loaded, info: Any, outcome: Outcome) -> list[str]:
    cov, innovation = known(info, "innovation_cov"), known(info, "innovation")
    names = loaded.kind.estimates.names
    if cov is None or innovation is None or innovation.shape[1] != len(names):
        return []
    used = (np.asarray(info.result) < StepCode.OUTLIER) & np.any(innovation != 0, axis=1)
    used[0] = False
    inside = np.abs(innovation) <= NormalDist().inv_cdf((1 + BAND) / 2) * np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    moments = {"moves fast": np.abs(outcome.velocity)}
    forces, slow = force_names(loaded.file, outcome.slow_names), known(info, "slow")
    if slow is not None and len(forces) == len(names):
        moments["is pushed"] = np.abs(slow[:, [outcome.slow_names.index(name) for name in forces]])
    found = []
    for j, name in enumerate(names):
        for when, size in moments.items():
            rows = used & (size[:, j] >= np.quantile(size[used, j], 1 - TENTH)) if used.any() else used
            count = int(rows.sum())
            chance = NormalDist().inv_cdf(0.999) * np.sqrt(BAND * (1 - BAND) / max(count, 1))
            share = float(np.mean(inside[rows, j])) if count else 1.0
            if count >= FEWEST and share < min(TOO_FEW, BAND - chance):
                found.append(
                    f"the band of {name} is too narrow while it {when}: the 95 % band holds {100 * share:.0f} % of "
                    f"the innovations in that tenth of the rows, and {100 * np.mean(inside[used, j]):.0f} % of all"
                )
    return found
