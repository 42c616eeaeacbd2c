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
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case, averaged
from covariant.calibration.diagnosis._columns import COUNTS, Change
from covariant.calibration.diagnosis._finding import Finding, quoted_list
from covariant.calibration.diagnosis._servo_errors import CommandErrors, Prepared, ServoFit, Servos, errors, settle
from covariant.calibration.diagnosis._suspicion import BLOCKS, Suspicion, choose, compare_all
from covariant.calibration.diagnosis._thresholds import (
    BARELY,
    COMMON_ERRORS,
    COMMON_ROWS,
    DELAY_ERRORS,
    DELAY_ROWS,
    THRESHOLDS,
)
from covariant.signals import Record

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
MOST_OFF = 0.8
"""Largest fraction of the log in which a servo may be off."""
FARTHER, UNLIKE = 1.5, 0.5
"""Error while a servo is off, relative to that while it is on, and relative to the motion of the command."""
EDGE_STEPS, MARGIN = (32, 16, 8, 4, 2, 1), 20
"""Points of the grid by which an edge of a span is moved, and from an end of the log within which none is."""
JUMP = 0.5
"""Part of the change of a zero that shows from one row to the next."""
SPANS = 6
"""Most spans in which a servo may be off."""
FAR = 3.0
"""Factor between a command and the position from which another unit is looked for."""
NUDGE = 1e-3
"""Shift [s] of the differences for slopes with respect to a delay."""
TURNS = 4 * np.pi
"""Range [rad] of a servo's positions beyond which they are in another unit."""


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
            suspicions = [each for suspect in CHANGES for each in suspect(case, judge, int(i))]
            suspicions = [each for each in suspicions if (each.what, each.where) not in done]
            accepted = choose(compare_all(case, suspicions, compare), "errors of commands")
            if accepted is not None:
                return accepted
    return None


def _none(case: Case) -> Change:
    return Change.none(len(case.names.q), len(case.names.u))


def _slope(case: Case, prepared: Prepared, servos: Servos, i: int) -> float:
    """Motion of a servo for a unit of its command."""
    error = errors(case, prepared, servos._replace(switch=-np.ones_like(servos.switch)), i, 0.0)[prepared.rows]
    position = prepared.position[prepared.rows, i]
    command = error + position
    spread = np.var(command)
    return float(np.cov(command, position)[0, 1] / spread) if spread > 0 else 1.0


