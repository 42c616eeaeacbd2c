"""Other readings of logs that would explain them better than a fitted model does: a reversed input, late positions.

Parameters that are fitted to such a log make up for its fault as far as they can, with small standard errors. So the
same fit is tried with each reading: first some steps of it, with the noise of the fit, which is large where a log is
misread, and the best of those that explain clearly more with a search of its own too. Of several machines the logs
of one may be misread. These are judged by a fit of that machine alone: a shared number in which it differs from the
others is no misreading.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from covariant.calibration._least_squares import Fixed, Point, minimise
from covariant.calibration.identification._contradictions import LEAST_FREE
from covariant.calibration.identification._fit import Solved, block_losses, search
from covariant.calibration.identification._likelihood import window_errors
from covariant.calibration.identification._predict import error_growth
from covariant.calibration.identification._rows import Rows
from covariant.models import Family

SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Rows by which inputs may act later or earlier than the log says."""
SURE, LIKELY = 3.0, 2.0
"""Standard errors by which another reading must explain the log better, and those of one machine to be tried by a
search."""
LESS = 0.8
"""Size of the errors with another reading, over that without, below which it is believed."""
STEPS = 2
"""Steps of the search with the noise of the fit."""


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

    def read(self, rows: Rows) -> Rows:
        """The rows as this reading has them."""
        inputs, at = np.array(rows.inputs), np.asarray(rows.rows)
        if self.column >= 0:
            inputs[:, self.column] *= -1.0
        return rows._replace(inputs=inputs, rows=np.clip(at - self.rows, 0, len(inputs) - 1))


class _Suspect(NamedTuple):
    """A reading that explains changes of velocity clearly better, by how much, and the values (k,) it has there."""

    rival: Rival
    fall: float
    values: Float[np.ndarray, "k"]


def better_reading(solved: Solved, rows: Rows, judged: Bool[np.ndarray, "T"], length: float) -> Rival | None:
    """The reading of all logs, or of those of one machine, that explains them clearly better than a fit does; or None.

    If several do, it is the one that explains most. `rows` are all, of which those that are `judged` (T,) are held out,
    and errors are over windows of a `length` [s].
    """
    readings = _readings(rows)
    if not readings:
        return None
    family = solved.family
    seen = rows.only(~judged)
    suspects = list(_suspects(solved, seen, readings, {-1: np.ones(len(rows.machine), bool)}))
    if len(family.parts) > 1:
        machine = np.asarray(rows.machine)
        fewest = family.parts.shape[1] + LEAST_FREE
        groups = {m: machine == m for m in range(len(family.parts)) if np.sum(machine == m) >= fewest}
        suspects += _suspects(_apart(solved), seen, readings, groups)
    for rival, _, values in sorted(suspects, key=lambda each: -each.fall):
        own, at, theirs = solved, np.asarray(judged), rows
        if rival.machine >= 0:
            chosen = rows.of_machine == rival.machine
            at = at & chosen
            # Of a machine with a single log nothing may be held out.
            at = at if at.any() else chosen
            seen_there = _alone(rows.only(chosen & ~judged), rival.machine)
            own = search(_with_parts(family, family.parts[[rival.machine]]), seen_there, least=solved.least)
            theirs = _alone(rows, rival.machine)
        growth = _growth(own, theirs, at, length, rival, values)
        if growth < LESS:
            return rival._replace(growth=growth)
    return None


def _readings(rows: Rows) -> list[Rival]:
    """Readings to try, none if no input moves."""
    driven = np.flatnonzero(np.ptp(np.asarray(rows.inputs), axis=0) > 0)
    if not driven.size:
        return []
    shifts = [Rival(-1, sign * k) for k in SHIFTS if k <= rows.used / 8 for sign in (1, -1)]
    return [Rival(int(j), 0) for j in driven] + shifts


