"""Held-out data on which a fit is judged: the last of several logs, or the last third of one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._predict import PredictionErrors
from covariant.calibration.identification._windows import FEWEST_WINDOWS, Windows, windows
from covariant.signals import Record

FITTED = 2 / 3
"""Fraction of a single log that is used by a fit; the rest is held out."""


def split(
    records: Sequence[Record], velocities: Sequence[Float[np.ndarray, "_ n"]], length: float
) -> tuple[Windows, Windows]:
    """Windows to fit, and held-out windows to judge the fit by.

    Of several records the last is held out, or as many of the last ones as have enough windows, where these are short;
    of a single one the last third.

    Args:
        records: The logs.
        velocities: Reference velocities (T, n) of each.
        length: Length of the windows [s].

    Returns:
        Windows to fit, and held-out windows.

    Raises:
        ValueError: Either part has too few windows.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import split
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 30.0, 0.02)
        >>> fitted, held_out = split([Record(t, y=np.sin(t)[:, None])], [np.cos(t)[:, None]], length=1.0)
        >>> bool(fitted.t.max() < 20.0 <= held_out.t.min()), len(fitted.t) > len(held_out.t)
        (True, True)
    """
    if len(records) > 1:
        held_out = held_out_logs([np.asarray(record.t) for record in records], length)
        k = len(records) - held_out
        return windows(records[:k], velocities[:k], length), windows(records[k:], velocities[k:], length)
    t = np.asarray(records[0].t)
    border = float(t[0] + FITTED * (t[-1] - t[0]))
    first, last = ((-np.inf, border),), ((border, np.inf),)
    return windows(records, velocities, length, first), windows(records, velocities, length, last)


def held_out_logs(stamps: Sequence[Float[np.ndarray, "_"]], length: float) -> int:
    """Number of the last logs that are held out: the least that hold enough windows, and less than half of all.

    Args:
        stamps: Stamps (T,) [s] of each log.
        length: Length of the windows [s].

    Returns:
        The number, at least 1.
    """
    # Windows share no row, so that each takes a step more than its length.
    counts = [int(len(t) / (length / np.median(np.diff(t)) + 1) + 1e-9) for t in stamps]
    held_out = 1
    while sum(counts[-held_out:]) < FEWEST_WINDOWS and held_out < (len(counts) - 1) // 2:
        held_out += 1
    return held_out


def growth(before: PredictionErrors, after: PredictionErrors) -> float:
    """Ratio of the position errors after and before a fit, root mean square over the coordinates.

    Args:
        before: Prediction errors before the fit.
        after: Prediction errors after it.

    Returns:
        The ratio; 1 for no change, infinite where the errors afterwards are not finite.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import PredictionErrors, growth
        >>> before, after = (PredictionErrors(np.ones(1), np.array([size]), np.ones(1)) for size in (0.2, 0.1))
        >>> growth(before, after)
        0.5
    """
    old, new = np.asarray(before.position), np.asarray(after.position)
    # A coordinate without any error before the fit does not count.
    ratio = float(np.sqrt(np.mean((new / np.where(old > 0, old, np.inf)) ** 2)))
    return ratio if np.isfinite(ratio) else np.inf
