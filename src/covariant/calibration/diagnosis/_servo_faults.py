"""Suspicions about servos and their commands, and what a log shows of their numbers.

Commands may be in other units, reversed, wrapped or swapped; a servo may let go, change its gain or its zero during the
log, or reach the limit of its torque. All are judged by what no numbers of a servo explain of the errors of commands.
"""

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._servo_commands import COMMANDS, with_inputs
from covariant.calibration.diagnosis._servo_errors import (
    CommandErrors,
    JointServos,
    Prepared,
    joint_name,
)
from covariant.calibration.diagnosis._servo_numbers import servo_numbers
from covariant.calibration.diagnosis._servo_off import lets_go, with_servos, with_strength
from covariant.calibration.diagnosis._suspicion import BLOCKS, Suspicion, choose, compare_all
from covariant.calibration.diagnosis._thresholds import (
    THRESHOLDS,
)

MOST_CHANGES = 4
"""Suspicions that are accepted one after another."""
GAINS = np.exp(np.linspace(np.log(0.2), np.log(5.0), 41))
"""Gains after a change, relative to the gain before, that are tried."""
BEYOND_FRICTION = 2.0
"""Least torque at the limit of a servo, relative to its dry friction."""
LEAST_GAIN = 1.15
"""Least ratio of two gains that counts."""
EDGE = 2
"""Least number of blocks of the log on either side of a change."""
JUMP = 0.5
"""Part of the change of a zero that shows from one row to the next."""


def servo_findings(case: Case) -> tuple[list[Finding], Case]:
    """Findings on the servos of a case, and the case with what is accepted of them."""
    judge, findings, done = CommandErrors(), [], set[tuple[str, str]]()
    for _ in range(MOST_CHANGES):
        accepted = _best(case, judge, done)
        if accepted is None:
            break
        findings.append(accepted[1])
        done.add((accepted[0].what, accepted[0].where))
        case = accepted[0].apply(case)
    return [*findings, *servo_numbers(case, judge)], case


def _best(case: Case, judge: CommandErrors, done: set[tuple[str, str]]) -> tuple[Suspicion, Finding] | None:
    """What explains most: commands of all servos first, then each servo by itself, the one that explains least."""
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
    """Rows at which blocks of time begin, without the first and last ones."""
    begins = np.searchsorted(prepared.blocks, np.arange(EDGE, BLOCKS - EDGE + 1))
    return np.unique(begins)


