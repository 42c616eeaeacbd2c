"""Suspicions about servos and their commands, and what a log shows of their numbers.

Commands may be in other units, reversed, wrapped or swapped; a servo may let go, change its gain or its zero during the
log, or reach the limit of its torque. All are judged by what no numbers of a servo explain of the errors of commands.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from covariant.calibration.diagnosis._case import Case, averaged
from covariant.calibration.diagnosis._columns import COUNTS
from covariant.calibration.diagnosis._finding import Finding, quoted_list
from covariant.calibration.diagnosis._servo_errors import (
    CommandErrors,
    Prepared,
    ServoFit,
    Servos,
    errors,
    fit_servo,
    settle,
)
from covariant.calibration.diagnosis._smooth import held_inputs
from covariant.calibration.diagnosis._suspicion import BLOCKS, Suspicion, choose, compare_all
from covariant.calibration.diagnosis._thresholds import (
    BARELY,
    COMMAND_ERRORS,
    COMMON_GAIN,
    DELAY_ROWS,
    THRESHOLDS,
)
from covariant.lowering import on_batches
from covariant.models import MechanicalSystem, applied_force, resistance

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
MOST_OFF = 0.7
"""Largest fraction of the log in which a servo may be off."""
FARTHER, UNLIKE = 1.5, 0.5
"""Error while a servo is off, relative to that while it is on, and relative to the motion of the command."""
ALIKE = 0.7
"""Correlation of a position with its command from which it follows."""
EDGE_STEPS, MARGIN = (32, 16, 8, 4, 2, 1), 20
"""Points of the grid by which an edge of a span is moved, and from an end of the log within which none is."""
JUMP = 0.5
"""Part of the change of a zero that shows from one row to the next."""
SPANS = 6
"""Most spans in which a servo may be off."""
FAR = 3.0
"""Factor between a command and the position from which another unit is looked for."""
ROUNDS, NUDGE, FARTHEST_STEP = 5, 1e-3, 0.02
"""Steps to a delay, shift [s] of the differences for its slope, and the longest step [s]."""
LONGEST = 0.11
"""Longest delay of a command [s] that is named."""
FAR_OFF, ALWAYS_OFF = 0.3, 3.0
"""Error of a command [rad or m], alone and relative to its changes, from which its zero is said to be another one."""
GUESSED, FIRST = 0.1, 4.0
"""Part of the errors that the stated numbers leave, alone and relative to the best ones, from which a fit is due."""
FIRST_WEIGHT = 4
"""Place of the weight among what explains an error."""
SAGS, SAG_OFF, ASKEW = 3.0, 1.5, 0.5
"""Sag relative to what is left and to that of the model, and its likeness to the weight, from which it is named."""


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
    return [*findings, *_numbers(case, judge)], case


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


def _commands(factors: np.ndarray, order: np.ndarray | None = None) -> Callable[[Case], Case]:
    """Function that multiplies inputs by factors, in another order; the positions stay the same array."""

    def apply(case: Case) -> Case:
        places = np.arange(len(factors)) if order is None else order
        same = {"t": [0], "q": list(range(len(case.names.q)))}
        names = case.names.after({**same, "u": places.tolist()}, {"u": factors})
        return case._replace(names=names, record=case.record._replace(u=np.asarray(case.record.u)[:, places] * factors))

    return apply


def _slope(case: Case, prepared: Prepared, servos: Servos, i: int) -> float:
    """Motion of a servo for a unit of its command."""
    error = errors(case, prepared, servos._replace(factors=((),) * len(servos.factors)), i, 0.0)[prepared.rows]
    position = prepared.position[prepared.rows, i]
    command = error + position
    spread = np.var(command)
    return float(np.cov(command, position)[0, 1] / spread) if spread > 0 else 1.0


def _command_units(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands in degrees, turns, ticks or another unit, one or all of them."""
    servos, names = Servos.of(case), case.names
    slopes = np.array([_slope(case, prepared, servos, i) for i in range(len(servos.joint))])
    known = {"degrees": np.pi / 180, "turns": 2 * np.pi}
    known |= {f"counts of {count} a turn": 2 * np.pi / count for count in (256, 1024, *COUNTS)}
    off = off & ((slopes < 1 / FAR) | (slopes > FAR)) & (slopes > 0)
    units = [
        min(known, key=lambda unit, s=slope: abs(np.log(known[unit] / s))) if bad else ""
        for slope, bad in zip(slopes, off, strict=True)
    ]
    for which in [off] + [np.arange(len(off)) == i for i in np.flatnonzero(off)] * bool(off.sum() > 1):
        if not which.any():
            continue
        unit = units[int(np.flatnonzero(which)[0])]
        factors = np.ones(len(names.u))
        factors[servos.column[which]] = known[unit]
        where = ", ".join(names.u[j] for j in servos.column[which])
        line = names.line("u", factors)
        yield Suspicion("unit of a command", where, f"with {where} in {unit}", line, _commands(factors), "servo")


