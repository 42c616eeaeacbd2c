"""What stamps count: fractions of days, counters that begin anew, and single rows that were stamped wrongly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._units import unit_factor

DAYS = ((25_569.0, 73_050.0), (719_529.0, 767_010.0), (2_440_587.5, 2_488_069.5))
"""Ranges of days that mean the years 1970 to 2100: days since 1900, days since the year 0, and Julian days."""
DAY = 86_400.0
"""Number of seconds in a day."""
_LARGEST_STEP_OF_DAYS = 2e-5
"""Median step below which such numbers count as days: 1.7 s in days; in seconds, 50 000 rows a second."""
_SMALLEST_STEP = 1e-6
"""Median step [s] below which numbers cannot be seconds: no machine is logged a million times a second."""
_FEWEST_ROWS = 50
"""Number of rows needed to judge their rate: a few rows may be an excerpt."""
BESIDE = 15
"""Rows on either side of one that is not in their middle if it is displaced."""
DISPLACED, REJOINED = 5.0, 3.0
"""Usual steps by which a row is displaced at least, and by which rows may be displaced by different times."""
SAME_SHIFT = 0.05
"""Relative difference up to which rows are displaced by one time."""


class Displaced(NamedTuple):
    """Rows that are stamped late by one time [s], negative for early ones."""

    rows: np.ndarray
    late: float

    @property
    def how(self) -> str:
        """By how much they are early or late."""
        return f"{abs(self.late):.6g} s {'late' if self.late > 0 else 'early'}"

    @property
    def remedy(self) -> str:
        """What to do with their stamps."""
        return f"{'subtract' if self.late > 0 else 'add'} {abs(self.late):.6g} s there"


def displaced_rows(t: Float[np.ndarray, "T"]) -> Displaced | None:
    """Rows that are stamped early or late by one time, among others whose stamps go on without them.

    A second that is read before its fraction is a second early where the fraction began anew in between.

    Args:
        t: Stamps (T,), which go back at such a row.

    Returns:
        The rows, and by how much they are late, negative for early ones; None if there are none, or other faults.

    Example:
        >>> import numpy as np
        >>> from covariant.logs import displaced_rows
        >>> rows, late = displaced_rows(np.array([0.97, 0.98, 0.99, 0.0, 1.01, 1.02, 1.03]))
        >>> rows.tolist(), round(late, 3)
        ([3], -1.0)
    """
    rising = np.diff(t)[np.diff(t) > 0]
    usual = float(np.median(rising)) if len(rising) else 0.0
    # Where stamps rise, each is in the middle of those around it.
    beside = max(min(BESIDE, (len(t) - 1) // 2), 1)
    around = np.pad(t, beside, mode="reflect", reflect_type="odd")
    others = np.delete(np.lib.stride_tricks.sliding_window_view(around, 2 * beside + 1), beside, axis=1)
    off = t - np.median(others, axis=1)
    rows = np.flatnonzero(np.abs(off) > DISPLACED * usual)
    late = float(np.median(off[rows])) if len(rows) else 0.0
    if not len(rows) or np.ptp(off[rows]) > max(SAME_SHIFT * abs(late), REJOINED * usual):
        return None
    plain = float(f"{late:.3g}")
    return Displaced(rows, plain if abs(late - plain) < usual else late)


def odd_clock(values: Float[np.ndarray, "T"], unit: str | None = None) -> str | None:
    """Fault of stamps that cannot be seconds: dates in days, or fractions of a day or a year.

    Spreadsheets count days from 1900, `datenum` from the year 0, and astronomers from 4713 BC. As seconds, such stamps
    would mean more than 50 000 rows a second. The reader and the draft of a model file refuse them, since a wrong unit
    of time gives wrong velocities.

    Args:
        values: Stamps (T,) as logged.
        unit: Their unit; None if none is stated.

    Returns:
        The fault and its remedy, as text that follows the name of the column; None if the clock may count seconds.

    Example:
        >>> import numpy as np
        >>> from covariant.logs import odd_clock
        >>> odd_clock(45_000 + np.arange(99) / 86_400).partition(",")[0], odd_clock(45_000 + np.arange(99.0))
        ('holds dates in days', None)
    """
    if len(values) < _FEWEST_ROWS or (unit is not None and unit_factor(unit) != DAY):
        return None
    step = float(np.median(np.diff(values)))
    if 0 < step < _LARGEST_STEP_OF_DAYS and any(low <= values[0] <= high for low, high in DAYS):
        return (
            "holds dates in days, as spreadsheets, datenum and Julian dates do; subtract the first of them, and write "
            't = "24 h" under [units] of the model file, or write t = "s" if they are seconds'
        )
    if unit is None and 0 < step < _SMALLEST_STEP:
        return (
            f"has {1 / step:.2g} rows a second if it holds seconds; write what one of it is under [units] of the model "
            'file, as t = "24 h" for parts of a day, or t = "s" if they are seconds'
        )
    return None