def _command_units(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands in degrees, turns, ticks or another unit, one or all of them."""
    servos, names, none = Servos.of(case), case.names, _none(case)
    slopes = np.array([_slope(case, prepared, servos, i) for i in range(len(servos.joint))])
    known = {"degrees": np.pi / 180, "turns": 2 * np.pi}
    known |= {f"counts of {count} a turn": 2 * np.pi / count for count in (256, 1024, *COUNTS)}
    off = off & ((slopes < 1 / FAR) | (slopes > FAR)) & (slopes > 0)
    units = [min(known, key=lambda unit, s=slope: abs(np.log(known[unit] / s))) if bad else "" for slope, bad in zip(slopes, off, strict=True)]
    for which in [off] + [np.arange(len(off)) == i for i in np.flatnonzero(off)] * bool(off.sum() > 1):
        if not which.any():
            continue
        unit = units[int(np.flatnonzero(which)[0])]
        factors = np.ones(len(names.u))
        factors[servos.column[which]] = known[unit]
        where = ", ".join(names.u[j] for j in servos.column[which])
        line, change = names.line("u", factors), none._replace(inputs=factors)
        yield Suspicion("unit of a command", where, f"with {where} in {unit}", line, change.apply, "servo")


def _command_signs(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names, none = Servos.of(case), case.names, _none(case)
    for i in np.flatnonzero(off):
        j = servos.column[i]
        factors = np.where(np.arange(len(names.u)) == j, -1.0, 1.0)
        words = f"with {names.u[j]} with the other sign"
        change, line = none._replace(inputs=factors), names.line("u", factors)
        yield Suspicion("sign of a command", names.u[j], words, line, change.apply, "servo")


def _swapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names, none = Servos.of(case), case.names, _none(case)
    for i, j in itertools.combinations([int(servos.column[i]) for i in np.flatnonzero(off)], 2):
        order = np.arange(len(names.u))
        order[[i, j]] = j, i
        words = f"with {names.u[i]} and {names.u[j]} in each other's place"
        line = f"[columns] u = {quoted_list(names.u[k] for k in order)}"
        change = none._replace(input_order=order)
        yield Suspicion("swapped commands", f"{names.u[i]}, {names.u[j]}", words, line, change.apply, "servo")


def _wrapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands and positions that begin anew at different angles."""
    servos, names = Servos.of(case), case.names
    y, u = np.asarray(case.record.y), np.asarray(case.record.u)
    for i in np.flatnonzero(off & ~servos.circle):
        j, q = servos.column[i], servos.joint[i]
        position = servos.gear[i] * y[:, q] + servos.zero[i]
        turns = np.round((u[:, j] - position) / (2 * np.pi))
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
    prepared, now = judge.prepared(case), judge.fit(case, i)
    spans = _spans_off(case, prepared, i, now)
    if not spans:
        return
    log, t, servos = prepared.log, np.asarray(case.record.t), Servos.of(case)
    on = np.ones(len(t))
    # An error acts after the delay, and so does the switch.
    for begin, end in spans:
        on[(t >= log.t[begin] - now.delay) & (t <= log.t[end] - now.delay)] = 0.0
    joint = case.names.q[servos.joint[i]]
    listed = ", ".join(f"{log.t[begin]:.4g} to {log.t[end]:.4g} s" for begin, end in spans)
    to_start, to_end = spans[0][0] <= prepared.rows[0], spans[-1][1] >= prepared.rows[-1]
    line = f"[servo.{_joint(case, i)}] switch = true with a column that is 0 then"
    if len(spans) == 1 and to_end:
        line = f"--until {log.t[spans[0][0]]:.4g}, or {line}"
    elif len(spans) == 1 and to_start:
        line = f"--start {log.t[spans[0][1]]:.4g}, or {line}"
    claim = f"{joint} does not follow its command from {listed}, as if its torque were off"
    numbers = {"off": [[float(log.t[begin]), float(log.t[end])] for begin, end in spans]}
    yield Suspicion(
        "servo off", joint, "then", line, lambda case: _with_strength(case, i, on), "servo change", claim, numbers
    )


def _spans_off(case: Case, prepared: Prepared, i: int, now: ServoFit) -> list[tuple[int, int]]:
    """First and last points of the grid of the spans in which no torque explains more than the error does."""
    log, servos = prepared.log, Servos.of(case)
    error, rows = errors(case, prepared, servos, i, now.delay), prepared.rows
    smoothed = averaged(log, error[:, None])[:, 0]
    best: tuple[float, np.ndarray] | None = None
    # A start from a part of the log in which the servo may be on.
    for part in (None, *np.array_split(np.arange(len(rows)), 3)):
        off = np.zeros(len(log.t), bool) if part is None else np.ones(len(log.t), bool)
        if part is not None:
            off[rows[part[0]] : rows[part[-1]] + 1] = False
        score = np.zeros(len(rows))
        for _ in range(3):
            explained = _explained(prepared, i, error, off, now)
            score = (smoothed - explained)[rows] ** 2 - explained[rows] ** 2
            off = _off(log.t, rows, score)
            if off[rows].mean() > MOST_OFF:
                break
        total = float(score[off[rows]].sum())
        if off.any() and off[rows].mean() < MOST_OFF and (best is None or total > best[0]):
            best = total, off
    if best is None:
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], best[1], [False]])))
    on = error[rows[~best[1][rows]]]

    def follows(begin: int, end: int) -> bool:
        """Whether the position follows a command that moves, or is as near to it as while the servo is on."""
        part, command = error[begin:end], (error + prepared.position[:, i])[begin:end]
        near = np.sqrt(np.mean((part - np.median(on)) ** 2)) < FARTHER * np.std(on)
        return bool(near or np.std(part) < UNLIKE * np.std(command))

    spans = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if not follows(int(a), int(b))]

    def left(edges: np.ndarray) -> float:
        off = np.zeros(len(log.t), bool)
        for begin, end in edges.reshape(-1, 2):
            off[begin:end] = True
        return float(np.mean((np.where(off, 0.0, smoothed) - _explained(prepared, i, error, off, now))[rows] ** 2))

    return [(int(a), int(b) - 1) for a, b in _refined(np.array(spans, int).ravel(), left, len(log.t)).reshape(-1, 2)]


