"""Boxes: bounds of named variables, the domains of proofs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Box(NamedTuple):
    """Bounds of named variables; a variable with equal bounds is held fixed.

    - `names`, `units`: of the variables, as text.
    - `low`, `high` (d,): their bounds.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]

    @property
    def free(self) -> "Box":
        """The box of the variables that are not held fixed."""
        kept = np.flatnonzero(self.high > self.low)
        names, units = (tuple(words[i] for i in kept) for words in (self.names, self.units))
        return Box(names, units, self.low[kept], self.high[kept])

    def with_fixed(self, values: np.ndarray, names: tuple[str, ...] = ()) -> "Box":
        """The box with further variables (k,), held fixed at these values; without `names` theirs are empty."""
        low, high = (np.concatenate([ends, values]) for ends in (self.low, self.high))
        empty = ("",) * len(values)
        return Box((*self.names, *(names or empty)), (*self.units, *empty), low, high)

    def __str__(self) -> str:
        parts = zip(self.names, self.units, self.low, self.high, strict=True)
        return ", ".join(f"{low:.4g} ≤ {name} ≤ {high:.4g} {unit}".rstrip() for name, unit, low, high in parts)


def box(**bounds: tuple[float, float] | tuple[float, float, str]) -> Box:
    """A box from `name=(low, high)` or `name=(low, high, unit)`.

    Raises `ValueError` naming a variable whose bounds are not finite numbers in order.
    """
    units = tuple(str(b[2]) if len(b) == 3 else "" for b in bounds.values())
    low = np.array([float(b[0]) for b in bounds.values()])
    high = np.array([float(b[1]) for b in bounds.values()])
    return check_box(Box(tuple(bounds), units, low, high))


def check_box(given: Box) -> Box:
    """The box, unchanged. Raises `ValueError` naming a variable whose bounds are not finite numbers in order."""
    for name, low, high in zip(given.names, given.low, given.high, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise ValueError(f"bounds of {name} must be finite, the lower one first; got {low:g} to {high:g}")
    return given
