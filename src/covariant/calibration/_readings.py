"""What the readings of each position show of its sensor: noise and ticks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._sensor import prediction_errors, quanta
from covariant.scoring import unwrap
from covariant.signals import Record

FEWEST = 50
"""Readings of a position, more than which tell its noise."""
ALTERNATES = -0.5
"""Correlation of neighbouring errors of prediction below which they are noise, and not motion between the rows."""
ALIKE = 0.05
"""Numbers of coordinates of one unit are one number where they differ by no more than this part."""


class Readings(NamedTuple):
    """Noise and ticks of each position, in its unit.

    - `noise` (n,): standard deviation of what the neighbours of a reading do not predict; NaN where readings are few.
    - `white` (n,): whether that is noise; otherwise motion between the rows counts as well, and it is an upper bound.
    - `ticks` (n,): one tick of the encoder; 0 where readings are no whole ticks apart, or noise hides them.
    """

    noise: Float[np.ndarray, "n"]
    white: Bool[np.ndarray, "n"]
    ticks: Float[np.ndarray, "n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Standard deviations of a reading: an error uniform over a tick, or the noise."""
        return np.where(self.ticks > 0, self.ticks / np.sqrt(12), self.noise)

    @property
    def known(self) -> bool:
        """Whether every position has enough readings."""
        return bool(np.isfinite(self.noise).all())


def readings(record: Record, circles: tuple[int, ...]) -> Readings:
    """What the readings of a record in coordinates (T, n) show; `circles` are those that are angles."""
    t, y = np.asarray(record.t), unwrap(np.asarray(record.y), circles)
    noise, white = np.full(y.shape[1], np.nan), np.zeros(y.shape[1], bool)
    for i, column in enumerate(y.T):
        seen = np.isfinite(column)
        if seen.sum() > FEWEST:
            error = prediction_errors(t[seen], column[seen])
            noise[i] = 1.4826 * np.median(np.abs(error))
            white[i] = np.mean(error[1:] * error[:-1]) < ALTERNATES * np.mean(error**2)
    return Readings(noise, white, quanta(y, np.nan_to_num(noise)))


def one_or_each(values: Float[np.ndarray, "n"], units: Sequence[str], digits: int) -> float | tuple[float, ...]:
    """One number where the coordinates have one unit and numbers that are nearly alike, else one for each."""
    rounded = tuple(float(f"{value:.{digits}g}") for value in values)
    alike = len(set(units)) <= 1 and np.ptp(values) <= ALIKE * np.max(values)
    return rounded[int(np.argmax(values))] if alike else rounded


def shown(values: Sequence[float] | np.ndarray, units: Sequence[str], digits: int) -> str:
    """Numbers of coordinates with their units, for people; those that are alike once."""
    texts = (f"{value:.{digits}g} {unit}".rstrip() for value, unit in zip(values, units, strict=True))
    if len(set(units)) == 1 and np.ptp(values) <= ALIKE * np.max(values):
        return f"{np.max(values):.{digits}g} {units[0]}".rstrip()
    return ", ".join(dict.fromkeys(texts))


def written(value: float | tuple[float, ...]) -> str:
    """A number or several as in a model file."""
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
