"""Findings on servo parameters that the model states and the log contradicts."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.calibration.diagnosis._block_regression import weighted_least_squares
from covariant.calibration.diagnosis._case import Case, averaged
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._servo_errors import CommandErrors, JointServos, errors, joint_name
from covariant.calibration.diagnosis._smooth import held_inputs
from covariant.calibration.diagnosis._suspicion import BLOCKS
from covariant.calibration.diagnosis._thresholds import BARELY, COMMAND_ERRORS, COMMON_GAIN, DELAY_ROWS
from covariant.models import MechanicalSystem, applied_force, resistance
from scalargraph import on_batches

ROUNDS, DELAY_DIFFERENCE, MAX_STEP = 5, 1e-3, 0.02
"""Gauss–Newton steps for a delay, shift [s] of the finite difference for its slope, and the longest step [s]."""
MAX_DELAY = 0.11
"""Longest delay [s] of a command that is reported."""
MIN_OFFSET, MIN_OFFSET_TO_STD = 0.3, 3.0
"""Median command error [rad or m], and its ratio to the standard deviation, from which an offset is reported."""
MIN_UNEXPLAINED, MIN_UNEXPLAINED_RATIO = 0.1, 4.0
"""Fraction of the errors that the stated numbers leave, and its ratio to the best one, that call for a fit."""
WEIGHT_INDEX = 4
"""Index of the weight among the explanations of an error."""
MIN_SAG_TO_RESIDUAL, MIN_SAG_RATIO, MIN_CORRELATION = 3.0, 1.5, 0.5
"""Thresholds of a sag: its ratios to the residual and to that of the model, and its correlation with the weight."""


def delay_of(case: Case, judge: CommandErrors, i: int) -> tuple[float, float, float]:
    """Delay of a command [s], its standard error, and the relative decrease of the squares from the stated delay."""
    prepared, servos, fit = judge.prepared(case), JointServos.of(case), judge.fit(case, i)
    stated = float(servos.delay[servos.column[i]])
    moving = prepared.moves[prepared.rows, i]
    rows = prepared.rows[moving]
    if len(rows) < 4 * BLOCKS:
        return stated, np.inf, 0.0
    friction = averaged(prepared.log, (np.sign(prepared.rate) * prepared.moves)[:, [i]])[rows]
    known = np.column_stack([prepared.columns[i][rows], friction])

    def acting(delay: float) -> np.ndarray:
        error = np.clip(errors(case, prepared, servos, i, delay), -fit.level, fit.level)
        return averaged(prepared.log, error[:, None])[rows, 0]

    def squares(delay: float) -> float:
        now = acting(delay)
        return float(np.sum((now - known @ np.linalg.lstsq(known, now, rcond=1e-10)[0]) ** 2))

    delay, std = fit.delay, np.inf
    for _ in range(ROUNDS):
        slope = (acting(delay - DELAY_DIFFERENCE) - acting(delay + DELAY_DIFFERENCE)) / (2 * DELAY_DIFFERENCE)
        table = np.column_stack([known, slope])[:, None]
        x, cov = weighted_least_squares(acting(delay)[:, None], table, np.eye(1), prepared.blocks[moving])
        std = float(np.sqrt(cov[-1, -1]))
        delay += float(np.clip(x[-1], -MAX_STEP, MAX_STEP))
    before = squares(stated)
    return delay, std, 1 - squares(delay) / before if before > 0 else 0.0


def servo_numbers(case: Case, judge: CommandErrors) -> Iterator[Finding]:
    """Findings on stated delays and offsets, and on parameters that have to be fitted first."""
    now = judge(case)
    if now is None:
        return
    for i in np.flatnonzero(now.known & (now.blocks.mean(axis=0) < BARELY)):
        yield from _delay(case, judge, int(i))
        yield from _offset(case, judge, int(i))
    yield from _first_guesses(case, judge)


def _delay(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A command that acts at another time than the model states, if the motion is fast enough to show it."""
    servos, names = JointServos.of(case), case.names
    stated = float(servos.delay[servos.column[i]])
    delay, std, gain = delay_of(case, judge, i)
    off = delay - stated
    if not (abs(off) > max(DELAY_ROWS * case.spacing, COMMAND_ERRORS * std) and gain > COMMON_GAIN):
        return
    if delay > MAX_DELAY:  # in slow motions damping looks like a long delay
        return
    name, q = names.u[servos.column[i]], names.q[servos.joint[i]]
    rows = f"{abs(off) / case.spacing:.2g} rows {'later' if off > 0 else 'earlier'}"
    evidence = f"{q} follows {name} after {1e3 * delay:.3g} ms ± {1e3 * std:.2g} ms, {rows} than the model says; with "
    evidence += f"that delay the best numbers of the servo leave {100 * (1 - gain):.2g} % of what they leave with the "
    evidence += "stated one"
    line = f"[servo.{joint_name(case, i)}] delay = {delay:.2g}"
    if delay < 0:
        line = f"subtract {-delay:.2g} s from the stamps of {name}: it acts before its row"
    # A delay that is not stated yet is for a fit to estimate. A command never acts before its stamp.
    wrong = bool(stated > 0 or delay < 0)
    yield Finding("delay of a command", q, evidence, line, wrong, {"delay": delay, "std": std, "stated": stated})


