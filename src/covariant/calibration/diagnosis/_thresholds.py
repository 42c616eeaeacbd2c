"""Sizes above which an effect in a log is reported: one table for all suspicions and checks.

Settings of a search (windows, rounds, candidates) are in the file of the search.
"""

from typing import NamedTuple

import numpy as np


class Threshold(NamedTuple):
    """Conditions on held-out rows under which a suspicion is reported.

    All shares are of the squares of the accelerations, without the noise.

    Attributes:
        least: Unexplained share of the unchanged log below which the suspicion is not tried.
        falls: Largest fraction of that share that may remain unexplained after the change that the suspicion makes.
        most: Largest share that may remain unexplained after this change.
        sure: Standard errors of the signed ranks of its falls in all blocks (if it falls in all of 30: 4.8).
        alike: An earlier, simpler suspicion of the list is preferred if its share is at most this multiple of the least
            one.
        rest: The same if it is at most this fraction of what the best one explains.
    """

    least: float
    falls: float
    most: float = np.inf
    sure: float = 4.0
    alike: float = 1.0
    rest: float = 0.0


THRESHOLDS = {
    # A log with a wrong unit, order or sign fits badly, and a corrected one fits well. Many corrections are tried, so
    # both are required. The first of several that explain the log is reported, and the others are named as rivals.
    "columns": Threshold(0.15, 1 / 3, 0.5, alike=1.5),
    # Other numbers than a model file has, alone or with another unit, order or sign of columns; faults that are looked
    # for later may be left.
    "guesses": Threshold(0.05, 1 / 3, 0.3, alike=1.5),
    # Other numbers in place of a delay, a scale or friction.
    "guesses or a fault": Threshold(1e-3, 1 / 3, 0.3, alike=1.5),
    # Friction and gravity: 10 % of the size of the accelerations. A wrong mass or centre of mass leaves more than 15 %.
    "torques": Threshold(0.01, 1 / 2, 0.15, alike=1.5),
    # Rotors, which a wrong mass resembles, only where friction and gravity explain less.
    "rotors": Threshold(0.01, 1 / 2, 0.15),
    # A column and torques together, where neither explains the log alone.
    "columns and torques": Threshold(0.15, 1 / 5, 0.15),
    # Curves of an input, beside all that a model may have wrong: so a curve explains nothing that these do.
    "curve": Threshold(2e-4, 1 / 2, 0.15, sure=3.0, alike=1.5, rest=0.03),
    # Zeros that move, of which many paths are tried, beside a model whose numbers may be wrong.
    "moving zero": Threshold(1e-3, 1 / 4, 0.05, alike=1.5),
    # Delays by whole rows, and the course of inputs between rows, are small faults. 1 % of the size of the
    # accelerations.
    "rows": Threshold(1e-4, 1 / 2),
    # Whole rows in place of a delay that was accepted already: the one that predicts better wins.
    "rows for a delay": Threshold(0.0, 1.0, sure=-np.inf),
    # Delays and scales that least squares gave: their standard errors have judged them (below).
    "fitted": Threshold(0.0, np.inf, sure=-np.inf, alike=1.2),
    # Commands in another unit, order or sign, and limits: faults of the whole log.
    "servo": Threshold(5e-3, 1 / 3, 0.5, alike=1.2),
    # A servo that lets go, or changes its gain or zero: only a part of the log is otherwise.
    "servo change": Threshold(4e-3, 1 / 2, 0.3, sure=2.5, alike=1.5),
    # Readings of a part of the log, which may be short: they look wrong by themselves, and the model says so as well.
    "part of the log": Threshold(1e-3, 1 / 2, 0.5, sure=-np.inf),
    # Readings with noise that are all the same, or a single step beyond all speeds: no motion looks like it, whatever
    # the model.
    "certain": Threshold(0.0, np.inf, sure=-np.inf),
    # The same of readings that look like those of a joint at rest, as by friction that the model lacks.
    "rest": Threshold(0.15, 1 / 10, 0.02, sure=-np.inf),
    # Torques and delays or scales together.
    "torques and fitted": Threshold(0.01, 1 / 2, 0.15),
}

BARELY = THRESHOLDS["columns"].most
"""Unexplained share from which a log is refused."""
FARTHEST = 3.0
"""Residual acceleration, as a multiple of the one that the data sheet states, from which it is a finding."""
TWIN = 2.0
"""Unexplained share, as a multiple of that in a simulated log of the model, above which it is a finding."""

# Numbers that least squares fit: standard errors, and the size that matters.
DELAY_ERRORS, DELAY_ROWS = 4.0, 0.6
"""A delay of one coordinate against another; a model error may look like a delay below 0.6 rows."""
LONG_GAIN = 0.4
"""By which fraction the unexplained squares fall at least by a delay of more rows than are tried one by one, and by any
delay beside torques that the model lacks: a wrong friction looks like it, but explains less."""
COMMAND_ERRORS = 8.0
"""The same of a command against its servo, whose friction and damping are not known either."""
COMMON_ERRORS, COMMON_ROWS, COMMON_GAIN = 5.0, 1.5, LONG_GAIN
"""A delay of all coordinates against the inputs, and by which fraction the unexplained squares fall."""
SCALE_ERRORS, SCALE_OFF, SCALE_GAIN = 5.0, 0.25, 0.5
"""A scale of an input: its deviation from 1, and the fraction by which it reduces the squares once others are right."""
CURVE_ERRORS = 5.0
"""Size of an offset, a limit or a dead band of an input, in standard errors, from which it may be one."""
WHOLE_ROW = 0.2
"""Distance of a delay from a whole number of rows up to which its message says so, in rows."""
NEEDED = 1.25
"""A friction or rotor is named if the unexplained share without it is this multiple of the share with all of them."""

