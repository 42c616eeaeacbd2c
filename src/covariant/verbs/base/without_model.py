"""What the best filter without a model would make of a log, beside an estimate with one."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration import even_velocity
from covariant.observers import REGISTRY, AbstractLinearFilter
from covariant.scoring import scored_window, unwrap
from covariant.signals import Record
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.inputs import Job, Loaded, ReferenceVelocity, tells_noise
from covariant.verbs.base.model_text import advice
from covariant.verbs.base.outcome import drive
from covariant.verbs.base.trial import trial_part

BLOCKS = 20
"""Number of blocks of neighbouring rows, whose differences are taken as independent."""
SURE = 3.0
"""Standard errors by which one error must be smaller than another to be called so."""
CLEAR = 0.01
"""Least relative difference of errors that is called one."""
MOST = 30_000
"""Largest number of rows that a reference is made for."""
FEWEST = 10 * BLOCKS
"""Least number of rows to judge by."""


class WithoutModel(NamedTuple):
    """Velocity errors of the best linear filter without a model and of an estimate, on rows that tuned neither.

    Attributes:
        filter: Name of the filter.
        error: Its error as a fraction of the velocity, RMS over the coordinates.
        own: That of the estimate.
        surplus: Mean square of `own` minus that of `error`, in standard errors; what both share cancels, such as the
            noise of the reference.
        label: What the errors are against.
    """

    filter: str
    error: float
    own: float
    surplus: float
    label: str

    @property
    def is_better(self) -> bool:
        """Whether the filter is clearly better than the estimate."""
        return self._differ and self.own > self.error

    @property
    def _differ(self) -> bool:
        return abs(self.surplus) > SURE and abs(self.own / self.error - 1) > CLEAR

    @property
    def verdict(self) -> str:
        """Which of the two is better, in words."""
        if not self._differ:
            return "this log cannot tell which is better"
        return "the filter is better" if self.is_better else "the model helps"

    def sentence(self, observer: str) -> str:
        """Both errors in one line."""
        return (
            f"velocity error {100 * self.error:.3g} % without a model, by {self.filter}, and {100 * self.own:.3g} % by "
            f"{observer}, against the {self.label}, on rows that did not tune the filter: {self.verdict}"
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


def without_model(loaded: Loaded, velocity: Float[np.ndarray, "T n"]) -> WithoutModel | None:
    """Judge velocities beside those of the best linear filter without a model; None where nothing can be judged."""
    if not (loaded.kind.has_model_free_filters and tells_noise(loaded.file)):
        return None
    t = np.asarray(loaded.record.t)
    reference = loaded.reference or _slopes(loaded)
    loaded = loaded._replace(reference=reference)
    trial, tuned_on = trial_part(loaded)
    judged = reference.scored & ~tuned_on & np.isfinite(reference.v).all(1) & np.isfinite(velocity).all(1)
    holes = loaded.holes
    judged &= True if holes is None else ~holes.concerned
    if trial is None or judged.sum() < FEWEST:
        return None
    size = np.sqrt(np.mean(reference.v[judged] ** 2, axis=0))
    if not size.all():
        return None
    sheet = log_sheet(loaded.file, loaded)
    names = [entry.name for entry in REGISTRY if issubclass(entry.observer, AbstractLinearFilter)]
    filters: dict[str, Any] = loaded.kind.tuned(lambda: sheet, loaded.rate, names, trial)
    y = unwrap(loaded.kind.without_outliers(t, np.asarray(loaded.record.y)), loaded.model.circles)
    true, rate, found = reference.v / size, loaded.rate, {}
    for name, each in filters.items():
        weights = getattr(each, "observer", each).weights(rate)
        even, v = even_velocity(weights, rate, t, y)
        found[name] = float(_squares(even, v / size, t, true, judged).mean())
    best = min(found, key=found.__getitem__)
    # By its weights the best one is found; judged is what it does with the readings as they are, behind its gate.
    run = drive(filters[best], loaded).velocity
    free, own = (np.mean(((each - reference.v)[judged] / size) ** 2, axis=1) for each in (run, velocity))
    error, of_estimate = (float(np.sqrt(each.mean())) for each in (free, own))
    return WithoutModel(best, error, of_estimate, _in_standard_errors(own - free), reference.label)


def _squares(even: np.ndarray, v: np.ndarray, t: np.ndarray, true: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Mean squares (K,) of the errors of velocities at even stamps, between rows that count."""
    rows = np.interp(even, t, judged.astype(float)) == 1
    known = np.stack([np.interp(even[rows], t[judged], column) for column in true[judged].T], axis=1)
    return np.mean((v[rows] - known) ** 2, axis=1)


def _slopes(loaded: Loaded) -> ReferenceVelocity:
    """Slopes of the positions, of the rows in the middle of a long log only: those of a million take seconds."""
    log, t = loaded.log, np.asarray(loaded.record.t)
    middle = slice(max(0, (len(t) - MOST) // 2), (len(t) + MOST) // 2)
    part = Record(*(np.asarray(column)[middle] for column in log.record[:3]))
    found = loaded.kind.slopes(log._replace(record=part, whole=log.all_rows))
    v, label = np.full((len(t), loaded.file.dimension), np.nan), ""
    if found is not None:
        v[middle], label = found
    return ReferenceVelocity(v, label, scored_window(t))


def _in_standard_errors(differences: Float[np.ndarray, "K"]) -> float:
    """The mean of differences of neighbouring rows, which are not independent, in standard errors."""
    means = np.array([part.mean() for part in np.array_split(differences, BLOCKS)])
    return float(means.mean() / max(np.std(means, ddof=1) / np.sqrt(BLOCKS), np.finfo(float).tiny))
