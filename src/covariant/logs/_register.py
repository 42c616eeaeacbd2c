"""How the numbers of a column code a quantity: resolution, sign bits, and rows that were made from their neighbours.

Positions, velocities and inputs are read from registers alike, so that one description serves them all.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

ROUNDING = 1e-11
"""Differences of readings, relative to the largest of them, up to which they are rounding errors and no change."""
LATTICE, ROUNDED = 0.05, 0.3
"""Largest distance of readings from whole ticks, as a fraction of one, and where they were rounded."""
FEWEST_GAPS = 10
"""Least number of distances between neighbouring values that show ticks which were rounded."""
REACHES = 3.0 ** np.arange(1, 13)
"""Ticks on either side of a value over which their size is fitted in turn."""
FEWEST_CHANGES = 20
"""Least number of changes of a column that show ticks, or between which rows were interpolated."""
SIGN_BITS = tuple(float(2**k) for k in range(7, 32))
"""Values of the bits of a register that may be its sign."""
SHORTEST_WORD = 2.0**11
"""Least sign bit of two's complement: what switches near both ends of a shorter range looks like it."""
FEWEST_VALUES = 5
"""Least number of different magnitudes of either sign that show a sign bit; what switches between two values has one.
"""
NEAR_ZERO = 1 / 16
"""Largest of the smallest magnitudes of either sign, relative to the largest one, since signals pass zero."""
FULL = 0.9
"""Magnitude of one sign, in the bit, from which the other one has to be as large."""
CROSSINGS = (0.65, 0.8)
"""Fraction of the changes of sign that are less than half as long once they are decoded, beside a magnitude and in
two's complement, of which every second one is so for a counter that begins anew."""
USUAL = 4.0
"""Largest change across zero of decoded numbers, in the 95th percentile of their other changes."""
LONG = 100_000
"""Rows of a long log from which its ticks are told."""
MOST_ROWS = 20_000
"""Rows of a long log in which made ones are looked for."""
DIGITS, FASTER = (1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3), 10.0
"""Last digits of printed numbers, relative to their range, and the least step of a row that moves, in last digits."""
MOST_EVERY = 50
"""Most rows per reading that are looked for."""
CERTAIN = 30.0
"""Changes of slope that are expected in rows that have none, if rows were not made from their neighbours."""
COUNTERS = tuple(2.0**k * unit for k in (16, 24, 31, 32) for unit in (1.0, 1e-3, 1e-6, 1e-9))
"""Numbers after which a counter of ticks begins anew, in its ticks or in seconds."""
NEAR = 20.0
"""Largest step across which a counter begins anew, in usual steps: some rows may be missing there."""
STRAGGLERS, READ = 0.02, 0.1
"""Fraction of rows with a change of slope up to which rows count as made, and from which one of every n as read."""