# The clock.
GAP = 1.5
"""Ratio of a step in time to the usual one above which rows are missing, unless jitter explains it."""
JITTER = 0.02
"""Standard deviation of the steps in time, as a fraction of the usual one, from which they are called irregular."""
JUMP = 4.0
"""Step in time, as a multiple of the usual one, from which the clock may have been set forward."""
CONTINUES = 0.2
"""Error of a motion that goes on as if no rows were missing, as a fraction of that over the whole step, up to which the
clock was set forward."""
SEEN = 10.0
"""Smallest displacement over the whole step, as a multiple of the noise, that distinguishes these two cases."""

# The readings.
FAR = 8.0
"""Standard deviations beyond which a measurement among its neighbours is an outlier, and a step in time a gap."""
COARSE = 0.02
"""Allowed error of a local polynomial, as a fraction of the motion among the neighbours."""
FEW_OUTLIERS = 5e-3
"""Fraction of outliers up to which they are only a note."""
FEW_REPEATED = 0.02
"""Fraction of rows that repeat the previous readings, up to which they are not an error."""
AROUND, FAST_TICKS, FEWEST_FAST, HELD_TICKS = 3, 2.0, 40, 0.2
"""Rows around one in which an encoder moves by so many ticks a row, the fewest such rows, and the fraction of them that
repeat the reading before, from which readings are repeated."""
AT_REST = 0.25
"""Repeated readings among the fastest rows, relative to those among all, below which they are ticks between which an
encoder was interpolated."""
HELD_ROWS, HELD_TIMES, ABRUPT = 20, 10.0, 0.75
"""Fewest rows in which a position keeps one value, and their number relative to that for the values beside it, from
which it may be stuck; its motion in the rows beside it relative to that in as many rows farther away, at most 1/2 if
it came from rest."""
STATED_LATTICE = 0.1
"""Largest distance of changes from whole ticks that the model file states, as a fraction of one."""
LEAST_TICK = 1.5
"""Least size of a tick, in standard deviations of the noise: below that the noise hides it."""
ALTERNATES = -0.5
"""Correlation of neighbouring errors of prediction below which they are noise, and not motion between the rows."""
ALTERNATES_WHOLLY = -0.9
"""The same for more than four neighbours, as a multiple of the correlation that white noise has."""
CLEAR = 10.0
"""Ratio of the mean square of accelerations to that of their noise from which they count as more than noise."""

# Jumps of readings that are no motion.
OFF_ZERO = 8.0
"""Jump of a position after which it goes on as before, as a multiple of the usual error, from which its zero may have
moved."""
SUDDEN = 3.0
"""The same as a multiple of the largest step of the motion, from which it has moved whatever the model says."""
FEWEST_WRAPS = 2
"""Fewest jumps of one size that show a period."""
SAME_JUMP = 0.03
"""Relative difference up to which jumps are of one size."""
ALL_JUMPS = 0.9
"""Fraction of the jumps that are of the size of the period; a few are of outliers or across missing rows."""
WHOLE_RANGE = 0.8
"""Least range of readings that wrap, as a fraction of the period: they run from one end to the other."""
BETWEEN_ENDS = 0.1
"""Least fraction of readings that wrap in the middle half of their range."""
MINORITY = 0.02
"""Least fraction of the rows that a second sender has."""
APART = 5.0
"""Least distance between the motions of two senders, as a multiple of the error with which either is predicted."""
ONE_TICK = 0.95
"""Fraction of changes by one tick from which every row is an edge of the encoder."""
EDGE_JITTER = 0.15
"""Least deviation of the steps in time, as a fraction of the usual one, if rows come when a tick changes."""
PLAUSIBLE, PLAUSIBLE_OF_SERVOS = (1e-6, 30.0), (1e-6, 1.0)
"""Steps in time [s] below and above which stamps of a machine that moves, or of servos, are not in seconds."""

WEIGHTLESS = 0.15
"""Largest multiple of the gravity of the model in torques that are called free of it."""
EXPLAINED = 0.02
"""Unexplained share up to which a suspicion about a column needs no other beside it."""
GUESS = np.log(30.0)
"""Logarithm of the largest factor by which a number of the model may be off before it is no guess."""
PLAIN_SCALE = 0.1
"""Relative difference between a fitted scale and a prefix of a unit up to which the prefix is named."""
MOST_ROWS = 10_000
"""Largest number of rows that are compared with the model: the stretch with most motion."""
FEW_ROWS = 4_000
"""The same for suspicions about columns, of which many are tried, and for the check before an estimate."""
