"""Inputs of a log of servos: commands that positions follow, switches, and registers that are not torques."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._commands import (
    FOLLOWS,
    FOLLOWS_CLOSELY,
    LATE,
    TORQUES,
    Following,
    follow,
    is_slope,
    pairs,
    pairs_by_name,
)
from covariant.logs import MEANT, unit_in_name, words_of
from scalargraph.errors import InputError

POSITION_WORDS = words_of("action actions leader goal goals target targets pos position positions angle q qpos")
"""Words in the name of a column that mark it as the command of a position."""
UNRELATED_ERROR = 0.9
"""Regression error from which a moving position does not follow a column, even if its name marks a command."""
MAX_MOTORS = 64
"""Largest number of motors in a log with one row per motor."""
MAX_LAG_AMONG_POSITIONS = 0.15
"""Longest lag [s] of a position behind its command, among columns that are all named as positions."""


class Inputs(NamedTuple):
    """The inputs of a log: torques, the command of each position, how positions follow these, switches, and remarks."""

    u: tuple[str, ...]
    commands: tuple[str | None, ...] = ()
    following: tuple[Following | None, ...] = ()
    switches: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def find_inputs(
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    kinds: Mapping[str, str],
    given: Sequence[str] | None,
    clock: Float[np.ndarray, "T"],
    q: Sequence[str],
) -> Inputs:
    """Identify inputs by name and content, with stamps `clock` [s] and the columns of u that the user states."""
    torques = tuple(name for name, kind in kinds.items() if kind == "u")
    if given is not None:
        return _given_inputs(columns, labels, tuple(given), clock, q)
    named = tuple(name for name, kind in kinds.items() if kind == "command")
    switches = tuple(name for name, kind in kinds.items() if kind == "switch")
    paired = pairs(q, named)
    on = _switched_on(columns, switches)
    follow_fits = _follow_all(columns, clock, q, paired, on)
    follows = [each is not None and each.error < FOLLOWS for each in follow_fits]
    # The names may be in another order than the positions, so a pairing that follows far more closely replaces them.
    if not pairs_by_name(q, named) and len(named) == len(q) > 1:
        paired, follow_fits = _by_content(columns, clock, q, named, paired, follow_fits)
        follows = [each is not None and each.error < FOLLOWS for each in follow_fits]
    moving = [each.whole for each in follow_fits if each is not None]
    by_name = any(_is_named_command(labels[each]) for each in named) or bool(switches)
    is_command = any(follows) or (by_name and (not moving or min(moving) < UNRELATED_ERROR))
    plain = tuple(name for name in named if words_of(name) & {"cmd", "command", "commands", "commanded"})
    if torques or not any(paired) or not is_command:
        return _without_commands(columns, clock, q, kinds, torques, plain, paired, follows)
    return Inputs((), paired, follow_fits, switches)


def _given_inputs(
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    given: tuple[str, ...],
    clock: np.ndarray,
    q: Sequence[str],
) -> Inputs:
    """Inputs that the user names: commands if positions follow them or their names say so, otherwise torques."""
    named = [n for n in given if not words_of(n) & TORQUES and not unit_in_name(labels[n], MEANT["u"])]
    paired = pairs(q, named)
    if not any(paired):
        return Inputs(given)
    follow_fits = _follow_all(columns, clock, q, paired)
    by_content = any(each is not None and each.error < FOLLOWS for each in follow_fits)
    if not by_content and not all(_is_named_command(labels[name]) for name in named):
        return Inputs(given)
    return Inputs((), paired, follow_fits, tuple(name for name in given if name not in paired))


def _without_commands(
    columns: Mapping[str, np.ndarray],
    clock: np.ndarray,
    q: Sequence[str],
    kinds: Mapping[str, str],
    torques: tuple[str, ...],
    plain: tuple[str, ...],
    paired: Sequence[str | None],
    follows: Sequence[bool],
) -> Inputs:
    """Torques, or else columns that positions follow closely although their names do not mark them as commands."""
    if any(follows):
        followed = ", ".join(str(name) for name, yes in zip(paired, follows, strict=True) if yes)
        remark = (
            f"positions follow {followed} late, as a servo follows its commands; the torques {', '.join(torques)} are "
            f'the inputs here, name the commands by `columns["u"]` for a model of the servos'
        )
        return Inputs(torques, remarks=(remark,))
    silent = [name for name, kind in kinds.items() if kind in ("", "command") or name in torques]
    silent = [name for name in silent if not words_of(name) & TORQUES]
    best: list[tuple[str, Following]] = []
    for position in q:
        each = [(name, follow(clock, columns[position], columns[name])) for name in silent]
        candidates = [
            (name, follow_fit) for name, follow_fit in each if follow_fit is not None and _is_close(follow_fit)
        ]
        if candidates:
            best.append(min(candidates, key=lambda pair: pair[1].error))
    if len(best) == len(q) == len({name for name, _ in best}):
        switches = tuple(name for name, kind in kinds.items() if kind == "switch")
        return Inputs((), tuple(name for name, _ in best), tuple(follow_fit for _, follow_fit in best), switches)
    named = ", ".join(plain)
    remark = f"{named}: taken for torques [N m], since no position follows them as its command"
    return Inputs((*torques, *plain), remarks=(remark,) if plain else ())


def _is_close(follow_fit: Following) -> bool:
    """Whether a column is a command by content alone: the position follows closely, with a lag and a slope near 1."""
    return (
        follow_fit.error < FOLLOWS_CLOSELY
        and follow_fit.late > LATE
        and follow_fit.lag > 0
        and 0.7 < abs(follow_fit.slope) < 1.3
    )


def _is_named_command(label: str) -> bool:
    words = words_of(label)
    return bool(words & POSITION_WORDS) and bool(
        words - POSITION_WORDS or words & {"action", "actions", "leader", "goal"}
    )


def _switched_on(columns: Mapping[str, np.ndarray], switches: Sequence[str]) -> np.ndarray | None:
    """Rows (T,) in which all servos are switched on; None without switches, or if there is no such row."""
    on = np.all([columns[name] != 0 for name in switches], axis=0) if switches else None
    return on if on is not None and on.any() else None


def _follow_all(
    columns: Mapping[str, np.ndarray],
    clock: np.ndarray,
    q: Sequence[str],
    commands: Sequence[str | None],
    on: np.ndarray | None = None,
) -> tuple[Following | None, ...]:
    return tuple(
        None if command is None else follow(clock, columns[position], columns[command], on)
        for position, command in zip(q, commands, strict=False)
    ) or (None,) * len(q)


def _by_content(
    columns: Mapping[str, np.ndarray],
    clock: np.ndarray,
    q: Sequence[str],
    named: Sequence[str],
    paired: Sequence[str | None],
    follow_fits: Sequence[Following | None],
) -> tuple[tuple[str | None, ...], tuple[Following | None, ...]]:
    """The pairs by name, or a pairing in another order that some position follows far more closely."""
    best: list[tuple[str, Following]] = []
    for position, now in zip(q, follow_fits, strict=True):
        each = [(name, follow(clock, columns[position], columns[name])) for name in named]
        candidates = [(name, follow_fit) for name, follow_fit in each if follow_fit is not None]
        if not candidates or now is None:
            return tuple(paired), tuple(follow_fits)
        best.append(min(candidates, key=lambda pair: pair[1].error))
    if len({name for name, _ in best}) < len(q):
        return tuple(paired), tuple(follow_fits)
    closer = [
        follow_fit.error < now.error / LATE
        for (_, follow_fit), now in zip(best, follow_fits, strict=True)
        if now is not None
    ]
    if not any(closer):
        return tuple(paired), tuple(follow_fits)
    return tuple(name for name, _ in best), tuple(follow_fit for _, follow_fit in best)


def refuse_commands_among(columns: Mapping[str, np.ndarray], clock: np.ndarray, q: Sequence[str]) -> None:
    """Raise `ValueError` if one of two positions follows the other; with more positions the names are unambiguous."""
    if len(q) != 2:
        return
    for name, other in (q, q[::-1]):
        follow_fit = follow(clock, columns[name], columns[other])
        if (
            follow_fit is not None
            and _is_close(follow_fit)
            and follow_fit.lag <= MAX_LAG_AMONG_POSITIONS
            and follow_fit.slope > 0
        ):
            raise InputError(
                f'{name} follows {other}, late, as a servo its command; name them by `columns["q"]` and '
                '`columns["u"]`, or name both as positions by `columns["q"]`'
            )


def without_rates(
    columns: Mapping[str, np.ndarray], clock: np.ndarray, q: tuple[str, ...], inputs: Inputs
) -> tuple[tuple[str, ...], Inputs]:
    """Positions and inputs without entries of a state that are velocities of servos and not positions."""
    driven = [name for name, command in zip(q, inputs.commands, strict=False) if command is not None]
    rates = {
        name
        for name, command in zip(q, inputs.commands, strict=False)
        if command is None and any(is_slope(clock, columns[each], columns[name]) for each in driven)
    }
    remaining = [i for i, name in enumerate(q) if name not in rates]
    if not rates:
        passive = [name for name, command in zip(q, inputs.commands, strict=False) if command is None]
        remark = f"{', '.join(passive)} have no command, and move freely in this draft"
        return q, inputs._replace(remarks=(*inputs.remarks, remark)) if passive and driven else inputs
    return tuple(q[i] for i in remaining), inputs._replace(
        commands=tuple(inputs.commands[i] for i in remaining),
        following=tuple(inputs.following[i] for i in remaining),
        remarks=(*inputs.remarks, f"{', '.join(sorted(rates))} are velocities, and left out"),
    )


def switches_of(names: Sequence[str], positions: Sequence[str], columns: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """The switch of each servo, from columns of 0 and 1; a single such column switches all servos."""
    used = [name for name in names if set(np.unique(columns[name][np.isfinite(columns[name])]).tolist()) == {0.0, 1.0}]
    if len(used) == 1:
        return tuple(used) * len(positions)
    paired = pairs(positions, used)
    return tuple(name for name in paired if name is not None) if None not in paired else ()


def refuse_rows_of_several(columns: Mapping[str, np.ndarray]) -> None:
    """Raise `ValueError` for a log that has one row per motor in place of one column per motor."""
    for name, values in columns.items():
        if not re.fullmatch(r"(?:(?:motor|servo|joint|device|axis|dxl|node|can)_?)?ids?", name, re.IGNORECASE):
            continue
        kinds = np.unique(values[np.isfinite(values)])
        if 1 < len(kinds) <= MAX_MOTORS and np.mean(np.diff(values) != 0) > 0.5:
            raise InputError(
                f"column {name!r} takes turns from row to row, from {kinds[0]:g} to {kinds[-1]:g}: each row is "
                f'of another motor; give each a column, in pandas as table.pivot_table(index="t", columns={name!r})'
            )


def refuse_poses(q: Sequence[str], entries: Mapping[str, str]) -> None:
    """Raise `ValueError` for a state whose entries are a point in space and not joints."""
    if {"x", "y", "z"} <= {entries.get(name, name).lower().rpartition("_")[2] for name in q}:
        named = ", ".join(f"{name} {entries[name]}" for name in q if name in entries)
        raise InputError(f'the state is a pose, and no joints: {named or ", ".join(q)}; name joints by `columns["q"]`')
