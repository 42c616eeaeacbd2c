"""Suspicions about commands of servos: their units, signs, order and periods."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._columns import COUNTS
from covariant.calibration.diagnosis._finding import quoted_list
from covariant.calibration.diagnosis._servo_errors import JointServos, Prepared, errors
from covariant.calibration.diagnosis._suspicion import Suspicion

UNIT_RATIO = 3.0
"""Ratio of position to command, or its inverse, from which another unit is tried."""


def _commands(factors: np.ndarray, order: np.ndarray | None = None) -> Callable[[Case], Case]:
    """Function that reorders inputs and multiplies them by factors; positions stay the same array, for the cache."""

    def apply(case: Case) -> Case:
        places = np.arange(len(factors)) if order is None else order
        same = {"t": [0], "q": list(range(len(case.names.q)))}
        names = case.names.after({**same, "u": places.tolist()}, {"u": factors})
        return case._replace(names=names, record=case.record._replace(u=np.asarray(case.record.u)[:, places] * factors))

    return apply


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
        line = names.line("u", factors)
        yield Suspicion("unit of a command", where, f"with {where} in {unit}", line, _commands(factors), "servo")


def _command_signs(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names = JointServos.of(case), case.names
    for i in np.flatnonzero(off):
        j = servos.column[i]
        factors = np.where(np.arange(len(names.u)) == j, -1.0, 1.0)
        words = f"with {names.u[j]} with the other sign"
        line = names.line("u", factors)
        yield Suspicion("sign of a command", names.u[j], words, line, _commands(factors), "servo")


def _swapped_commands(case: Case, prepared: Prepared, off: Bool[np.ndarray, "k"]) -> Iterator[Suspicion]:
    servos, names = JointServos.of(case), case.names
    for i, j in itertools.combinations([int(servos.column[i]) for i in np.flatnonzero(off)], 2):
        order = np.arange(len(names.u))
        order[[i, j]] = j, i
        words = f"with {names.u[i]} and {names.u[j]} in each other's place"
        line = f"[columns] u = {quoted_list(names.u[k] for k in order)}"
        change = _commands(np.ones(len(order)), order)
        yield Suspicion("swapped commands", f"{names.u[i]}, {names.u[j]}", words, line, change, "servo")


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
        yield Suspicion("period of a command", names.u[j], words, line, with_inputs(changed), "servo")


def with_inputs(u: np.ndarray) -> Any:
    return lambda case: case._replace(record=case.record._replace(u=u))


COMMANDS = (_command_units, _command_signs, _swapped_commands, _wrapped_commands)
"""Suspicions about columns of commands, in order of preference."""