def _command_signs(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names = Servos.of(case), case.names
    for i in np.flatnonzero(off):
        j = servos.column[i]
        factors = np.where(np.arange(len(names.u)) == j, -1.0, 1.0)
        words = f"with {names.u[j]} with the other sign"
        line = names.line("u", factors)
        yield Suspicion("sign of a command", names.u[j], words, line, _commands(factors), "servo")


def _swapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names = Servos.of(case), case.names
    for i, j in itertools.combinations([int(servos.column[i]) for i in np.flatnonzero(off)], 2):
        order = np.arange(len(names.u))
        order[[i, j]] = j, i
        words = f"with {names.u[i]} and {names.u[j]} in each other's place"
        line = f"[columns] u = {quoted_list(names.u[k] for k in order)}"
        change = _commands(np.ones(len(order)), order)
        yield Suspicion("swapped commands", f"{names.u[i]}, {names.u[j]}", words, line, change, "servo")


def _wrapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands and positions that begin anew at different angles."""
    servos, names = Servos.of(case), case.names
    y, u = np.asarray(case.record.y), np.asarray(case.record.u)
    for i in np.flatnonzero(off & ~servos.circle):
        j, q = servos.column[i], servos.joint[i]
        position = servos.gear[i] * y[:, q] + servos.zero[i]
        error = u[:, j] - position
        turns = np.round((error - np.nanmedian(error)) / (2 * np.pi))
        if not np.nanmax(np.abs(turns)) > 0:
            continue
        changed = u.copy()
        changed[:, j] -= 2 * np.pi * np.nan_to_num(turns)
        words = f"with {names.u[j]} within half a turn of the position"
        line = f"unwrap {names.u[j]} and {names.q[q]} in the log alike: one of them begins anew after a turn"
        yield Suspicion("period of a command", names.u[j], words, line, _with_inputs(changed), "servo")


def _with_inputs(u: np.ndarray) -> Any:
    return lambda case: case._replace(record=case.record._replace(u=u))


def _lets_go(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A servo whose torque is off in parts of the log."""
    prepared = judge.prepared(case)
    spans, delay = _spans_off(case, prepared, i)
    if not spans:
        return
    log, t, servos = prepared.log, np.asarray(case.record.t), Servos.of(case)
    on = np.ones(len(t))
    # An error acts after the delay, and so does the switch.
    for begin, end in spans:
        on[(t >= log.t[begin] - delay) & (t <= log.t[end] - delay)] = 0.0
    joint = case.names.q[servos.joint[i]]
    listed = ", ".join(f"{log.t[begin]:.4g} to {log.t[end]:.4g} s" for begin, end in spans)
    to_start, to_end = spans[0][0] <= prepared.rows[0], spans[-1][1] >= prepared.rows[-1]
    line = f"with [servo.{_joint(case, i)}] switch = true state a column that is 0 then, on_{_joint(case, i)}"
    if len(spans) == 1 and to_end:
        line = f"until = {log.t[spans[0][0]]:.4g} keeps the rows before that, or {line}"
    elif len(spans) == 1 and to_start:
        line = f"start = {log.t[spans[0][1]]:.4g} keeps the rows after that, or {line}"
    claim = f"{joint} does not follow its command from {listed}, as if its torque were off"
    numbers = {"off": [[float(log.t[begin]), float(log.t[end])] for begin, end in spans]}
    yield Suspicion(
        "servo off", joint, "then", line, lambda case: _with_strength(case, i, on), "servo change", claim, numbers
    )


def _spans_off(case: Case, prepared: Prepared, i: int) -> tuple[list[tuple[int, int]], float]:
    """First and last points of the grid of spans in which a motion needs no torque of the servo, and its delay."""
    log, servos, rows = prepared.log, Servos.of(case), prepared.rows
    best: tuple[float, np.ndarray, ServoFit] | None = None
    switched = _switched_off(case, prepared, servos, i)

    def left(off: np.ndarray, smoothed: np.ndarray, explained: np.ndarray) -> float:
        return float(np.mean((np.where(off, 0.0, smoothed) - explained)[rows] ** 2))

    # Each start takes a part of the log for one in which the servo is on.
    for part in np.array_split(np.arange(len(rows)), 3):
        now = fit_servo(case, prepared._replace(rows=rows[part], blocks=np.arange(len(part)) % BLOCKS), servos, i)
        error = errors(case, prepared, servos, i, now.delay)
        smoothed = averaged(log, error[:, None])[:, 0]
        off = np.ones(len(log.t), bool)
        off[rows[part[0]] : rows[part[-1]] + 1] = False
        score = np.zeros(len(rows))
        for _ in range(3):
            explained = _explained(prepared, i, error, off, now)
            score = (smoothed - explained)[rows] ** 2 - explained[rows] ** 2
            off = _off(log.t, rows, score)
            if (off | switched)[rows].mean() > MOST_OFF:
                break
        if off.any() and (off | switched)[rows].mean() < MOST_OFF:
            rest = left(off, smoothed, _explained(prepared, i, error, off, now))
            best = (rest, off, now) if best is None or rest < best[0] else best
    if best is None:
        return [], 0.0
    now = best[2]
    error = errors(case, prepared, servos, i, now.delay)
    smoothed = averaged(log, error[:, None])[:, 0]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], best[1], [False]])))
    on = error[rows[~best[1][rows]]]

    def follows(begin: int, end: int) -> bool:
        """Whether a position follows a command that moves, is as near to it as while the servo is on, or both rest."""
        part, position = error[begin:end], prepared.position[begin:end, i]
        far = float(np.sqrt(np.mean((part - np.median(on)) ** 2)))
        command = part + position
        resting = np.ptp(position) + np.ptp(command) < far / 3
        # Dry friction lets a joint take only a part of small steps.
        spread = np.std(position) * np.std(command)
        alike = spread > 0 and np.mean((position - position.mean()) * (command - command.mean())) > ALIKE * spread
        return bool(resting or alike or far < FARTHER * np.std(on) or np.std(part) < UNLIKE * np.std(command))

    spans = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if not follows(int(a), int(b))]

    def left_with(edges: np.ndarray) -> float:
        off = np.zeros(len(log.t), bool)
        for begin, end in edges.reshape(-1, 2):
            off[begin:end] = True
        return left(off, smoothed, _explained(prepared, i, error, off, now))

    refined = _refined(np.array(spans, int).ravel(), left_with, len(log.t)).reshape(-1, 2)
    return [(int(a), int(b) - 1) for a, b in refined], now.delay


