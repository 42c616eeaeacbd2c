"""What a fit does not see: the last of several logs, or the last third of one, on which it is judged."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant.calibration._predict import PredictionErrors
from covariant.calibration._windows import Windows, windows
from covariant.signals import Record

FITTED = 2 / 3
"""Fraction of a single log that a fit sees."""


def split(
    records: Sequence[Record], velocities: Sequence[Float[np.ndarray, "_ n"]], length: float
) -> tuple[Windows, Windows]:
    """Windows of a length [s] to fit, and those to judge the fit by: of the last record, or of the last third of one.

    Raises `ValueError` where either has too few windows.
    """
    if len(records) > 1:
        return windows(records[:-1], velocities[:-1], length), windows(records[-1:], velocities[-1:], length)
    t = np.asarray(records[0].t)
    border = float(t[0] + FITTED * (t[-1] - t[0]))
    first, last = ((-np.inf, border),), ((border, np.inf),)
    return windows(records, velocities, length, first), windows(records, velocities, length, last)


def growth(before: PredictionErrors, after: PredictionErrors) -> float:
    """The ratio of the position errors after and before a fit, root mean square over the coordinates; 1 for no change.

    Infinite where the errors afterwards are not finite.
    """
    was, is_now = np.asarray(before.position), np.asarray(after.position)
    ratio = float(np.sqrt(np.mean((is_now / np.where(was > 0, was, np.inf)) ** 2)))
    return ratio if np.isfinite(ratio) else np.inf