def _moved_zero(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A zero of the servo that moved once: from then on the error has another constant."""
    prepared, now = judge.prepared(case), judge.fit(case, i)
    fractions = np.arange(2 * BLOCKS) / (2 * BLOCKS)
    rows = np.unique((fractions[2 * EDGE : -2 * EDGE] * len(prepared.rows)).astype(int))
    table = prepared.columns[i][prepared.rows]
    best: tuple[float, int, float] | None = None
    target = now.left + now.explained[prepared.rows]
    size = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-12)
    friction = (now.explained - prepared.columns[i] @ now.multiples)[prepared.rows]
    basis = np.linalg.qr(np.column_stack([table / size, friction / max(np.std(friction), 1e-12)]))[0]
    rest = target - basis @ (basis.T @ target)
    for row in rows:
        step = (np.arange(len(target)) >= row).astype(float)
        step = step - basis @ (basis.T @ step)
        length = float(step @ step)
        if length < 1e-6 * len(target):
            continue
        gain = float(step @ rest) ** 2 / length
        if best is None or gain > best[0]:
            best = gain, int(row), float(step @ rest) / length
    # Within its dry friction a joint may rest anywhere.
    if best is None or abs(best[2]) < now.friction:
        return
    _, row, jump = best
    log, t, servos = prepared.log, np.asarray(case.record.t), JointServos.of(case)
    near = log.half + float(log.t[prepared.rows[-1]] - log.t[prepared.rows[0]]) / BLOCKS
    place = _jump(
        t, servos.gear[i] * np.asarray(case.record.y)[:, servos.joint[i]], float(log.t[prepared.rows[row]]), near, -jump
    )
    if place is None:
        return
    time = float(t[place])
    u = np.asarray(case.record.u).copy()
    u[:, servos.column[i]] -= jump * (t >= time)
    joint, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    claim = f"the zero of {joint} moves by {-jump:.3g} {unit} at about {time:.4g} s"
    line = (
        f"until = {time:.4g} keeps the rows before that, and start = {time:.4g} those after it: fit an offset to each"
    )
    yield Suspicion(
        "zero of a servo", joint, "then", line, with_inputs(u), "servo change", claim, {"jump": -jump, "time": time}
    )


def _jump(t: np.ndarray, position: np.ndarray, about: float, near: float, jump: float) -> int | None:
    """The row from which positions are farther on by a jump than the motion before and after says; or none."""
    seen = np.flatnonzero(np.isfinite(position) & (np.abs(t - about) < near))
    if len(seen) < 4:
        return None
    steps = np.diff(position[seen])
    # The smaller of the steps before and after is that of the motion.
    usual = np.concatenate([steps[:1], (steps[2:] + steps[:-2]) / 2, steps[-1:]])
    best = int(np.argmax((steps - usual) * np.sign(jump)))
    return int(seen[best + 1]) if (steps - usual)[best] * np.sign(jump) > JUMP * abs(jump) else None


def _changed_gain(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A gain that changed once: from then on all but the constant is another multiple of the error."""
    prepared, now = judge.prepared(case), judge.fit(case, i)
    rows = prepared.rows
    target = now.left + now.explained[rows]
    friction = (now.explained - prepared.columns[i] @ now.multiples)[rows]
    moving = prepared.moves[rows, i]
    # A wrong delay is an error proportional to the rate, which no gain changes; nor does it change an offset.
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
        for gain in GAINS:
            scale = np.where(constant, 1.0, 1 / gain)
            matrix = parts[0][0] + scale[:, None] * parts[1][0] * scale
            vector = parts[0][1] + scale * parts[1][1]
            x = np.linalg.lstsq(matrix, vector, rcond=1e-10)[0]
            left = -float(x @ vector)
            if best is None or left < best[0]:
                best = left, int(row), float(gain), x
    if best is None or best[2] in (GAINS[0], GAINS[-1]) or abs(np.log(best[2])) < np.log(LEAST_GAIN):
        return
    _, row, gain, x = best
    # A gain changes from one row to the next: just before it is the former one, and just after it the latter.
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
    strength /= np.sqrt(np.mean(strength**2))  # or else a small gain would leave small errors
    claim = f"the gain of {joint} from about {time:.4g} s on is {gain:.2g} times that before"
    line = f"until = {time:.4g} keeps the rows before that; those after it, start = {time:.4g}, have "
    line += f"[servo.{joint_name(case, i)}] gain = {gain:.2g}"
    yield Suspicion(
        "gain of a servo",
        joint,
        "then",
        line,
        lambda case: with_strength(case, i, strength),
        "servo change",
        claim,
        {"gain": gain, "time": time},
    )


def _saturation(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A servo without a limit whose torque does not grow with large errors."""
    servos = JointServos.of(case)
    if servos.limited[i]:
        return

    def apply(case: Case) -> Case:
        held: Any = case.model.force
        limit = jnp.asarray(held.servos.limit).at[i].set(servos.stiffness[i])
        return case._replace(model=with_servos(case, replace(held.servos, limit=limit)))

    fit = judge.fit(apply(case), i)
    # A joint whose limit is hardly beyond its friction would not move.
    if not np.isfinite(fit.level) or fit.level < BEYOND_FRICTION * fit.friction:
        return
    joint, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    limit = float(servos.stiffness[i] * fit.level)
    claim = f"errors of {joint} beyond about {fit.level:.2g} {unit} give no more torque"
    line = f"[servo.{joint_name(case, i)}] limit = {limit:.2g}"
    yield Suspicion(
        "limit of a servo", joint, "then", line, apply, "servo", claim, {"limit": limit, "error": fit.level}
    )


CHANGES = (_moved_zero, lets_go, _changed_gain, _saturation)
"""Suspicions about one servo."""