def _switched_off(case: Case, prepared: Prepared, servos: Servos, i: int) -> Bool[np.ndarray, "K"]:
    """Points (K,) at which a servo is off already."""
    off, t, log = np.zeros(len(prepared.log.t), bool), np.asarray(case.record.t), prepared.log
    for place, usual in servos.factors[i]:
        off |= held_inputs(t, np.asarray(case.record.u)[:, [place]], log.t, log.step)[:, 0] < usual / 2
    return off


def _refined(edges: np.ndarray, left: Callable[[np.ndarray], float], count: int) -> np.ndarray:
    """Edges of spans, moved one by one as long as less is left; those at an end of the log stay."""
    least = left(edges) if len(edges) else 0.0
    for k, step in itertools.product(range(len(edges)), EDGE_STEPS):
        for tried in (edges + step * (np.arange(len(edges)) == k), edges - step * (np.arange(len(edges)) == k)):
            if MARGIN < edges[k] < count - MARGIN and (np.diff(tried) > 1).all() and tried[0] > 0 and tried[-1] < count:
                now = left(tried)
                edges, least = (tried, now) if now < least else (edges, least)
    return edges


def _explained(prepared: Prepared, i: int, error: np.ndarray, off: np.ndarray, now: ServoFit) -> np.ndarray:
    """What explains the error while the servo is on, fitted to those points, with the friction that the motion has."""
    held = settle(
        prepared._replace(rows=prepared.rows[~off[prepared.rows]], blocks=prepared.blocks[~off[prepared.rows]]),
        i,
        error,
        now.delay,
        now.size,
        now.level,
    )
    return held.explained


