"""Sentences on what a log does not determine."""

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._fit import Fit

SHOWN = 0.03
"""Parts of a combination below this fraction of the largest are not told."""
MOVED = 0.01
"""A number that is further from its first value, relatively, has left it."""
ALIKE = 0.05
"""An exponent that is so close to a whole number or a half is written as that."""


def relations(fit: Fit) -> tuple[str, ...]:
    """A sentence for each combination of the numbers that the log does not determine, with its weights."""
    away = np.abs(fit.values - fit.first) > MOVED * np.abs(fit.first)
    return tuple(_sentence(fit.names, row, away) for row in fit.undetermined)


def _sentence(names: tuple[str, ...], row: Float[np.ndarray, "p"], away: Bool[np.ndarray, "p"]) -> str:
    row = row / row[np.argmax(np.abs(row))]
    parts = [(name, weight) for name, weight in zip(names, row, strict=True) if abs(weight) > SHOWN]
    parts.sort(key=lambda part: -abs(part[1]))
    if len(parts) == 1 and away[names.index(parts[0][0])]:
        return f"{parts[0][0]} cannot be told from zero by this log; leave it out, or log a motion that shows it"
    if len(parts) == 1:
        return f"{parts[0][0]} cannot be told from this log; it keeps its first value"
    if len(parts) == 2:
        (one, _), (other, weight) = parts
        power = -1 / weight  # what stays the same is one · other^power
        both = f"{one} · {_power(other, power)}" if power > 0 else f"{one} / {_power(other, -power)}"
        what = "product" if power > 0 else "ratio"
        return f"only the {what} {both} is determined: {one} and {other} cannot be told apart"
    moves = ", ".join(f"{name} by {weight:+.2g} %" for name, weight in parts)
    return f"cannot be told apart: changing {moves} together changes nothing that this log shows"


def _power(name: str, power: float) -> str:
    whole = round(2 * power) / 2
    power = whole if abs(power - whole) < ALIKE * max(whole, 0.5) else power
    return name if power == 1 else f"{name}^{power:.3g}"