def _refined(edges: np.ndarray, left: Callable[[np.ndarray], float], count: int) -> np.ndarray:
    """Edges of spans, moved one by one as long as less is left; those at an end of the log stay."""
    least = left(edges) if len(edges) else 0.0
    for k, step in itertools.product(range(len(edges)), EDGE_STEPS):
        for tried in (edges + step * (np.arange(len(edges)) == k), edges - step * (np.arange(len(edges)) == k)):
            if MARGIN < edges[k] < count - MARGIN and (np.diff(tried) > 1).all() and 0 < tried[0] and tried[-1] < count:
                now = left(tried)
                edges, least = (tried, now) if now < least else (edges, least)
    return edges


def _explained(prepared: Prepared, i: int, error: np.ndarray, off: np.ndarray, now: ServoFit) -> np.ndarray:
    """What explains the error while the servo is on, fitted to those points, with the friction that the motion has."""
    held = settle(prepared._replace(rows=prepared.rows[~off[prepared.rows]], blocks=prepared.blocks[~off[prepared.rows]]), i, error, now.delay, now.size, now.level)
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
    model = _with_servos(case, replace(servos, commands=commands, switches=switches, delay=delay))
    delays = np.broadcast_to(np.asarray(case.file.input_delay, float), column)
    file = case.file._replace(input_delay=(*delays.tolist(), float(delays[Servos.of(case).column[i]])))
    stated = dict(names.stated)
    if len(stated.get("u", ())) > 1:
        stated["u"] = (*stated["u"], "1")
    names = names._replace(u=(*names.u, f"on_{_joint(case, i)}"), stated=stated)
    return case._replace(file=file, model=model, names=names, record=case.record._replace(u=np.column_stack([u, strength])))


