"""Noise and ticks of each position sensor, from the readings of a log."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._sensor import prediction_errors, quanta
from covariant.scoring import unwrap
from covariant.signals import Record

FEWEST = 50
"""Readings of a position, more than which show its noise."""
ALTERNATES = -0.5
"""Correlation of neighbouring errors of prediction below which they are noise, and not motion between the rows."""
ALIKE = 0.05
"""Relative difference up to which the numbers of coordinates of one unit are reported as one."""

WHOLE = 0.1
"""Largest distance of changes from whole stated ticks, as a fraction of one, with which they are taken for such."""


class Readings(NamedTuple):
    """Noise and ticks of each position, in its unit.

    Attributes:
        noise: Standard deviation (n,) of the part of a reading that its neighbours do not predict; NaN for few.
        white: Whether that is noise (n,); otherwise motion between the rows counts as well, and it is an upper bound.
        ticks: One tick (n,) of the encoder; 0 where readings are no whole ticks apart, or noise hides them.
    """

    noise: Float[np.ndarray, "n"]
    white: Bool[np.ndarray, "n"]
    ticks: Float[np.ndarray, "n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Standard deviation (n,) of a reading: that of an error uniform over a tick, or the noise."""
        return np.where(self.ticks > 0, self.ticks / np.sqrt(12), self.noise)

    @property
    def known(self) -> bool:
        """Whether every position has enough readings."""
        return bool(np.isfinite(self.noise).all())


def readings(record: Record, circles: tuple[int, ...]) -> Readings:
    """Estimate noise and ticks of each position of a record.

    Args:
        record: The log, with positions (T, n) in coordinates.
        circles: Indices of the coordinates that are angles.

    Returns:
        Noise and ticks of each.
    """
    t, y = np.asarray(record.t), unwrap(np.asarray(record.y), circles)
    noise, white = np.full(y.shape[1], np.nan), np.zeros(y.shape[1], bool)
    for i, column in enumerate(y.T):
        seen = np.isfinite(column)
        if seen.sum() > FEWEST:
            error = prediction_errors(t[seen], column[seen])
            # The factor makes the median size of normal errors their standard deviation.
            noise[i] = 1.4826 * np.median(np.abs(error))
            # Neighbouring errors share measurements with opposite signs: those of white noise alternate.
            # At even stamps the weights are (1, −4, 6, −4, 1)/6: white noise has −0.8, smooth motion a positive number.
            white[i] = np.mean(error[1:] * error[:-1]) < ALTERNATES * np.mean(error**2)
    return Readings(noise, white, quanta(y, np.nan_to_num(noise)))


def known_ticks(
    record: Record, circles: tuple[int, ...], stated: float | Sequence[float] | None
) -> Float[np.ndarray, "n"]:
    """Ticks of each position: those that the readings show, or where these are few, the stated ones that they fit.

    Args:
        record: The log, with positions (T, n) in coordinates.
        circles: Indices of the coordinates that are angles.
        stated: Ticks according to the model file, one for all or one for each; None for none.

    Returns:
        The ticks (n,); 0 where there are none.
    """
    ticks, y = readings(record, circles).ticks, unwrap(np.asarray(record.y), circles)
    for i, tick in enumerate(np.broadcast_to(0.0 if stated is None else stated, len(ticks))):
        if ticks[i] == 0 and tick > 0:
            steps = np.diff(y[np.isfinite(y[:, i]), i]) / tick
            if len(steps) and np.quantile(np.abs(steps - np.round(steps)), 0.95) < WHOLE:
                ticks[i] = tick
    return ticks


def one_or_each(values: Float[np.ndarray, "n"], units: Sequence[str], digits: int) -> float | tuple[float, ...]:
    """Round the numbers of the coordinates, and merge those that are nearly equal.

    Args:
        values: A number (n,) of each coordinate.
        units: Their units.
        digits: Significant digits.

    Returns:
        The largest where all have one unit and differ by less than `ALIKE`, else one number for each.
    """
    rounded = tuple(float(f"{value:.{digits}g}") for value in values)
    alike = len(set(units)) <= 1 and np.ptp(values) <= ALIKE * np.max(values)
    return rounded[int(np.argmax(values))] if alike else rounded


def shown(values: Sequence[float] | np.ndarray, units: Sequence[str], digits: int) -> str:
    """Text of the numbers of coordinates with their units; equal ones appear once.

    Args:
        values: A number of each coordinate.
        units: Their units.
        digits: Significant digits.

    Returns:
        The text, for people.
    """
    texts = (f"{value:.{digits}g} {unit}".rstrip() for value, unit in zip(values, units, strict=True))
    if len(set(units)) == 1 and np.ptp(values) <= ALIKE * np.max(values):
        return f"{np.max(values):.{digits}g} {units[0]}".rstrip()
    return ", ".join(dict.fromkeys(texts))


def written(value: float | tuple[float, ...]) -> str:
    """Text of one number, or of one for each coordinate, in the syntax of a model file."""
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
