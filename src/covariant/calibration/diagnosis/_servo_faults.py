"""Findings on servos: suspicions about them and their commands, and parameters that the log contradicts.

Commands may be in other units, reversed, wrapped or swapped. A servo may be off, change its gain or its zero during the
log, or reach its torque limit. Each suspicion is judged by the part of the command errors that no parameters explain.
"""

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.calibration.diagnosis._case import Case, long_enough
from covariant.calibration.diagnosis._finding import Finding, Rows
from covariant.calibration.diagnosis._jumps import moved_zeros
from covariant.calibration.diagnosis._servo_commands import COMMANDS
from covariant.calibration.diagnosis._servo_errors import CommandErrors, JointServos, Prepared, joint_name
from covariant.calibration.diagnosis._servo_numbers import servo_numbers
from covariant.calibration.diagnosis._servo_off import lets_go, with_servos, with_strength
from covariant.calibration.diagnosis._suspicion import BLOCKS, Suspicion, choose, compare_all
from covariant.calibration.diagnosis._thresholds import THRESHOLDS

MAX_ACCEPTED = 4
"""Largest number of suspicions that are accepted one after another."""
GAIN_RATIOS = np.exp(np.linspace(np.log(0.2), np.log(5.0), 41))
"""Ratios of the gain after a change to the gain before it that are tried."""
MIN_LIMIT_TO_FRICTION = 2.0
"""Least torque limit of a servo that moves, relative to its dry friction."""
MIN_GAIN_RATIO = 1.15
"""Least ratio of the larger gain to the smaller one that is reported."""
EDGE_BLOCKS = 2
"""Least number of blocks of the log on either side of a change."""


def servo_findings(case: Case) -> tuple[list[Finding], Case]:
    """Findings on the servos of a case, and the case with the accepted suspicions applied."""
    if not long_enough(case, case.file.reference_half):
        return [], case
    judge, findings, done = CommandErrors(), [], set[tuple[str, str]]()
    for _ in range(MAX_ACCEPTED):
        accepted = _best(case, judge, done)
        if accepted is None:
            break
        findings.append(accepted[1])
        done.add((accepted[0].what, accepted[0].where))
        case = accepted[0].apply(case)
    return [*findings, *servo_numbers(case, judge)], case


def _best(case: Case, judge: CommandErrors, done: set[tuple[str, str]]) -> tuple[Suspicion, Finding] | None:
    """The best suspicion: first about all commands, then about one servo at a time, the worst explained servo first."""
    prepared = judge.prepared(case)
    if len(prepared.rows) < 2 * BLOCKS or not prepared.known.any():
        return None
    now = judge(case)
    if now is None:
        return None
    shares = np.where(prepared.known, now.blocks.mean(axis=0), 0.0)
    off = shares > THRESHOLDS["servo"].least
    columns = [each for suspect in COMMANDS for each in suspect(case, prepared, off)]
    accepted = choose(compare_all(case, columns, judge), "errors of commands")
    if accepted is not None:
        return accepted
    for i in np.argsort(-shares):
        if shares[i] > THRESHOLDS["servo change"].least:
            compare = functools.partial(judge.of, int(i))
            tried = (each for suspect in CHANGES for each in suspect(case, judge, int(i)))
            suspicions = [each for each in tried if (each.what, each.where) not in done]
            accepted = choose(compare_all(case, suspicions, compare), "errors of commands")
            if accepted is not None:
                return accepted
    return None


def _edges(prepared: Prepared) -> np.ndarray:
    """Rows at which blocks begin, without those near the ends of the log."""
    return np.unique(np.searchsorted(prepared.blocks, np.arange(EDGE_BLOCKS, BLOCKS - EDGE_BLOCKS + 1)))