def _with_parts(family: Family, parts: Int[np.ndarray, "M k"]) -> Family:
    """Family of some machines, by their parts, of which each has all its numbers to itself."""
    names, positive = tuple(family.names[j] for j in parts.flat), tuple(family.positive[j] for j in parts.flat)
    own = np.arange(parts.size).reshape(parts.shape)
    return family._replace(names=names, first=family.first[parts.ravel()], positive=positive, parts=own)


def _alone(rows: Rows, machine: int) -> Rows:
    """The rows with the machine as the only one: those of others have no readings."""
    return rows.only(rows.of_machine == machine)._replace(machine=np.zeros(len(rows.machine), int))


def _apart(solved: Solved) -> Solved:
    """The same with all numbers of each machine its own."""
    family = _with_parts(solved.family, solved.family.parts)
    values = solved.fit.values[solved.family.parts.ravel()]
    unknowns = type(solved.problem.unknowns).of(family)
    point = solved.point._replace(z=unknowns.relative(values))
    problem = solved.problem._replace(unknowns=unknowns)
    return solved._replace(family=family, fit=solved.fit._replace(values=values), point=point, problem=problem)


def _suspects(
    solved: Solved, rows: Rows, readings: Sequence[Rival], groups: dict[int, Bool[np.ndarray, "B"]]
) -> Iterator[_Suspect]:
    """The best reading for the blocks of each machine, or −1 for those of all, if it explains them clearly better."""
    places = np.zeros(len(solved.point.z)), solved.point.z

    def regressed(read: Rows) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "p"]]:
        """Losses of the blocks after some steps, and the unknowns there."""
        rows = jax.tree.map(jnp.asarray, read._replace(start=solved.point.blocks.rest.run))
        problem = solved.problem._replace(rows=rows)
        nothing = Fixed.nothing(len(places[0]))
        ends = [minimise(problem, Point.at(problem, z), nothing, most=STEPS) for z in places]
        best = min(ends, key=lambda end: end.loss(nothing))
        return best.blocks.loss, best.z

    (now, _), tried = regressed(rows), [(rival, *regressed(rival.read(rows))) for rival in readings]
    for machine, group in groups.items():
        rival, then, z = min(tried, key=lambda each: float(np.sum(each[1][group])))
        falls = (now - then)[group]
        reading = rival._replace(machine=machine)
        if _is_more(falls, reading, SURE if machine < 0 else LIKELY):
            values = np.asarray(solved.problem.unknowns.values(jnp.asarray(z)))
            part = slice(None) if machine < 0 else solved.family.parts[machine]
            yield _Suspect(reading, float(np.sum(falls)), values[part])


def _growth(
    solved: Solved, rows: Rows, judged: Bool[np.ndarray, "T"], length: float, rival: Rival, start: np.ndarray
) -> float:
    """RMS error of predictions of what is held out with a reading, over without it; infinite if that may be chance."""
    read = rival.read(rows)
    other = search(solved.family, read.only(~judged), start=start, least=solved.least)
    falls = np.mean([block_losses(solved, each) - block_losses(other, each) for each in (solved, other)], axis=0)
    if not _is_more(falls, rival, SURE):
        return np.inf

    def errors(solved: Solved, rows: Rows):
        return window_errors(solved.problem.unknowns, solved.point.z, rows, length, judged)

    return error_growth(errors(solved, rows), errors(other, read))


def _is_more(falls: Float[np.ndarray, "B"], rival: Rival, least: float) -> bool:
    """Whether the loss falls with a reading by so many standard errors, from how it falls in each block."""
    falls = falls[falls != 0]
    if len(falls) < 2:
        return False
    if np.sum(falls) > least * np.sqrt(len(falls)) * np.std(falls, ddof=1):
        return True
    if rival.machine < 0:
        return False
    from scipy.stats import norm, wilcoxon

    # The blocks of one machine are few, so that the largest falls make the standard error as large: ranks do not.
    return bool(wilcoxon(falls, alternative="greater")[1] < norm.sf(least))