def _with_servos(case: Case, servos: Any) -> Any:
    return eqx.tree_at(lambda each: each.force.servos, case.model, servos)


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
    target = (now.left + now.explained[prepared.rows])
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
    near = log.half + (log.t[prepared.rows[-1]] - log.t[prepared.rows[0]]) / BLOCKS
    place = _jump(t, servos.gear[i] * np.asarray(case.record.y)[:, servos.joint[i]], float(log.t[prepared.rows[row]]), near, -jump)
    if place is None:
        return
    time = float(t[place])
    u = np.asarray(case.record.u).copy()
    u[:, servos.column[i]] -= jump * (t >= time)
    joint, unit = case.names.q[servos.joint[i]], case.names.units[servos.joint[i]]
    claim = f"the zero of {joint} moves by {-jump:.3g} {unit} at about {time:.4g} s"
    line = f"--until {time:.4g}, and --start {time:.4g} for the rest: the parts have other offsets"
    yield Suspicion("zero of a servo", joint, "then", line, _with_inputs(u), "servo change", claim, {"jump": -jump, "time": time})


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
    table[~moving], target = 0.0, np.where(moving, target, 0.0)
    best: tuple[float, int, float] | None = None
    for row in _edges(prepared):
        parts = [(table[a].T @ table[a], table[a].T @ target[a]) for a in (slice(None, row), slice(row, None))]
        for gain in GAINS:
            scale = np.where(constant, 1.0, 1 / gain)
            matrix = parts[0][0] + scale[:, None] * parts[1][0] * scale
            vector = parts[0][1] + scale * parts[1][1]
            x = np.linalg.lstsq(matrix, vector, rcond=1e-10)[0]
            left = -float(x @ vector)
            if best is None or left < best[0]:
                best = left, int(row), float(gain)
    if best is None or best[2] in (GAINS[0], GAINS[-1]) or abs(np.log(best[2])) < np.log(LEAST_GAIN):
        return
    _, row, gain = best
    log, t, servos = prepared.log, np.asarray(case.record.t), Servos.of(case)
    time, joint = float(log.t[rows[row]]), case.names.q[servos.joint[i]]
    strength = np.where(t >= time - now.delay, gain, 1.0)
    strength /= np.sqrt(np.mean(strength**2))  # or else a small gain would leave small errors
    claim = f"the gain of {joint} from about {time:.4g} s on is {gain:.2g} times that before"
    line = f"--until {time:.4g}, and --start {time:.4g} with [servo.{_joint(case, i)}] gain = {gain:.2g} for the rest"
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
    yield Suspicion("limit of a servo", joint, "then", line, apply, "servo", claim, {"limit": limit, "error": fit.level})


COMMANDS = (_command_units, _command_signs, _swapped_commands, _wrapped_commands)
"""Suspicions about columns of commands, in order of preference."""
CHANGES = (_lets_go, _moved_zero, _changed_gain, _saturation)
"""Suspicions about one servo."""


def delays(case: Case, judge: CommandErrors, i: int) -> tuple[float, float, float]:
    """Delay of a command [s], its standard error, and by which fraction the squares fall against the stated one."""
    prepared, servos, fit = judge.prepared(case), Servos.of(case), judge.fit(case, i)
    stated = float(servos.delay[servos.column[i]])
    moving = prepared.moves[prepared.rows, i]
    rows, blocks = prepared.rows[moving], prepared.blocks[moving]

    def left(delay: float, count: int) -> tuple[float, float, float]:
        std = np.inf
        squares = np.inf
        for _ in range(count):
            raw = (np.clip(errors(case, prepared, servos, i, delay + s), -fit.level, fit.level) for s in (0, NUDGE, -NUDGE))
            now, later, earlier = (averaged(prepared.log, each[:, None])[rows, 0] for each in raw)
            friction = averaged(prepared.log, (np.sign(prepared.rate) * prepared.moves)[:, [i]])[rows]
            table = np.column_stack([prepared.columns[i][rows], friction, (earlier - later) / (2 * NUDGE)])
            size = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-12)
            table = table / size
            inverse = np.linalg.pinv(table.T @ table, rcond=1e-10)
            x = inverse @ (table.T @ now)
            rest = now - table @ x
            without = now - table[:, :-1] @ np.linalg.lstsq(table[:, :-1], now, rcond=1e-10)[0]
            squares = float(np.mean(without**2))
            scores = np.array([table[blocks == b].T @ rest[blocks == b] for b in range(BLOCKS)])
            std = float(np.sqrt((inverse @ scores.T @ scores @ inverse)[-1, -1])) / size[-1]
            step = float(x[-1] / size[-1])
            delay += float(np.clip(step, -0.02, 0.02)) if count > 1 else 0.0
        return delay, std, squares

    if len(rows) < 4 * BLOCKS:
        return stated, np.inf, 0.0
    before = left(stated, 1)[2]
    delay, std, after = left(fit.delay, 5)
    return delay, std, 1 - after / before if before > 0 else 0.0


def _numbers(case: Case, judge: CommandErrors) -> list[Finding]:
    return []
