"""Which readings of a run were refused, what they read and what was expected, and whether they look like motion."""

from typing import Any, NamedTuple

import numpy as np

from covariant.signals import StepCode
from covariant.verbs.base.inputs import Loaded
from covariant.verbs.base.outcome import Outcome, known, plain

SHOWN = 3
"""Number of refused stretches that a sentence names."""
LISTED = 20
"""Number of refused stretches in a summary."""
STAYED = 0.5
"""Share of the last refused innovation from which the next one says that the reading did not return."""


class Refusal(NamedTuple):
    """Readings of one component that were refused in a row.

    Attributes:
        name: The component that was farthest off, by the name of its column or, on a group, of its velocity.
        unit: Unit of the numbers.
        t: Time of the first of them [s].
        rows: Number of readings.
        read: The first reading; NaN on a group, where a component has no reading of its own.
        expected: What was expected in its place.
        off: Difference of the two.
        stayed: Whether the next reading was off to the same side too, as motion is and an outlier is not.
    """

    name: str
    unit: str
    t: float
    rows: int
    read: float
    expected: float
    off: float
    stayed: bool

    def __str__(self) -> str:
        many, unit = f"{self.rows} readings" if self.rows > 1 else "1 reading", f" {self.unit}".rstrip()
        what = f"off by {self.off:.4g}{unit}"
        if np.isfinite(self.read):
            what = f"read {self.read:.4g}, expected {self.expected:.4g}{unit}"
        return f"{many} of {self.name} at {self.t:.4g} s ({what})"

    @property
    def data(self) -> dict[str, Any]:
        """The refusal as JSON data, without what is not known."""
        numbers = {key: plain(getattr(self, key)) for key in ("t", "read", "expected", "off")}
        known_numbers = {key: value for key, value in numbers.items() if value is not None}
        return {"name": self.name, "rows": self.rows, **known_numbers, "stayed": self.stayed}


def refusals(loaded: Loaded, outcome: Outcome) -> list[Refusal]:
    """Refused stretches of a run, from the first to the last."""
    innovation, codes = known(outcome.run.info, "innovation"), np.asarray(outcome.run.info.result)
    refused = codes == StepCode.OUTLIER
    if innovation is None or not refused.any():
        return []
    t, y = np.asarray(outcome.run.t), np.asarray(loaded.record.y)
    # The component that is farthest off, relative to what it is in rows that were used.
    ordinary = codes < StepCode.OUTLIER
    used = np.sqrt(np.mean(innovation[ordinary] ** 2, axis=0)) if ordinary.any() else 1.0
    worst = np.argmax(np.abs(innovation) / np.maximum(used, np.finfo(float).tiny), axis=1)
    columns, units = loaded.kind.measured
    has_readings = y.shape == innovation.shape
    names = columns if has_readings and len(columns) == innovation.shape[1] else loaded.kind.axes.names
    rows, listed = np.flatnonzero(refused), []
    breaks = np.flatnonzero((np.diff(rows) > 1) | (np.diff(worst[rows]) != 0)) + 1
    for stretch in np.split(rows, breaks):
        first, last, k = stretch[0], stretch[-1], worst[stretch[0]]
        off = float(innovation[first, k])
        read = float(y[first, k]) if has_readings else np.nan
        after = innovation[last + 1, k] / innovation[last, k] if last + 1 < len(t) else 0.0
        unit = units[k] if k < len(units) else ""
        numbers = float(t[first]), len(stretch), read, read - off, off
        listed.append(Refusal(names[k], unit, *numbers, bool(after > STAYED)))
    return listed


def refused_text(refused: list[Refusal]) -> str:
    """The longest refused stretches in a sentence, and what to do where they look like motion; "" without any."""
    if not refused:
        return ""
    longest = sorted(refused, key=lambda each: -each.rows)[:SHOWN]
    more = len(refused) - len(longest)
    text = "; ".join(str(each) for each in sorted(longest, key=lambda each: each.t))
    text += f"; and {more} more" if more else ""
    stayed = sum(each.stayed for each in refused)
    if 2 * stayed > len(refused) and stayed > 1:
        text += (
            f". After {stayed} of {len(refused)} the next reading was off to the same side, as with motion that the "
            "model does not know: look for impacts and late columns by `covariant check`, or give a larger "
            "`acceleration` in [uncertainty]"
        )
    return text
