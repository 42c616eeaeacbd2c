"""The suspicion that a servo is off for a while, and cases in which its torque is multiplied by a factor."""

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
from covariant.calibration.diagnosis._servo_errors import (
    CommandErrors,
    JointServos,
    Prepared,
    ServoFit,
    errors,
    fit_servo,
    joint_name,
    settle,
)
from covariant.calibration.diagnosis._smooth import held_inputs
from covariant.calibration.diagnosis._suspicion import BLOCKS, Suspicion

MAX_OFF = 0.7
"""Largest fraction of the log in which a servo may be off."""
MIN_ERROR_RATIO, MIN_ERROR_TO_COMMAND = 1.5, 0.5
"""Least error while a servo is off, relative to the error while it is on, and to the motion of the command."""
FOLLOWING_CORRELATION = 0.7
"""Correlation of a position with its command from which the position follows."""
EDGE_STEPS, END_POINTS = (32, 16, 8, 4, 2, 1), 20
"""Grid points by which an edge of a span is moved in turn, and distance from the ends of the log where edges stay."""
MAX_SPANS = 6
"""Largest number of spans in which a servo may be off."""


def lets_go(case: Case, judge: CommandErrors, i: int) -> Iterator[Suspicion]:
    """Suspect that the torque of servo i is off in parts of the log."""
    prepared = judge.prepared(case)
    spans, delay = _spans_off(case, prepared, i)
    if not spans:
        return
    log, t, servos = prepared.log, np.asarray(case.record.t), JointServos.of(case)
    on = np.ones(len(t))
    # The switch acts after the delay, as a command does.
    for begin, end in spans:
        on[(t >= log.t[begin] - delay) & (t <= log.t[end] - delay)] = 0.0
    joint = case.names.q[servos.joint[i]]
    listed = ", ".join(f"{log.t[begin]:.4g} to {log.t[end]:.4g} s" for begin, end in spans)
    to_start, to_end = spans[0][0] <= prepared.rows[0], spans[-1][1] >= prepared.rows[-1]
    line = f"with [servo.{joint_name(case, i)}] switch = true state a column that is 0 then, on_{joint_name(case, i)}"
    if len(spans) == 1 and to_end:
        line = f"until = {log.t[spans[0][0]]:.4g} keeps the rows before that, or {line}"
    elif len(spans) == 1 and to_start:
        line = f"start = {log.t[spans[0][1]]:.4g} keeps the rows after that, or {line}"
    claim = f"{joint} does not follow its command from {listed}, as if its torque were off"
    numbers = {"off": [[float(log.t[begin]), float(log.t[end])] for begin, end in spans]}
    change = functools.partial(with_strength, i=i, strength=on)
    yield Suspicion("servo off", joint, "then", line, change, "servo change", claim, numbers)


def _spans_off(case: Case, prepared: Prepared, i: int) -> tuple[list[tuple[int, int]], float]:
    """First and last grid points of spans in which the motion needs no torque of servo i, and its delay."""
    log, servos, rows = prepared.log, JointServos.of(case), prepared.rows
    best: tuple[float, np.ndarray, ServoFit] | None = None
    switched = _switched_off(case, prepared, servos, i)

    def left(off: np.ndarray, smoothed: np.ndarray, explained: np.ndarray) -> float:
        return float(np.mean((np.where(off, 0.0, smoothed) - explained)[rows] ** 2))

    # Each of three starts assumes that the servo is on in one third of the log.
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
            if (off | switched)[rows].mean() > MAX_OFF:
                break
        if off.any() and (off | switched)[rows].mean() < MAX_OFF:
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
        """Whether the position follows its command, has errors as while the servo is on, or rests as it does."""
        part, position = error[begin:end], prepared.position[begin:end, i]
        far = float(np.sqrt(np.mean((part - np.median(on)) ** 2)))
        command = part + position
        resting = np.ptp(position) + np.ptp(command) < far / 3
        # Dry friction lets a joint take only a part of small steps.
        spread = np.std(position) * np.std(command)
        alike = np.mean((position - position.mean()) * (command - command.mean())) > FOLLOWING_CORRELATION * spread > 0
        small = far < MIN_ERROR_RATIO * np.std(on) or np.std(part) < MIN_ERROR_TO_COMMAND * np.std(command)
        return bool(resting or alike or small)

    spans = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if not follows(int(a), int(b))]

    def left_with(edges: np.ndarray) -> float:
        off = np.zeros(len(log.t), bool)
        for begin, end in edges.reshape(-1, 2):
            off[begin:end] = True
        return left(off, smoothed, _explained(prepared, i, error, off, now))

    refined = _refined(np.array(spans, int).ravel(), left_with, len(log.t)).reshape(-1, 2)
    return [(int(a), int(b) - 1) for a, b in refined], now.delay


