"""Suspicions about commands of servos: their units, signs, order and periods."""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._columns import ANGLES, COUNTS, Change, input_signs, swapped_inputs
from covariant.calibration.diagnosis._servo_errors import JointServos, Prepared, errors
from covariant.calibration.diagnosis._suspicion import Suspicion

UNIT_RATIO = 3.0
"""Ratio of position to command, or its inverse, from which another unit is tried."""


def _slope(case: Case, prepared: Prepared, servos: JointServos, i: int) -> float:
    """Regression slope of the position of a servo over its command."""
    error = errors(case, prepared, servos._replace(factors=((),) * len(servos.factors)), i, 0.0)[prepared.rows]
    position = prepared.position[prepared.rows, i]
    command = error + position
    spread = np.var(command)
    return float(np.cov(command, position)[0, 1] / spread) if spread > 0 else 1.0


def _command_units(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands in degrees, turns or ticks: all suspicious ones together, and each alone."""
    servos, names = JointServos.of(case), case.names
    slopes = np.array([_slope(case, prepared, servos, i) for i in range(len(servos.joint))])
    known = {"degrees": np.pi / 180, "turns": 2 * np.pi}
    known |= {f"counts of {count} a turn": 2 * np.pi / count for count in (256, 1024, *COUNTS)}
    off = off & ((slopes < 1 / UNIT_RATIO) | (slopes > UNIT_RATIO)) & (slopes > 0)
    units = [
        min(known, key=lambda unit, s=slope: abs(np.log(known[unit] / s))) if bad else ""
        for slope, bad in zip(slopes, off, strict=True)
    ]
    for chosen in [off] + [np.arange(len(off)) == i for i in np.flatnonzero(off)] * bool(off.sum() > 1):
        if not chosen.any():
            continue
        unit = units[int(np.flatnonzero(chosen)[0])]
        factors = np.ones(len(names.u))
        factors[servos.column[chosen]] = known[unit]
        where = ", ".join(names.u[j] for j in servos.column[chosen])
        line, change = names.line("u", factors), Change.none(case)._replace(inputs=factors)
        yield Suspicion("unit of a command", where, f"with {where} in {unit}", line, change.apply, "servo")


def _angle_units(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Positions and commands alike in degrees or turns, of which the weight of the links tells."""
    names, column, angles = case.names, JointServos.of(case).column, case.names.angles
    for unit in ("degrees", "turns") if off.any() else ():
        position, inputs = np.where(angles, ANGLES[unit], 1.0), np.ones(len(names.u))
        inputs[column] = position[JointServos.of(case).joint]
        change = Change.none(case)._replace(position=position, inputs=inputs)
        words = f"with positions and commands in {unit}"
        line = f"{names.line('q', position)}; {names.line('u', inputs)}"
        yield Suspicion("unit of positions", "", words, line, change.apply, "servo")


def _command_signs(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    return input_signs(case, JointServos.of(case).column[off], "a command", "servo")


def _swapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    for i, j in itertools.combinations(JointServos.of(case).column[off].tolist(), 2):
        yield swapped_inputs(case, i, j, "commands", "servo")


def _wrapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    """Commands and positions that wrap at different angles."""
    servos, names = JointServos.of(case), case.names
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
        apply = lambda case, u=changed: case.with_inputs(u)  # noqa: E731  bound to these inputs
        yield Suspicion("period of a command", names.u[j], words, line, apply, "servo")


COMMANDS = (_command_units, _angle_units, _command_signs, _swapped_commands, _wrapped_commands)
"""Suspicions about columns of commands, in order of preference."""