def _offset(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A command whose zero is far from that of the position."""
    servos, fit, rows = JointServos.of(case), judge.fit(case, i), judge.prepared(case).rows
    middle = float(np.median(fit.error[rows]))
    if abs(middle) < max(MIN_OFFSET, MIN_OFFSET_TO_STD * float(np.std(fit.error[rows]))) or np.isfinite(fit.level):
        return
    q, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    held: Any = case.model.force
    offset = float(held.servos.offset[i]) - middle
    evidence = f"the command of {q} is {middle:.3g} {unit} from its position all the time"
    line = f"[servo.{joint_name(case, i)}] offset = {offset:.3g}"
    yield Finding("offset of a command", q, evidence, line, False, {"offset": offset})


def _first_guesses(case: Case, judge: CommandErrors) -> Iterator[Finding]:
    """Stated numbers that explain far less than the best ones, and stiffness or offsets that the weight contradicts."""
    prepared, servos = judge.prepared(case), JointServos.of(case)
    file, coordinates = case.file, np.asarray(servos.joint)
    u, t, log = np.asarray(case.record.u), np.asarray(case.record.t), prepared.log
    late = np.broadcast_to(np.asarray(file.input_delay, float), u.shape[1])
    acting = np.column_stack([held_inputs(t + d, u[:, [j]], log.t, log.step)[:, 0] for j, d in enumerate(late)])
    lacking = _lacking(case.model, log.q.shape[1], u.shape[1])(log.q, log.v, log.a, acting)
    poorly_explained = []
    for i in np.flatnonzero(prepared.known):
        fit, rows = judge.fit(case, int(i)), prepared.rows[prepared.moves[prepared.rows, i]]
        if len(rows) < 2 * BLOCKS:
            continue
        error = averaged(log, lacking[:, [coordinates[i]]] / servos.stiffness[i])[rows, 0]
        stated, best = float(np.mean(error**2)) / fit.size, float(np.mean(fit.left**2)) / fit.size
        if stated > max(MIN_UNEXPLAINED, MIN_UNEXPLAINED_RATIO * best):
            poorly_explained.append((case.names.q[servos.joint[i]], joint_name(case, int(i)), stated, best))
        yield from _sag(case, judge, int(i))
    if poorly_explained:
        listed = ", ".join(f"{name} {100 * s:.3g} % and {100 * b:.2g} %" for name, _, s, b in poorly_explained)
        evidence = "of the squares of the errors of commands the numbers of the model leave, and the best ones would: "
        fitted = ",".join(f"servo.{joint}" for _, joint, _, _ in poorly_explained)
        every = len(poorly_explained) == len(servos.joint)
        line = f"covariant fit MODEL LOG --parameters {'servo' if every else fitted}"
        numbers = {name: {"stated": s, "best": b} for name, _, s, b in poorly_explained}
        yield Finding("servo", ", ".join(numbers), evidence + listed, line, False, numbers)


def _sag(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A static error that grows with the weight, but not as the stated stiffness predicts."""
    prepared, servos, fit = judge.prepared(case), JointServos.of(case), judge.fit(case, i)
    table = prepared.columns[i][prepared.rows]
    first = WEIGHT_INDEX
    if table.shape[1] <= first or not np.ptp(table[:, first]) > 0 or not prepared.weighs[i]:
        return
    sag = table[:, first:] @ fit.multiples[first:]
    sag, by_weight = sag - sag.mean(), (table[:, first] - table[:, first].mean()) / servos.stiffness[i]
    ratio = float(sag @ by_weight / (by_weight @ by_weight))
    alike = float(sag @ by_weight) / max(float(np.linalg.norm(sag) * np.linalg.norm(by_weight)), 1e-300)
    rest = max(np.sqrt(prepared.noise[i]), np.std(fit.left))
    if prepared.moves[prepared.rows, i].sum() < 4 * BLOCKS or np.std(sag) < MIN_SAG_TO_RESIDUAL * rest:
        return
    q, unit, joint = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]], joint_name(case, i)
    evidence = f"{q} sags under its weight by {np.std(sag):.2g} {unit} (standard deviation), where the model says "
    evidence += f"{np.std(by_weight):.2g} {unit}"
    if abs(alike) < MIN_CORRELATION:
        line = f"covariant fit MODEL LOG --parameters offsets.{q}"
        evidence += ", and not where its weight is largest"
    elif alike < 0:
        line = f"look at `sign` of [servo.{joint}] and at [parameters] offsets"
        evidence += ", and against its weight"
    elif 1 / MIN_SAG_RATIO < ratio < MIN_SAG_RATIO:
        return
    else:
        line = f"[servo.{joint}] stiffness = {servos.stiffness[i] / ratio:.2g}"
    yield Finding("sag of a servo", q, evidence, line, False, {"ratio": ratio, "alike": alike})


@functools.lru_cache(maxsize=4)
def _lacking(model: MechanicalSystem, n: int, m: int) -> Callable:
    """Function to the torque (n,) that a motion needs in addition to the torque of the model."""

    def at(q, v, a, u):
        t = jnp.zeros(())
        needed = model.space.lower(q, a) + model.space.connection_force(q, v, v)
        return needed - applied_force(model, t, q, u) - resistance(model, t, q, v, u)

    return on_batches(at, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(m))
