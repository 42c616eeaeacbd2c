"""Held-out data on which a fit is judged: the last of several logs, or the last third of one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._predict import PredictionErrors
from covariant.calibration.identification._windows import FEWEST_WINDOWS, Windows, cut_windows
from covariant.signals import Record

FITTED = 2 / 3
"""Fraction of a log, its first part, that a fit to it alone or a tuning uses; the rest is held out."""


def split_windows(
    records: Sequence[Record], velocities: Sequence[Float[np.ndarray, "_ n"]], length: float
) -> tuple[Windows, Windows]:
    """Cut windows to fit, and held-out ones: of several records the last, of a single one the last third."""
    if len(records) > 1:
        held_out = held_out_logs([np.asarray(record.t) for record in records], length)
        k = len(records) - held_out
        return cut_windows(records[:k], velocities[:k], length), cut_windows(records[k:], velocities[k:], length)
    t = np.asarray(records[0].t)
    border = float(t[0] + FITTED * (t[-1] - t[0]))
    first, last = ((-np.inf, border),), ((border, np.inf),)
    return cut_windows(records, velocities, length, first), cut_windows(records, velocities, length, last)


def held_out_logs(stamps: Sequence[Float[np.ndarray, "_"]], length: float) -> int:
    """Number of the last logs that are held out: the least that hold enough windows, and less than half of all."""
    # Windows share no row, so that each takes a step more than its length.
    counts = [int(len(t) / (length / np.median(np.diff(t)) + 1) + 1e-9) for t in stamps]
    held_out = 1
    while sum(counts[-held_out:]) < FEWEST_WINDOWS and held_out < (len(counts) - 1) // 2:
        held_out += 1
    return held_out


def error_growth(before: PredictionErrors, after: PredictionErrors) -> float:
    """Ratio of the RMS position errors after and before a fit; infinite if those after it are not finite."""
    old, new = np.asarray(before.position), np.asarray(after.position)
    # A coordinate without any error before the fit does not count.
    ratio = float(np.sqrt(np.mean((new / np.where(old > 0, old, np.inf)) ** 2)))
    return ratio if np.isfinite(ratio) else np.inf
