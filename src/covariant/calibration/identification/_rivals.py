"""Other readings of a log that would explain it better than a fitted model does: a reversed input, late positions.

Parameters that are fitted to such a log make up for its fault as far as they can, with small standard errors. So the
same fit is tried with each reading: first by the regression of changes of velocity, which costs little, and the best of
those that explain clearly more by predictions too.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration._least_squares import robust
from covariant.calibration.identification._fit import Fit, search, window_losses
from covariant.calibration.identification._predict import error_growth, family_errors
from covariant.calibration.identification._regression import Regression, regress
from covariant.calibration.identification._unknowns import Unknowns
from covariant.calibration.identification._windows import Windows
from covariant.models import Family

SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Rows by which inputs may act later or earlier than the log says."""
LONGEST = 0.5
"""Longest shift, in lengths of a window."""
SURE = 3.0
"""Standard errors by which another reading must explain the log better."""
CLEARLY_LESS, LESS = 0.95, 0.8
"""Size of the errors with another reading, over that without, below which it is tried by predictions, and believed."""


class Rival(NamedTuple):
    """A reading of a log: the input `column` is reversed, or positions are late by `rows` steps.

    Attributes:
        column: The input that is reversed, or −1.
        rows: Steps by which positions follow the inputs later than the log says; negative for earlier.
        growth: RMS error of predictions of what is held out, with this reading over without it.
    """

    column: int
    rows: int
    growth: float = 1.0

    def windows(self, windows: Windows) -> Windows:
        """The windows as this reading has them."""
        inputs, rows = np.array(windows.inputs), np.asarray(windows.rows)
        if self.column >= 0:
            inputs[:, self.column] *= -1.0
        return windows._replace(inputs=inputs, rows=np.clip(rows - self.rows, 0, len(inputs) - 1))


def better_reading(family: Family, fitted: Windows, held_out: Windows, best: Fit) -> Rival | None:
    """The reading of a log that explains it clearly better than a fit does, or None."""
    inputs = np.asarray(fitted.inputs)
    driven = np.flatnonzero(np.ptp(inputs, axis=0) > 0)
    if not driven.size:
        return None
    unknowns = Unknowns.of(family)
    places = np.zeros(len(best.first)), unknowns.relative(best.values)

    def regressed(windows: Windows) -> Regression:
        return min((regress(unknowns, windows, z, 1) for z in places), key=lambda each: each.loss)

    t = np.asarray(fitted.t)
    steps = np.diff(t, axis=1)
    longest = LONGEST * float(np.max(t[:, -1] - t[:, 0])) / float(np.median(steps[steps > 0]))
    rivals = [Rival(int(j), 0) for j in driven]
    rivals += [Rival(-1, sign * k) for k in SHIFTS if k <= longest for sign in (1, -1)]
    now = regressed(fitted)
    tried = [(rival, regressed(rival.windows(fitted))) for rival in rivals]
    rival, then = min(tried, key=lambda each: each[1].loss)
    if not (_size_ratio(then, now) < CLEARLY_LESS and _standard_errors(now, then) > SURE):
        return None
    values = np.asarray(unknowns.values(jnp.asarray(then.z)))
    other = search(family, rival.windows(fitted), start=values)
    losses = [
        np.mean([window_losses(family, windows, each, weighed) for weighed in (best, other)], axis=0)
        for windows, each in ((fitted, best), (rival.windows(fitted), other))
    ]
    before = family_errors(family, best.values, held_out)
    after = family_errors(family, other.values, rival.windows(held_out))
    growth = error_growth(before, after)
    return rival._replace(growth=growth) if growth < LESS and _signed(losses[0] - losses[1]) > SURE else None


def _size_ratio(then: Regression, now: Regression) -> float:
    """Geometric mean of the sizes of errors over those of others."""
    return float(np.exp(np.mean(np.log(then.sizes / now.sizes))))


def _standard_errors(now: Regression, then: Regression) -> float:
    """Standard errors by which the errors of one regression are larger than those of another."""
    losses = [np.sum(np.asarray(robust(each.errors / then.sizes)[0]), axis=(1, 2)) for each in (now, then)]
    return _signed(losses[0] - losses[1])


def _signed(falls: Float[np.ndarray, "W"]) -> float:
    """A sum of independent terms over its standard error."""
    return float(np.sum(falls) / max(np.sqrt(len(falls)) * np.std(falls, ddof=1), 1e-300))