def _moved_zero(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A change of the zero of servo i at one time, at which its readings jump."""
    place = JointServos.of(case).joint[i]
    for each in moved_zeros(case, np.asarray(case.record.y), Rows(np.asarray(case.record.t))):
        if each.where == case.names.q[place]:
            size = f"{each.numbers['jump']:.3g} {case.names.units[place]}".rstrip()
            claim = f"the zero of {each.where} moves by {size} at about {each.numbers['begin']:.4g} s"
            yield each._replace(what="zero of a servo", words="then", threshold="servo change", claim=claim)


def _changed_gain(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A change of the gain of servo i at one time, after which all explanations but the constant scale by 1 / gain."""
    prepared, now = judge.prepared(case), judge.fit(case, i)
    rows = prepared.rows
    target = now.left + now.explained[rows]
    friction = (now.explained - prepared.columns[i] @ now.multiples)[rows]
    moving = prepared.moves[rows, i]
    # A wrong delay causes an error proportional to the rate. A gain scales neither that error nor an offset.
    table = np.column_stack([prepared.columns[i][rows], friction, prepared.rate[rows, i]])
    size = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-12)
    table = table / size
    constant = np.ptp(table, axis=0) < 1e-9
    constant[-1] = True
    everything, measured = table.copy(), target.copy()
    table[~moving], target = 0.0, np.where(moving, target, 0.0)
    best: tuple[float, int, float, np.ndarray] | None = None
    for row in _edges(prepared):
        parts = [(table[a].T @ table[a], table[a].T @ target[a]) for a in (slice(None, row), slice(row, None))]
        for gain in GAIN_RATIOS:
            scale = np.where(constant, 1.0, 1 / gain)
            matrix = parts[0][0] + scale[:, None] * parts[1][0] * scale
            vector = parts[0][1] + scale * parts[1][1]
            x = np.linalg.lstsq(matrix, vector, rcond=1e-10)[0]
            left = -float(x @ vector)
            if best is None or left < best[0]:
                best = left, int(row), float(gain), x
    if best is None or best[2] in (GAIN_RATIOS[0], GAIN_RATIOS[-1]) or abs(np.log(best[2])) < np.log(MIN_GAIN_RATIO):
        return
    _, row, gain, x = best
    # A gain changes from one row to the next, so the old gain has to hold just before it and the new one just after.
    parts = (slice(max(row - len(rows) // 6, 0), row), slice(row, row + len(rows) // 6))
    for part, expected in zip(parts, (1.0, 1 / gain), strict=True):
        where = np.flatnonzero(moving[part]) + part.start
        scaled = everything[where][:, ~constant] @ x[~constant]
        rest = measured[where] - everything[where][:, constant] @ x[constant]
        ratio = float(rest @ scaled / max(scaled @ scaled, 1e-300))
        if not abs(np.log(max(ratio, 1e-9) / expected)) < abs(np.log(gain)) / 3:
            return
    log, t, servos = prepared.log, np.asarray(case.record.t), JointServos.of(case)
    time, joint = float(log.t[rows[row]]), case.names.q[servos.joint[i]]
    strength = np.where(t >= time - now.delay, gain, 1.0)
    strength /= np.sqrt(np.mean(strength**2))  # otherwise a small gain would leave small errors
    claim = f"the gain of {joint} from about {time:.4g} s on is {gain:.2g} times that before"
    line = f"until = {time:.4g} keeps the rows before that; those after it, start = {time:.4g}, have "
    line += f"[servo.{joint_name(case, i)}] gain = {gain:.2g}"
    change, numbers = (lambda case: with_strength(case, i, strength)), {"gain": gain, "time": time}
    yield Suspicion("gain of a servo", joint, "then", line, change, "servo change", claim, numbers)


def _saturation(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A limit that the model does not state: beyond some error, the torque does not grow."""
    servos = JointServos.of(case)
    if servos.limited[i]:
        return

    def apply(case: Case) -> Case:
        held: Any = case.model.force
        limit = jnp.asarray(held.servos.limit).at[i].set(servos.stiffness[i])
        return case._replace(model=with_servos(case, replace(held.servos, limit=limit)))

    fit = judge.fit(apply(case), i)
    # A joint with a torque limit near its dry friction would not move.
    if not np.isfinite(fit.level) or fit.level < MIN_LIMIT_TO_FRICTION * fit.friction:
        return
    joint, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    limit = float(servos.stiffness[i] * fit.level)
    claim = f"errors of {joint} beyond about {fit.level:.2g} {unit} give no more torque"
    line = f"[servo.{joint_name(case, i)}] limit = {limit:.2g}"
    numbers = {"limit": limit, "error": fit.level}
    yield Suspicion("limit of a servo", joint, "then", line, apply, "servo", claim, numbers)


CHANGES = (_moved_zero, lets_go, _changed_gain, _saturation)
"""Suspicions about one servo."""
