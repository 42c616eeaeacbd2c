"""What rivals are tuned on and ranked by: a part of a log that moves and has no faults, and predictions of the rest."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant._linalg import known_rms
from covariant.calibration import Trial, errors_ahead, observer_gains, outliers, rows_ahead
from covariant.models import Motion
from covariant.scoring import scored_window, unwrap
from covariant.signals import Record
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.inputs import Loaded
from covariant.verbs.base.outcome import Outcome

SHORTEST_TRIAL = 200
"""Rows that the trial must have, so that filters can be tuned on it."""
LONGEST_TRIAL = 20_000
"""Largest number of these rows that are used: the search takes seconds on them, and minutes on a million."""
PARTS = 9
"""Number of places at which a third of the log is looked at, evenly from its start to its last third."""
MOVING = 0.25
"""Mean square velocity of a part, as a fraction of that of the log, from which the part moves."""


class Ahead(NamedTuple):
    """Errors of positions that are predicted from the estimates of each estimator, on rows that tuned nothing.

    Attributes:
        horizon: Number of rows.
        time: The same [s].
        errors: Root mean square errors (n,) by estimator; infinite where a prediction is not finite.
        apart: The same without predictions in and after holes of the log; None where it has none.
    """

    horizon: int
    time: float
    errors: dict[str, np.ndarray]
    apart: dict[str, np.ndarray] | None = None


def trial_part(loaded: Loaded) -> tuple[Trial | None, Bool[np.ndarray, "T"]]:
    """Cut the rows from a log on which filters without a model are tuned.

    Of parts as long as a third of the log that move, it is the one with the fewest faults, and of equal ones the first.
    """
    t = np.asarray(loaded.record.t)
    none, reference = np.zeros(len(t), bool), loaded.reference
    if reference is None or not loaded.kind.has_model_free_filters:
        return None, none
    y = np.asarray(loaded.record.y)
    wrong = outliers(t, y, loaded.model.circles)[0]
    known = np.asarray(np.isfinite(reference.v).all(axis=1))
    faulty = np.asarray(wrong.any(axis=1) | ~np.isfinite(y).any(axis=1))
    span = moving_part(t, reference.v, known, faulty)
    part = span & known
    part[np.flatnonzero(part)[LONGEST_TRIAL:]] = False
    # Unwrapped before the cut: across rows that are left out a full turn would go unnoticed.
    y = unwrap(np.where(wrong, np.nan, y), loaded.model.circles)[part]
    if part.sum() < SHORTEST_TRIAL or np.isfinite(y).sum(axis=0).min() < SHORTEST_TRIAL // 2:
        return None, none
    return Trial(t[part], y, reference.v[part]), span


def moving_part(
    t: Float[np.ndarray, "T"], v: Float[np.ndarray, "T n"], known: Bool[np.ndarray, "T"], faulty: Bool[np.ndarray, "T"]
) -> Bool[np.ndarray, "T"]:
    """Rows (T,) of a third of a log that moves and has the fewest faults."""
    square = np.where(known[:, None], v, 0.0) ** 2
    # Of each coordinate relative to its mean over the log; capped, for a fault of the reference is no motion.
    size = np.mean(np.minimum(square, np.quantile(square[known], 0.99, axis=0)), axis=0) if known.any() else 1.0
    motion = np.mean(np.minimum(square / np.where(size > 0, size, 1.0), 10.0), axis=1)
    third = (t[-1] - t[0]) / 3
    parts = [(t >= begin) & (t <= begin + third) for begin in np.linspace(t[0], t[-1] - third, PARTS)]
    moving = [part for part in parts if motion[part & known].size and motion[part & known].mean() >= MOVING]
    return min(moving or parts, key=lambda part: int(faulty[part].sum()))


def ahead(outcomes: dict[str, Outcome], loaded: Loaded, tuned_on: Bool[np.ndarray, "T"]) -> Ahead | None:
    """Predict positions by the model from the estimates of each estimator, on rows on which none was tuned."""
    if loaded.reference is None or loaded.log.truth is not None or np.any(loaded.file.delay):
        return None
    t = np.asarray(loaded.record.t)
    horizon = rows_ahead(loaded.rate, observer_gains(log_sheet(loaded.file, loaded), loaded.rate).beta ** 0.5)
    rows = scored_window(t) & ~tuned_on
    if rows.sum() < 4 * horizon:
        return None
    y = loaded.kind.without_outliers(t, np.asarray(loaded.record.y))
    record = _without_inputs(loaded.record._replace(y=y), horizon)
    selections, holes = [rows], loaded.holes
    if holes is not None and (rows & ~holes.concerned).sum() >= 4 * horizon:
        selections.append(rows & ~holes.concerned)

    def predicted(outcome: Outcome, selection: np.ndarray) -> np.ndarray:
        motion = loaded.model.motion(outcome.run.estimate)
        return known_rms(errors_ahead(loaded.model, record, Motion(motion.q, motion.v), selection, horizon), (0, 1))

    errors = ({name: predicted(each, selection) for name, each in outcomes.items()} for selection in selections)
    return Ahead(horizon, horizon / loaded.rate, *errors)


def _without_inputs(record: Record, horizon: int) -> Record:
    """A record whose measurements are missing where one of the `horizon` inputs that lead to them is."""
    u = np.asarray(record.u)
    absent = ~np.isfinite(u).all(1)
    if not absent.any():
        return record
    y = np.array(record.y, float)
    # The kernel begins with zero, since an input acts from its row to the next ones.
    y[np.convolve(absent, np.concatenate([[0.0], np.ones(horizon)]))[: len(u)] > 0] = np.nan
    return record._replace(u=np.nan_to_num(u), y=y)