class Register(NamedTuple):
    """How the numbers of a column code a quantity.

    Attributes:
        tick: Resolution, of which all changes are multiples; 0 where the numbers show none.
        negative: Number from which numbers are negative; 0 where they have their sign.
        span: What a negative number is short of, in two's complement; 0 for a sign bit beside a magnitude.

    Example:
        >>> import numpy as np
        >>> from covariant.logs import Register
        >>> load = np.round(40 * np.sin(np.arange(99) / 7))
        >>> Register.of(load).negative, Register.of(np.where(load < 0, 1024 - load, load)).negative
        (0.0, 1024.0)
    """

    tick: float
    negative: float = 0.0
    span: float = 0.0

    @classmethod
    def of(cls, values: Float[np.ndarray, "T"]) -> "Register":
        """The register of a column (T,)."""
        values = values[np.isfinite(values)]
        some = values[:LONG]
        tick = _resolution(some)
        # Of bits, also where only even numbers were read, or few of those between them.
        unit = 1.0 if not (values % 1).any() else tick
        if not len(values) or values.min() < 0 or not unit:  # a number below zero has its sign
            return cls(tick)
        plain = float(f"{unit:.6g}")
        unit = plain if abs(unit / plain - 1) < 1e-7 else unit
        counts = np.rint(values / unit)
        for bit in (each for each in SIGN_BITS if each < counts.max() < 2 * each):
            for span in (0.0, 2 * bit)[: 1 + (bit >= SHORTEST_WORD)]:
                if _is_coded(counts, bit, span):
                    return cls(unit, bit * unit, span * unit)
        return cls(tick)

    def fault(self, name: str) -> str | None:
        """What is wrong with a column that is used as plain numbers, with the expression that decodes it."""
        if not self.negative:
            return None
        bit, width = f"{self.negative:.10g}", round(np.log2(self.negative / self.tick)) + 1
        minus, how = (f"{bit} - x", "whose highest bit is a sign") if not self.span else (f"x - {self.span:.10g}", "")
        coding = f"{width}-bit words {how}, as serial-bus servos send them" if how else f"{width}-bit two's complement"
        return (
            f"column {name!r} holds {coding}: numbers from {bit} on are negative; decode it in the log, as "
            f"numpy.where(x >= {bit}, {minus}, x)"
        )

    @staticmethod
    def read_rows(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> tuple[int, int]:
        """Distance of the rows that were read, where the others lie on the line between them, and the first such row.

        A column that was brought to the stamps of faster ones changes its slope in few of every n rows, always the same
        ones; readings of a sensor change it in all. 1 and 0 where no rows were made so.

        Args:
            t: Stamps (T,).
            y: Readings (T,).

        Example:
            >>> import numpy as np
            >>> from covariant.logs import Register
            >>> t, slow = np.arange(1000) / 500, np.arange(2, 1002, 5) / 500
            >>> Register.read_rows(t, np.sin(9 * t)), Register.read_rows(t, np.interp(t, slow, np.sin(9 * slow)))
            ((1, 0), (5, 2))
        """
        y, t = y[:MOST_ROWS], t[:MOST_ROWS]
        steps, passed = np.diff(y), np.diff(t)
        bend = np.abs(np.diff(steps / passed)) * np.minimum(passed[1:], passed[:-1])
        slowest = np.minimum(np.abs(steps[1:]), np.abs(steps[:-1]))
        extent = float(np.nanmax(y) - np.nanmin(y)) if np.isfinite(y).any() else 0.0
        for rounding in (extent * digit for digit in DIGITS):
            moving = np.flatnonzero(slowest > FASTER * rounding)
            bent = bend[moving] > 2 * rounding  # printed numbers are off the line by their last digit
            if bent.sum() >= FEWEST_CHANGES and (read := _places(moving + 1, bent)) is not None:
                return read
        return 1, 0

    @staticmethod
    def continued(values: Float[np.ndarray, "T"], periods: tuple[float, ...] = COUNTERS) -> Float[np.ndarray, "T"]:
        """Numbers of a counter that begins anew, as of microseconds in 32 bits after 71 minutes, as if it went on.

        Args:
            values: Stamps (T,) as logged.
            periods: Numbers after which it may begin anew.

        Returns:
            The stamps; as they are where they rise, or go back by something else.

        Example:
            >>> import numpy as np
            >>> from covariant.logs import Register
            >>> Register.continued(np.array([4294965296.0, 4294966296.0, 0.0, 1000.0])).tolist()
            [4294965296.0, 4294966296.0, 4294967296.0, 4294968296.0]
        """
        back = np.diff(values) < 0
        for period in periods if back.any() else ():
            rising = values + period * np.concatenate([[0], np.cumsum(back)])
            steps, usual = np.diff(rising), float(np.median(np.diff(rising)))
            # It begins anew after the whole period, and nowhere else.
            if np.ptp(values) < period and steps.min() > 0 and steps[back].max() < NEAR * usual < period / 10:
                return rising
        return values


def _is_coded(counts: Float[np.ndarray, "T"], bit: float, span: float) -> bool:
    """Whether numbers from `bit` on are negative: both signs begin at zero, and changes of sign become short."""
    below = counts < bit
    decoded = np.where(below, counts, counts - span if span else bit - counts)
    turns = np.diff(below.astype(int))
    crossing = np.flatnonzero(turns)
    others = np.abs(np.delete(np.diff(decoded), crossing))
    if not others.any() or (span and not (turns.min() < 0 < turns.max())):
        return False  # a counter that begins anew
    usual = float(np.quantile(others[others > 0], 0.95))
    parts = decoded[below], -decoded[~below]
    # Numbers up to a little more than the bit are larger ones and not negative.
    largest = [float(part.max(initial=0.0)) for part in parts]
    if max(largest) > FULL * bit and min(largest) < FULL * max(largest):
        return False
    for part in parts:
        if len(part) == 0 or len(np.unique(part[:LONG])) < FEWEST_VALUES:
            return False
        if part.min() > 1 + max(NEAR_ZERO * part.max(), usual):
            return False
    plain, short = (np.abs(np.diff(each))[crossing] for each in (counts, decoded))
    # An angle that wraps within the bits jumps by the same length each time, and not by a usual step.
    # From zero, where pulses begin, any number beyond the bit is nearer once it is decoded.
    limit = plain / np.where((counts[crossing] == 0) | (counts[crossing + 1] == 0), 4, 2)
    shorter = np.mean((short < limit) & (plain > bit / 2)) >= CROSSINGS[span > 0]
    return bool(shorter and np.median(short) <= USUAL * usual)


def _resolution(y: Float[np.ndarray, "T"]) -> float:
    """Step of which all readings are multiples, up to their last digits; 0 for none."""
    rounding = ROUNDING * np.max(np.abs(y), initial=0.0)
    if np.count_nonzero(np.abs(np.diff(y)) > rounding) < FEWEST_CHANGES:
        return 0.0
    levels = np.unique(y)
    gaps = np.diff(levels)[np.diff(levels) > rounding]
    # Ticks may be rounded to a decimal after them, as 0.088° to 0.08 or 0.09; few values are near any ticks.
    most = ROUNDED if len(gaps) > FEWEST_GAPS else LATTICE
    # A low quantile and not the minimum, which one wrong cell can spoil; the least one may be two or three ticks.
    for fraction in (1, 2, 3):
        step = float(np.quantile(gaps, 0.02)) / fraction
        # From where most values are close together: at the turns of a fast motion.
        ends = (np.searchsorted(levels, levels + side * REACHES[1] * step) for side in (1, -1))
        start = float(levels[np.argmax(np.subtract(*ends))])
        for reach in REACHES:  # over k ticks an error of the step grows k times
            near = levels[np.abs(levels - start) <= reach * step]
            ticks = np.rint((near - start) / step)
            if np.ptp(ticks) > 0:
                step, start = (float(x) for x in np.polyfit(ticks, near, 1))
        off = np.abs((levels - start) / step - np.rint((levels - start) / step))
        if np.quantile(off, 0.95) < most:
            return step
    return 0.0


def _places(rows: np.ndarray, bent: np.ndarray) -> tuple[int, int] | None:
    """The largest n of which all rows but one are straight, among rows that move, and the place of that one."""
    for n in range(MOST_EVERY, 1, -1):
        among = np.bincount(rows % n, minlength=n)
        often = np.bincount(rows % n, bent, n) / np.maximum(among, 1)
        read = int(np.argmax(often))
        # By chance no row of so many at each other place is straight, if any may bend.
        chance = bent.mean() * (n - 1) * among.min()
        if chance > CERTAIN and often[read] > READ and bent[rows % n != read].mean() <= STRAGGLERS:
            return n, read
    return None
