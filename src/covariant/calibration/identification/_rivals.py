"""Other readings of logs that would explain them better than a fitted model does: a reversed input, late positions.

Parameters that are fitted to such a log make up for its fault as far as they can, with small standard errors. So the
same fit is tried with each reading: first by the regression of changes of velocity, which costs little, and the best of
those that explain clearly more by predictions too. Of several machines the logs of one may be misread. These are judged
by a fit of that machine alone: a shared number in which it differs from the others is no misreading.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from covariant.calibration._least_squares import robust
from covariant.calibration.identification._contradictions import LEAST_FREE
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
SURE, LIKELY = 3.0, 2.0
"""Standard errors by which another reading must explain the log better, and those of one machine to be tried by
predictions."""
CLEARLY_LESS, LESS = 0.95, 0.8
"""Size of the errors with another reading, over that without, below which it is tried by predictions, and believed."""
AT_ONCE = 100
"""Numbers of the machines whose readings are tried at once: memory grows with the square."""


class Rival(NamedTuple):
    """A reading of a log: the input `column` is reversed, or positions are late by `rows` steps.

    Attributes:
        column: The input that is reversed, or −1.
        rows: Steps by which positions follow the inputs later than the log says; negative for earlier.
        growth: RMS error of predictions of what is held out, with this reading over without it.
        machine: Index of the machine of several whose logs alone are to be read so, or −1.
    """

    column: int
    rows: int
    growth: float = 1.0
    machine: int = -1

    def windows(self, windows: Windows) -> Windows:
        """The windows as this reading has them."""
        inputs, rows = np.array(windows.inputs), np.asarray(windows.rows)
        if self.column >= 0:
            inputs[:, self.column] *= -1.0
        return windows._replace(inputs=inputs, rows=np.clip(rows - self.rows, 0, len(inputs) - 1))


class _Suspect(NamedTuple):
    """A reading that explains changes of velocity clearly better, by how much, and the values (k,) it has there."""

    rival: Rival
    fall: float
    values: Float[np.ndarray, "k"]


def better_reading(family: Family, fitted: Windows, held_out: Windows, best: Fit) -> Rival | None:
    """The reading of all logs, or of those of one machine, that explains them clearly better than a fit does; or None.

    If several do, it is the one that explains most.
    """
    readings = _readings(fitted)
    if not readings:
        return None
    parts = family.parts
    suspects = list(_suspects(family, best.values, fitted, readings, {-1: np.ones(len(fitted.t), bool)}))
    if len(parts) > 1:
        suspects += _suspects_apart(family, best.values, fitted, readings)
    for rival, _, values in sorted(suspects, key=lambda each: -each.fall):
        if rival.machine < 0:
            growth = _growth(family, fitted, held_out, best, rival, values)
        else:
            own = _apart(family, parts[[rival.machine]])
            seen, unseen = (windows.of_machines([rival.machine]) for windows in (fitted, held_out))
            # Of a machine with a single log nothing may be held out.
            unseen = unseen if len(unseen.t) else seen
            growth = _growth(own, seen, unseen, search(own, seen), rival, values)
        if growth < LESS:
            return rival._replace(growth=growth)
    return None


def _readings(windows: Windows) -> list[Rival]:
    """Readings to try, none if no input moves."""
    driven = np.flatnonzero(np.ptp(np.asarray(windows.inputs), axis=0) > 0)
    if not driven.size:
        return []
    t = np.asarray(windows.t)
    steps = np.diff(t, axis=1)
    longest = LONGEST * float(np.max(t[:, -1] - t[:, 0])) / float(np.median(steps[steps > 0]))
    shifts = [Rival(-1, sign * k) for k in SHIFTS if k <= longest for sign in (1, -1)]
    return [Rival(int(j), 0) for j in driven] + shifts


def _apart(family: Family, parts: Int[np.ndarray, "M k"]) -> Family:
    """Family of some machines, by their parts, of which each has all its numbers to itself."""
    names, positive = tuple(family.names[j] for j in parts.flat), tuple(family.positive[j] for j in parts.flat)
    own = np.arange(parts.size).reshape(parts.shape)
    return family._replace(names=names, first=family.first[parts.ravel()], positive=positive, parts=own)


def _suspects_apart(
    family: Family, values: Float[np.ndarray, "p"], windows: Windows, readings: Sequence[Rival]
) -> Iterator[_Suspect]:
    """The best reading for each machine, with all numbers its own, if it explains its changes of velocity clearly
    better; several machines at once, so that one program serves logs of any length."""
    parts = family.parts
    at_once = max(1, AT_ONCE // parts.shape[1])
    for machines in np.split(np.arange(len(parts)), np.arange(at_once, len(parts), at_once)):
        theirs, chosen = windows.of_machines(machines.tolist()), parts[machines]
        groups = {int(m): np.asarray(theirs.machine) == k for k, m in enumerate(machines)}
        groups = {m: group for m, group in groups.items() if np.sum(group) >= parts.shape[1] + LEAST_FREE}
        if not groups:
            continue
        apart = _apart(family, chosen)
        for suspect in _suspects(apart, values[chosen.ravel()], theirs, readings, groups):
            own = apart.parts[suspect.rival.machine - machines[0]]
            yield suspect._replace(values=suspect.values[own])


def _suspects(
    family: Family,
    values: Float[np.ndarray, "p"],
    windows: Windows,
    readings: Sequence[Rival],
    groups: Mapping[int, Bool[np.ndarray, "W"]],
) -> Iterator[_Suspect]:
    """The best reading for the windows of each machine, or −1 for those of all, if it explains their changes of
    velocity clearly better."""
    unknowns = Unknowns.of(family)
    places = np.zeros(len(values)), unknowns.relative(values)

    def regressed(windows: Windows) -> list[Regression]:
        return [regress(unknowns, windows, z, 1) for z in places]

    before, tried = regressed(windows), [(rival, regressed(rival.windows(windows))) for rival in readings]
    for machine, group in groups.items():

        def best(places: list[Regression], group: Bool[np.ndarray, "W"] = group) -> Regression:
            return min((each._replace(errors=each.errors[group]) for each in places), key=lambda each: each.loss)

        now = best(before)
        rival, then = min(((rival, best(each)) for rival, each in tried), key=lambda each: each[1].loss)
        reading = rival._replace(machine=machine)
        losses = [np.sum(np.asarray(robust(each.errors / then.sizes)[0]), axis=(1, 2)) for each in (now, then)]
        least = SURE if reading.machine < 0 else LIKELY
        if _size_ratio(then, now) < CLEARLY_LESS and _is_more(losses[0] - losses[1], reading, least):
            yield _Suspect(reading, now.loss - then.loss, np.asarray(unknowns.values(jnp.asarray(then.z))))


def _growth(
    family: Family, fitted: Windows, held_out: Windows, best: Fit, rival: Rival, start: Float[np.ndarray, "p"]
) -> float:
    """RMS error of predictions of what is held out with a reading, over without it; infinite if that may be chance."""
    other = search(family, rival.windows(fitted), start=start)
    losses = [
        np.mean([window_losses(family, windows, each, weighed) for weighed in (best, other)], axis=0)
        for windows, each in ((fitted, best), (rival.windows(fitted), other))
    ]
    before = family_errors(family, best.values, held_out)
    after = family_errors(family, other.values, rival.windows(held_out))
    return error_growth(before, after) if _is_more(losses[0] - losses[1], rival, SURE) else np.inf


def _size_ratio(then: Regression, now: Regression) -> float:
    """Geometric mean of the sizes of errors over those of others."""
    return float(np.exp(np.mean(np.log(then.sizes / now.sizes))))


def _is_more(falls: Float[np.ndarray, "W"], rival: Rival, least: float) -> bool:
    """Whether the loss falls with a reading by so many standard errors, from how it falls in each window."""
    if np.sum(falls) > least * np.sqrt(len(falls)) * np.std(falls, ddof=1):
        return True
    if rival.machine < 0:
        return False
    from scipy.stats import norm, wilcoxon

    # The windows of one machine are few, so that the largest falls make the standard error as large: ranks do not.
    return bool(wilcoxon(falls, alternative="greater")[1] < norm.sf(least))