def _off(t: np.ndarray, rows: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Points (K,) in spans whose score is far above zero."""
    off, left = np.zeros(len(t), bool), score.copy()
    least = 0.02 * np.abs(score).sum()
    for _ in range(SPANS):
        sums = np.concatenate([[0.0], np.cumsum(left)])
        lowest = np.minimum.accumulate(sums)
        gains = sums - lowest
        end = int(np.argmax(gains))
        if gains[end] < least or not end:
            break
        begin = int(np.argmin(sums[: end + 1]))
        off[rows[begin] : rows[end - 1] + 1] = True
        left[begin:end] = -np.abs(left[begin:end]).sum()
    return off


def _with_strength(case: Case, i: int, strength: np.ndarray) -> Case:
    """The case whose model has a servo with a switch, and whose log multiplies its torque."""
    servos: Any = case.model.force.servos  # pyright: ignore[reportFunctionMemberAccess]
    u, names = np.asarray(case.record.u), case.names
    place = servos.switches[i]
    if place >= 0:
        changed = u.copy()
        changed[:, place] *= strength
        return case._replace(record=case.record._replace(u=changed))
    column = u.shape[1]
    switches = tuple(column if k == i else each for k, each in enumerate(servos.switches))
    commands = jnp.pad(jnp.asarray(servos.commands), ((0, 0), (0, 1)))
    delay = jnp.append(jnp.asarray(servos.delay), servos.delay[Servos.of(case).column[i]])
    lead = jnp.append(jnp.asarray(servos.lead), servos.lead[Servos.of(case).column[i]])
    names_units = {
        "input_names": (*servos.input_names, f"on_{_joint(case, i)}"),
        "input_units": (*servos.input_units, "1"),
    }
    changed = replace(servos, commands=commands, switches=switches, delay=delay, lead=lead, **names_units)
    model = _with_servos(case, changed)
    delays = np.broadcast_to(np.asarray(case.file.input_delay, float), column)
    file = case.file._replace(input_delay=(*delays.tolist(), float(delays[Servos.of(case).column[i]])))
    stated = dict(names.stated)
    if len(stated.get("u", ())) > 1:
        stated["u"] = (*stated["u"], "1")
    names = names._replace(u=(*names.u, f"on_{_joint(case, i)}"), stated=stated)
    return case._replace(
        file=file, model=model, names=names, record=case.record._replace(u=np.column_stack([u, strength]))
    )


def _with_servos(case: Case, servos: Any) -> Any:
    model: Any = case.model
    more = servos.commands.shape[1] - model.force.motors.shape[1]
    force = replace(model.force, servos=servos, motors=jnp.pad(model.force.motors, ((0, 0), (0, more))))
    changed = force, replace(model.dissipation, servos=servos)
    return eqx.tree_at(lambda each: (each.force, each.dissipation), model, changed)


def _joint(case: Case, i: int) -> str:
    """Name of the joint of a servo."""
    return case.model.coordinates[Servos.of(case).joint[i]]


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
    log, t, servos = prepared.log, np.asarray(case.record.t), Servos.of(case)
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
        "zero of a servo", joint, "then", line, _with_inputs(u), "servo change", claim, {"jump": -jump, "time": time}
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
    log, t, servos = prepared.log, np.asarray(case.record.t), Servos.of(case)
    time, joint = float(log.t[rows[row]]), case.names.q[servos.joint[i]]
    strength = np.where(t >= time - now.delay, gain, 1.0)
    strength /= np.sqrt(np.mean(strength**2))  # or else a small gain would leave small errors
    claim = f"the gain of {joint} from about {time:.4g} s on is {gain:.2g} times that before"
    line = f"until = {time:.4g} keeps the rows before that; those after it, start = {time:.4g}, have "
    line += f"[servo.{_joint(case, i)}] gain = {gain:.2g}"
    yield Suspicion(
        "gain of a servo",
        joint,
        "then",
        line,
        lambda case: _with_strength(case, i, strength),
        "servo change",
        claim,
        {"gain": gain, "time": time},
    )


def _saturation(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """A servo without a limit whose torque does not grow with large errors."""
    servos = Servos.of(case)
    if servos.limited[i]:
        return

    def apply(case: Case) -> Case:
        held: Any = case.model.force
        limit = jnp.asarray(held.servos.limit).at[i].set(servos.stiffness[i])
        return case._replace(model=_with_servos(case, replace(held.servos, limit=limit)))

    fit = judge.fit(apply(case), i)
    # A joint whose limit is hardly beyond its friction would not move.
    if not np.isfinite(fit.level) or fit.level < BEYOND_FRICTION * fit.friction:
        return
    joint, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    limit = float(servos.stiffness[i] * fit.level)
    claim = f"errors of {joint} beyond about {fit.level:.2g} {unit} give no more torque"
    line = f"[servo.{_joint(case, i)}] limit = {limit:.2g}"
    yield Suspicion(
        "limit of a servo", joint, "then", line, apply, "servo", claim, {"limit": limit, "error": fit.level}
    )


COMMANDS = (_command_units, _command_signs, _swapped_commands, _wrapped_commands)
"""Suspicions about columns of commands, in order of preference."""
CHANGES = (_moved_zero, _lets_go, _changed_gain, _saturation)
"""Suspicions about one servo."""


def delay_of(case: Case, judge: CommandErrors, i: int) -> tuple[float, float, float]:
    """Delay of a command [s], its standard error, and by which fraction the squares fall against the stated one."""
    prepared, servos, fit = judge.prepared(case), Servos.of(case), judge.fit(case, i)
    stated = float(servos.delay[servos.column[i]])
    moving = prepared.moves[prepared.rows, i]
    rows, blocks = prepared.rows[moving], prepared.blocks[moving]
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
        table = np.column_stack([known, (acting(delay - NUDGE) - acting(delay + NUDGE)) / (2 * NUDGE)])
        size, now = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-12), acting(delay)
        table = table / size
        inverse = np.linalg.pinv(table.T @ table, rcond=1e-10)
        x = inverse @ (table.T @ now)
        scores = np.array([table[blocks == b].T @ (now - table @ x)[blocks == b] for b in range(BLOCKS)])
        std = float(np.sqrt((inverse @ scores.T @ scores @ inverse)[-1, -1])) / size[-1]
        delay += float(np.clip(x[-1] / size[-1], -FARTHEST_STEP, FARTHEST_STEP))
    before = squares(stated)
    return delay, std, 1 - squares(delay) / before if before > 0 else 0.0


def _numbers(case: Case, judge: CommandErrors) -> Iterator[Finding]:
    """What the log says of numbers that the model states: delays, and what a fit has to find first."""
    now = judge(case)
    if now is None:
        return
    for i in np.flatnonzero(now.known & (now.blocks.mean(axis=0) < BARELY)):
        yield from _delay(case, judge, int(i))
        yield from _offset(case, judge, int(i))
    yield from _first_guesses(case, judge)


def _delay(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A command that acts at another time than the model says, where the motion is fast enough to tell."""
    servos, names = Servos.of(case), case.names
    stated = float(servos.delay[servos.column[i]])
    delay, std, gain = delay_of(case, judge, i)
    off = delay - stated
    if not (abs(off) > max(DELAY_ROWS * case.spacing, COMMAND_ERRORS * std) and gain > COMMON_GAIN):
        return
    if delay > LONGEST:  # in slow motions damping looks like a long delay
        return
    name, q = names.u[servos.column[i]], names.q[servos.joint[i]]
    evidence = f"{q} follows {name} after {1e3 * delay:.3g} ms ± {1e3 * std:.2g} ms, "
    evidence += (
        f"{abs(off) / case.spacing:.2g} rows {'later' if off > 0 else 'earlier'} than the model says; with that "
    )
    evidence += (
        f"delay the best numbers of the servo leave {100 * (1 - gain):.2g} % of what they leave with the stated one"
    )
    line = f"[servo.{_joint(case, i)}] delay = {delay:.2g}"
    if delay < 0:
        line = f"subtract {-delay:.2g} s from the stamps of {name}: it acts before its row"
    # A delay that nobody stated yet is what a fit looks for; a command never acts before its stamp.
    wrong = bool(stated > 0 or delay < 0)
    yield Finding("delay of a command", q, evidence, line, wrong, {"delay": delay, "std": std, "stated": stated})


def _offset(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A command that counts from far another zero than the position."""
    servos, fit, rows = Servos.of(case), judge.fit(case, i), judge.prepared(case).rows
    middle = float(np.median(fit.error[rows]))
    if abs(middle) < max(FAR_OFF, ALWAYS_OFF * float(np.std(fit.error[rows]))) or np.isfinite(fit.level):
        return
    q, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    held: Any = case.model.force
    offset = float(held.servos.offset[i]) - middle
    evidence = f"the command of {q} is {middle:.3g} {unit} from its position all the time"
    line = f"[servo.{_joint(case, i)}] offset = {offset:.3g}"
    yield Finding("offset of a command", q, evidence, line, False, {"offset": offset})


def _first_guesses(case: Case, judge: CommandErrors) -> Iterator[Finding]:
    """Numbers of servos that explain less than others would, and stiffness or offsets that the weight contradicts."""
    prepared, servos = judge.prepared(case), Servos.of(case)
    file, coordinates = case.file, np.asarray(servos.joint)
    u, t, log = np.asarray(case.record.u), np.asarray(case.record.t), prepared.log
    late = np.broadcast_to(np.asarray(file.input_delay, float), u.shape[1])
    acting = np.column_stack([held_inputs(t + d, u[:, [j]], log.t, log.step)[:, 0] for j, d in enumerate(late)])
    lacking = _lacking(case.model, log.q.shape[1], u.shape[1])(log.q, log.v, log.a, acting)
    few = []
    for i in np.flatnonzero(prepared.known):
        fit, rows = judge.fit(case, int(i)), prepared.rows[prepared.moves[prepared.rows, i]]
        if len(rows) < 2 * BLOCKS:
            continue
        error = averaged(log, lacking[:, [coordinates[i]]] / servos.stiffness[i])[rows, 0]
        stated, best = float(np.mean(error**2)) / fit.size, float(np.mean(fit.left**2)) / fit.size
        if stated > max(GUESSED, FIRST * best):
            few.append((case.names.q[servos.joint[i]], _joint(case, int(i)), stated, best))
        yield from _sag(case, judge, int(i))
    if few:
        listed = ", ".join(f"{name} {100 * s:.3g} % and {100 * b:.2g} %" for name, _, s, b in few)
        evidence = "of the squares of the errors of commands the numbers of the model leave, and the best ones would: "
        line = f"covariant fit MODEL LOG --parameters {','.join(f'servo.{joint}' for _, joint, _, _ in few)}"
        if len(few) == len(servos.joint):
            line = "covariant fit MODEL LOG --parameters servo"
        numbers = {name: {"stated": s, "best": b} for name, _, s, b in few}
        yield Finding("servo", ", ".join(name for name, *_ in few), evidence + listed, line, False, numbers)


def _sag(case: Case, judge: CommandErrors, i: int) -> Iterator[Finding]:
    """A static error that grows with the weight otherwise than by the stated stiffness."""
    prepared, servos, fit = judge.prepared(case), Servos.of(case), judge.fit(case, i)
    table = prepared.columns[i][prepared.rows]
    first = FIRST_WEIGHT
    if table.shape[1] <= first or not np.ptp(table[:, first]) > 0 or not prepared.weighs[i]:
        return
    sag = table[:, first:] @ fit.multiples[first:]
    sag, by_weight = sag - sag.mean(), (table[:, first] - table[:, first].mean()) / servos.stiffness[i]
    ratio = float(sag @ by_weight / (by_weight @ by_weight))
    alike = float(sag @ by_weight) / max(float(np.linalg.norm(sag) * np.linalg.norm(by_weight)), 1e-300)
    if prepared.moves[prepared.rows, i].sum() < 4 * BLOCKS or np.std(sag) < SAGS * max(
        np.sqrt(prepared.noise[i]), np.std(fit.left)
    ):
        return
    q, unit, joint = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]], _joint(case, i)
    evidence = f"{q} sags under its weight by {np.std(sag):.2g} {unit} (standard deviation), where the model says "
    evidence += f"{np.std(by_weight):.2g} {unit}"
    if abs(alike) < ASKEW:
        line = f"covariant fit MODEL LOG --parameters offsets.{q}"
        evidence += ", and not where its weight is largest"
    elif alike < 0:
        line = f"look at `sign` of [servo.{joint}] and at [parameters] offsets"
        evidence += ", and against its weight"
    elif 1 / SAG_OFF < ratio < SAG_OFF:
        return
    else:
        line = f"[servo.{joint}] stiffness = {servos.stiffness[i] / ratio:.2g}"
    yield Finding("sag of a servo", q, evidence, line, False, {"ratio": ratio, "alike": alike})


@functools.lru_cache(maxsize=4)
def _lacking(model: MechanicalSystem, n: int, m: int) -> Callable:
    """Torque (n,) that a motion needs beyond what the model says."""

    def at(q, v, a, u):
        t = jnp.zeros(())
        needed = model.space.lower(q, a) + model.space.connection_force(q, v, v)
        return needed - applied_force(model, t, q, u) - resistance(model, t, q, v, u)

    return on_batches(at, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(m))
