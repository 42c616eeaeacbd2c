"""What rivals are tuned on and judged by: a part of a log that moves and has no faults, and slopes of its positions."""

import math

import numpy as np
from jaxtyping import Bool, Float

from covariant._linalg import known_rms
from covariant.calibration import Trial
from covariant.scoring import find_holes, local_polynomials, scored_window, unwrap
from covariant.signals import Record
from covariant.verbs.base.inputs import Loaded, ReferenceVelocity
from covariant.verbs.base.kinds import kind_of

SHORTEST_TRIAL, FEWEST = 100, 30
"""Rows that a third of a log must have, so that filters are tuned on it alone, and that all of a shorter one must."""
LONGEST_TRIAL = 20_000
"""Largest number of these rows that are used: the search takes seconds on them, and minutes on a million."""
PARTS = 9
"""Number of places at which a third of the log is looked at, evenly from its start to its last third."""
MOVING = 0.25
"""Mean square velocity of a part, as a fraction of that of the log, from which the part moves."""
MOST = 30_000
"""Largest number of rows that a reference is made for."""
WIDER, WIDEST = 1.4, 300
"""Ratio of the windows of references that are tried, and the number of rows of the widest one."""
LEFT_OUT, MOST_PREDICTED, NEARLY = 5, 2000, 0.02
"""One row of so many is left out and predicted, how many of these at most, and by what part errors are nearly equal."""
ORDERS, NARROWEST = (3, 5), (3, 5)
"""Orders of polynomials, and rows in half of the narrowest window of each. At the same noise of their slopes windows of
the second one are wider by (49/16)^⅓, which is about `WIDER`."""


def judging_reference(loaded: Loaded) -> ReferenceVelocity:
    """What velocities of a log are judged by: the true ones, or slopes of its positions in windows of the best width.

    Their width and order are chosen by the prediction of rows that are left out, one in `LEFT_OUT`.
    """
    if loaded.reference is not None and loaded.log.truth is not None:
        return loaded.reference
    log, t = loaded.log, np.asarray(loaded.record.t)
    # Of a long log only the rows in its middle: slopes of a million rows take seconds.
    middle = slice(max(0, (len(t) - MOST) // 2), (len(t) + MOST) // 2)
    part, kind = Record(*(np.asarray(column)[middle] for column in log.record[:3])), loaded.kind
    at = np.asarray(part.t)
    seen = kind.without_outliers(at, kind.complete(np.asarray(part.y)))
    # The entries of an attitude are as smooth as angles are.
    best = best_polynomials(at, _flat(seen) if seen.ndim > 2 else unwrap(seen, loaded.model.circles))
    half, order = best or (loaded.file.reference_half, loaded.file.reference_order)
    best = kind_of(loaded.file._replace(reference_half=half, reference_order=order))
    v = np.full((len(t), loaded.file.dimension), np.nan)
    v[middle], label = best.slopes(log._replace(record=part, whole=log.all_rows)) or (np.nan, "")
    # In a hole, also one that outliers leave, and at its edges polynomials are no measure.
    for begin, end in find_holes(at, np.asarray(_flat(np.isfinite(seen)).all(axis=1))):
        v[(t > begin - half / 4) & (t < end + half / 4)] = np.nan
    return ReferenceVelocity(v, label, scored_window(t))


def best_polynomials(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"]) -> tuple[float, int] | None:
    """Half width [s] and order of local polynomials that predict left-out rows well; None where there are too few rows.

    Slopes are best in wider windows than positions are, so of all that are nearly as good as the best it is the one
    whose slopes have the least noise.
    """
    out = np.arange(len(t)) % LEFT_OUT == LEFT_OUT // 2
    at = np.flatnonzero(out)[:: -(-int(out.sum()) // MOST_PREDICTED) or 1]
    moving = np.nanmax(y, axis=0, initial=-np.inf) > np.nanmin(y, axis=0, initial=np.inf)
    if not moving.any() or np.isfinite(y[~out][:, moving]).sum(axis=0).min() < ORDERS[-1] + 3:
        return None
    y, row = y[:, moving], float(np.median(np.diff(t)))
    widest = min(WIDEST * row / 2, (t[-1] - t[0]) / 4)
    errors = {}
    for order, least in zip(ORDERS, NARROWEST, strict=True):
        half = least * row
        while half <= widest or not errors:
            off = y[at] - local_polynomials(t[~out], y[~out], t[at], half, order)[:, 0]
            errors[half, order] = float(np.mean(np.log(known_rms(off, 0) + np.finfo(float).tiny)))
            half *= WIDER
    good = [each for each, error in errors.items() if error <= min(errors.values()) + NEARLY]
    return max(good, key=lambda each: each[0] / WIDER ** ORDERS.index(each[1]))


def trial_part(loaded: Loaded, reference: ReferenceVelocity) -> tuple[Trial | None, Bool[np.ndarray, "T"]]:
    """Cut the rows from a log on which filters without a model are tuned.

    Of parts as long as a third of the log that move, it is the one with the fewest faults, and of equal ones the first;
    of a short log all rows.
    """
    t = np.asarray(loaded.record.t)
    if not loaded.file.mechanical:
        return None, np.zeros(len(t), bool)
    known, y = np.asarray(np.isfinite(reference.v).all(axis=1)), np.asarray(loaded.record.y)
    seen = loaded.kind.without_outliers(t, y)
    faulty = np.asarray(~_flat(np.isfinite(seen)).all(axis=1))
    # Unwrapped before the cut: across rows that are left out a full turn would go unnoticed.
    y = unwrap(seen, loaded.model.circles) if seen.ndim == 2 else seen
    for span, least in ((moving_part(t, reference.v, known, faulty), SHORTEST_TRIAL), (known, FEWEST)):
        part = span & known
        part[np.flatnonzero(part)[LONGEST_TRIAL:]] = False
        if _flat(np.isfinite(y[part])).sum(axis=0).min() >= least:
            return Trial(t[part], y[part], reference.v[part]), span
    return None, np.zeros(len(t), bool)


def _flat(y: np.ndarray) -> np.ndarray:
    """The entries of every measurement side by side."""
    return y.reshape(len(y), math.prod(y.shape[1:]))


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