def _switched_off(case: Case, prepared: Prepared, servos: JointServos, i: int) -> Bool[np.ndarray, "K"]:
    """Points (K,) at which the log itself states that servo i is off."""
    off, t, log = np.zeros(len(prepared.log.t), bool), np.asarray(case.record.t), prepared.log
    for place, usual in servos.factors[i]:
        off |= held_inputs(t, np.asarray(case.record.u)[:, [place]], log.t, log.step)[:, 0] < usual / 2
    return off


def _refined(edges: np.ndarray, left: Callable[[np.ndarray], float], count: int) -> np.ndarray:
    """Edges of spans, moved one by one while that leaves less unexplained; edges at an end of the log stay."""
    least = left(edges) if len(edges) else 0.0
    for k, step in itertools.product(range(len(edges)), EDGE_STEPS):
        move = step * (np.arange(len(edges)) == k)
        for tried in (edges + move, edges - move):
            ordered = (np.diff(tried) > 1).all() and tried[0] > 0 and tried[-1] < count
            if ordered and END_POINTS < edges[k] < count - END_POINTS:
                now = left(tried)
                edges, least = (tried, now) if now < least else (edges, least)
    return edges


def _explained(prepared: Prepared, i: int, error: np.ndarray, off: np.ndarray, now: ServoFit) -> np.ndarray:
    """Explained error (K,) from a fit to the points at which the servo is on."""
    on = ~off[prepared.rows]
    part = prepared._replace(rows=prepared.rows[on], blocks=prepared.blocks[on])
    return settle(part, i, error, now.delay, now.size, now.level).explained


def _off(t: np.ndarray, rows: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Points (K,) in the spans with the largest sums of scores."""
    off, left = np.zeros(len(t), bool), score.copy()
    least = 0.02 * np.abs(score).sum()
    for _ in range(MAX_SPANS):
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


def with_strength(case: Case, i: int, strength: np.ndarray) -> Case:
    """The case with a switch of servo i in its model, and factors `strength` on its torque in its log."""
    servos: Any = case.model.force.servos  # pyright: ignore[reportFunctionMemberAccess]
    u, names = np.asarray(case.record.u), case.names
    place, command, name = servos.switches[i], JointServos.of(case).column[i], f"on_{joint_name(case, i)}"
    if place >= 0:
        changed = u.copy()
        changed[:, place] *= strength
        return case.with_inputs(changed)
    column = u.shape[1]
    switches = tuple(column if k == i else each for k, each in enumerate(servos.switches))
    commands = jnp.pad(jnp.asarray(servos.commands), ((0, 0), (0, 1)))
    delay, lead = (jnp.append(jnp.asarray(each), each[command]) for each in (servos.delay, servos.lead))
    named = {"input_names": (*servos.input_names, name), "input_units": (*servos.input_units, "1")}
    model = with_servos(case, replace(servos, commands=commands, switches=switches, delay=delay, lead=lead, **named))
    delays = np.broadcast_to(np.asarray(case.file.input_delay, float), column)
    file = case.file._replace(input_delay=(*delays.tolist(), float(delays[command])))
    stated = dict(names.stated)
    if len(stated.get("u", ())) > 1:
        stated["u"] = (*stated["u"], "1")
    names = names._replace(u=(*names.u, name), stated=stated)
    return case._replace(file=file, model=model, names=names).with_inputs(np.column_stack([u, strength]))


def with_servos(case: Case, servos: Any) -> Any:
    model: Any = case.model
    more = servos.commands.shape[1] - model.force.motors.shape[1]
    force = replace(model.force, servos=servos, motors=jnp.pad(model.force.motors, ((0, 0), (0, more))))
    changed = force, replace(model.dissipation, servos=servos)
    return eqx.tree_at(lambda each: (each.force, each.dissipation), model, changed)
