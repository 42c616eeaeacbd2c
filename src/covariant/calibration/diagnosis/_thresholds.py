"""Thresholds of all suspicions about a log and of all its checks, in one table.

The settings of a search (windows, rounds, candidates) are defined next to the search.
"""

from typing import NamedTuple

import numpy as np


class Threshold(NamedTuple):
    """Conditions on held-out rows under which a suspicion is reported.

    All shares are fractions of the sum of squared accelerations, without the noise.

    Attributes:
        least: The suspicion is tried only if the uncorrected log leaves at least this share unexplained.
        falls: Largest fraction of that share that the corrected log may leave unexplained.
        most: Largest share that the corrected log may leave unexplained.
        sure: Least significance of the fall over all blocks, in standard errors of the signed-rank statistic (4.8 if
            the share falls in all of 30 blocks).
        alike: An earlier, and so simpler, suspicion of the list is preferred if the share that it leaves is at most
            this many times the smallest.
    """

    least: float
    falls: float
    most: float = np.inf
    sure: float = 4.0
    alike: float = 1.0


THRESHOLDS = {
    # A log with a wrong unit, order or sign leaves much unexplained, and the corrected log little. Both are required,
    # since many corrections are tried. Of several that explain the log the first is reported, the others as rivals.
    "columns": Threshold(0.15, 1 / 3, 0.5, alike=1.5),
    # Friction and rotors: 10 % of the size of the accelerations. A wrong mass or centre of mass, which a rotor
    # resembles, leaves more than 15 %.
    "torques": Threshold(0.01, 1 / 2, 0.15),
    # Delays by whole rows, and how inputs change between rows: small faults. 1 % of the size of the accelerations.
    "rows": Threshold(1e-4, 1 / 2),
    # Whole rows in place of a delay that was accepted already: whichever predicts better.
    "rows for a delay": Threshold(0.0, 1.0, sure=-np.inf),
    # Delays and scales fitted by least squares: their standard errors decide (below).
    "fitted": Threshold(0.0, np.inf, sure=-np.inf),
}

BARELY = THRESHOLDS["columns"].most
"""Unexplained share from which a log is refused."""
FARTHEST = 3.0
"""Residual acceleration, as a multiple of the one that the data sheet states, from which it is a finding."""
TWIN = 2.0
"""Unexplained share, as a multiple of that in a simulated log of the model, from which it is a finding."""

# Numbers that least squares fit: standard errors, and the size that matters.
DELAY_ERRORS, DELAY_ROWS = 4.0, 0.6
"""A delay of one coordinate against another: below 0.6 rows an error of the model may look like one."""
COMMON_ERRORS, COMMON_ROWS, COMMON_GAIN = 5.0, 1.5, 0.4
"""A delay of all coordinates against the inputs, and the fraction by which it reduces the unexplained squares: a
wrong friction looks like such a delay, but explains less."""
SCALE_ERRORS, SCALE_OFF, SCALE_GAIN = 5.0, 0.25, 0.5
"""A scale of an input: its deviation from 1, and the fraction by which it reduces the squares once the others
are right."""
WHOLE_ROW = 0.2
"""Distance of a delay from a whole number of rows up to which its message says so, in rows."""
NEEDED = 1.25
"""A friction or rotor is named if the model leaves this many times as much unexplained without it as with all."""

# The clock.
GAP = 1.5
"""Ratio of a step in time to the usual one from which rows are missing, where the jitter does not explain it."""
JITTER = 0.02
"""Standard deviation of the steps in time, as a fraction of the usual one, from which they are called irregular."""
JUMP = 4.0
"""Step in time, as a multiple of the usual one, from which the clock may have been set forward."""
CONTINUES = 0.2
"""The clock was set forward if a prediction over the usual step has at most this fraction of the error of a prediction
over the whole step."""
SEEN = 10.0
"""Least displacement over the whole step, as a multiple of the noise, at which the two predictions are compared."""

# The readings.
FAR = 8.0
"""Standard deviations beyond which a measurement among its neighbours is an outlier, and a step in time a gap."""
COARSE = 0.02
"""Error of a local polynomial that is allowed for, as a fraction of the motion among the neighbours."""
FEW_OUTLIERS = 5e-3
"""Fraction of outliers up to which they are only a note."""
FEW_REPEATED = 0.02
"""Fraction of rows that repeat the readings of the row before, up to which they are no error."""
LATTICE = 0.05
"""Largest distance of changes from whole ticks, as a fraction of a tick."""
STATED_LATTICE = 0.1
"""The same for ticks that the model file states."""
LEAST_TICK = 1.5
"""Least size of a tick, in standard deviations of the noise: below that the noise hides it."""
ALTERNATES = -0.5
"""Correlation of neighbouring errors of prediction below which they are noise, and not motion between the rows."""
CLEAR = 10.0
"""Ratio of the mean square of accelerations to that of their noise from which they count as more than noise."""
