"""What the best filter without a model would make of a log, beside an estimate with one."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration import ErrorRatio, Trial, filter_error
from covariant.observers import REGISTRY, AbstractLinearFilter
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.inputs import INFORMED, Job, Loaded, ReferenceVelocity, tells_noise
from covariant.verbs.base.model_text import advice
from covariant.verbs.base.outcome import drive, plain
from covariant.verbs.base.trial import judging_reference, trial_part

CHEAP = ("bandwidth", "window", "motion", "loop")
"""What filters without a model are tuned by that cost little: those of coordinates are linear."""
GATED = 1.5
"""Ratio of a filter's error on its trial to that by its weights, from which its gate is in the way."""
FEWEST = 50
"""Rows without holes that suffice to judge by; where there are fewer, those in holes count too."""


class WithoutModel(NamedTuple):
    """Velocity errors of the best linear filter without a model and of an estimate, on the same rows.

    Attributes:
        filter: Name of the filter.
        verdict: Errors of the estimate and of the filter as fractions of the velocity, RMS over the coordinates, and
            the interval of their ratio.
        label: What the errors are against.
        velocity: Velocities (T, n) of the filter.
        judged: Which rows (T,) the errors are of.
        tuned: Which rows (T,) the filter was tuned on.
    """

    filter: str
    verdict: ErrorRatio
    label: str
    velocity: Float[np.ndarray, "T n"]
    judged: Bool[np.ndarray, "T"]
    tuned: Bool[np.ndarray, "T"]

    @property
    def data(self) -> dict[str, Any]:
        """The name of the filter, both errors, and the interval of their ratio."""
        return {"filter": self.filter} | {name: plain(value) for name, value in self.verdict._asdict().items()}

    @property
    def ruling(self) -> str:
        """Which of the two is better and by how much, in words."""
        error, other, low, high = self.verdict
        told = "the filter is better" if self.verdict.is_worse else "this log cannot tell which is better"
        words = "the model helps" if self.verdict.is_better else told
        return f"{words}, the error with the model is {error / other:.3g} times as large ({low:.3g} to {high:.3g})"

    def sentence(self, observer: str) -> str:
        """Both errors in one line."""
        verdict, tuned = self.verdict, np.any(self.judged & self.tuned)
        rows = f"{self.judged.sum()} rows that {'tuned the filter too' if tuned else 'did not tune the filter'}"
        return (
            f"velocity error {100 * verdict.other:.3g} % without a model, by {self.filter}, and "
            f"{100 * verdict.error:.3g} % by {observer}, against the {self.label}, on {rows}: {self.ruling}"
        )

    def advice(self, job: Job, observer: str) -> str:
        """What to do where the filter is better."""
        return (
            f"{self.sentence(observer)}; "
            + advice(
                job.model,
                check="`covariant check` looks for what is wrong with the model",
                fit="`covariant fit` for its numbers",
                tune="`covariant tune` for its noise",
            )
            + f", and until then estimate with the observer {self.filter}, whose numbers "
            "are from `motion_acceleration` and `motion_time` in [uncertainty]; `covariant compare` tunes it to the log"
        )


def without_model(
    loaded: Loaded, velocity: Float[np.ndarray, "T n"], among: Bool[np.ndarray, "T"] | None = None
) -> WithoutModel | str:
    """Judge velocities beside those of the best linear filter without a model, or say in a line why that is impossible.

    Rows count that tuned no filter and lie in no hole, of those that are `among` (by default all); where there are too
    few of them, those in holes count too, and then those that tuned the filter.
    """
    names = [entry.name for entry in REGISTRY if entry.tuned_by in CHEAP and entry.fits(loaded.model)]
    if not names:
        return "no filter without a model fits, so that nothing says whether the model helps"
    if not tells_noise(loaded.file):
        return "the model file tells no noise, so that no filter without a model can be tuned beside it"
    reference = judging_reference(loaded)
    trial, tuned_on = trial_part(loaded, reference)
    sheet = log_sheet(loaded.file, loaded)
    filters: dict[str, Any] = {} if trial is None else loaded.kind.tuned(lambda: sheet, loaded.rate, names, trial)
    return beside_filters(loaded, velocity, reference, trial, tuned_on, filters, among)


def beside_filters(
    loaded: Loaded,
    velocity: Float[np.ndarray, "T n"],
    reference: ReferenceVelocity,
    trial: Trial | None,
    tuned_on: Bool[np.ndarray, "T"],
    filters: Mapping[str, Any],
    among: Bool[np.ndarray, "T"] | None = None,
) -> WithoutModel | str:
    """Judge velocities beside those of the filter that is the best one on the trial that tuned them."""
    if trial is None:
        return f"{len(velocity)} rows are too few to judge whether the model helps"
    sheet = log_sheet(loaded.file, loaded)
    free = {name: getattr(each, "observer", each) for name, each in filters.items() if name not in INFORMED}
    errors = {
        name: filter_error(each.weights(loaded.rate), sheet, loaded.rate, trial)
        for name, each in free.items()
        if isinstance(each, AbstractLinearFilter)
    }
    # By its weights the best one is found; judged is what it does with the readings as they are, behind its gate, which
    # may refuse what is none of its outliers: then the next one is tried.
    runs: dict[str, Any] = {}
    actual: dict[str, float] = {}
    trying = tuned_on & np.isfinite(reference.v).all(axis=1)
    trying &= reference.scored if np.any(trying & reference.scored) else True
    for name in sorted(errors, key=errors.__getitem__) or free:
        runs[name] = drive(filters[name], loaded).velocity
        one = [runs[name][trying]]
        actual[name] = ErrorRatio.of_velocities(one, one, [reference.v[trying]]).error
        if not actual[name] > GATED * errors.get(name, np.inf):
            break
    best = min(actual, key=actual.__getitem__)
    known = np.isfinite(np.concatenate([reference.v, velocity, runs[best]], axis=1)).all(axis=1)
    counts = known & reference.scored & (True if among is None else among)
    apart = counts & ~tuned_on
    clear = apart if loaded.holes is None else apart & ~loaded.holes.concerned
    judged = next((rows for rows in (clear, apart, counts) if rows.sum() >= FEWEST), counts)
    if not reference.v[judged].any(axis=0).all():
        return "a coordinate stands still, so that no error is a part of its velocity"
    ratio = ErrorRatio.of_velocities(*([each[judged]] for each in (velocity, runs[best], reference.v)))
    return WithoutModel(best, ratio, reference.label, runs[best], judged, tuned_on)
