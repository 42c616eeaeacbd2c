"""Inputs of a log of servos: commands that positions follow, switches, and registers that are not torques."""

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from covariant.calibration.identification._commands import LATE, TORQUES, Following, follows, pairs, pairs_by_name
from covariant.calibration.identification._roles import LogColumns
from covariant.logs import words_of
from scalargraph.errors import InputError

POSITION_WORDS = words_of("action actions leader goal goals target targets pos position positions angle q qpos")
"""Words in the name of a column that mark it as the command of a position."""
UNRELATED_ERROR = 0.9
"""Regression error from which a moving position does not follow a column, even if its name marks a command."""
MAX_MOTORS = 64
"""Largest number of motors in a log with one row per motor."""
MAX_LAG_AMONG_POSITIONS = 0.15
"""Longest lag [s] of a position behind its command, among columns that are all named as positions."""


class Drive(NamedTuple):
    """The command of a position, and how it is followed; None where either stands still."""

    command: str
    fit: Following | None


class Inputs(NamedTuple):
    """The inputs of a log: torques, what drives each position by a command, switches, and remarks."""

    u: tuple[str, ...]
    drives: tuple[Drive | None, ...] = ()
    switches: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def named(self) -> tuple[str, ...]:
        """The commands of those positions that have one."""
        return tuple(each.command for each in self.drives if each is not None)


def find_inputs(columns: LogColumns, q: Sequence[str]) -> Inputs:
    """Identify inputs by name and content; those that the user names are commands where positions follow them."""
    given, (named, switches) = columns.given.get("u"), (columns.of("command"), columns.of("switch"))
    if given is not None:
        named = tuple(name for name in given if not words_of(name) & TORQUES and not columns.unit(name, "u"))
        switches = ()
    drives = _drives(columns, q, named, switches)
    # The names may be in another order than the positions, so a pairing that follows far more closely replaces them.
    if given is None and not pairs_by_name(q, named) and len(named) == len(q) > 1:
        drives = _by_content(columns, q, named, drives)
    commands = [each.command for each in drives if each is not None]
    followed = any(each is not None and follows(each.fit) for each in drives)
    if given is not None:
        is_command = commands and (followed or all(_is_named_command(columns.labels[name]) for name in named))
        return (
            Inputs((), drives, tuple(name for name in given if name not in commands)) if is_command else Inputs(given)
        )
    moving = [each.fit.whole for each in drives if each is not None and each.fit is not None]
    by_name = any(_is_named_command(columns.labels[each]) for each in named) or bool(switches)
    is_command = followed or (by_name and (not moving or min(moving) < UNRELATED_ERROR))
    if columns.of("u") or not commands or not is_command:
        return _without_commands(columns, q, drives)
    remarks = tuple(
        f"{name} is a torque beside the command of its position: take both as one column of commands, "
        f"{commands[0]} + {name} / k, with the gain k [N m/rad] of the drive"
        for name in columns.of("feed-forward")
    )
    return Inputs((), drives, switches, remarks)


def _without_commands(columns: LogColumns, q: Sequence[str], drives: Sequence[Drive | None]) -> Inputs:
    """Torques, or else columns that positions follow closely although their names do not mark them as commands."""
    torques, named = (*columns.of("u"), *columns.of("feed-forward")), columns.of("command")
    followed = ", ".join(each.command for each in drives if each is not None and follows(each.fit))
    if followed:
        remark = (
            f"positions follow {followed} late, as a servo follows its commands; the torques {', '.join(torques)} are "
            f'the inputs here, name the commands by `columns["u"]` for a model of the servos'
        )
        return Inputs(torques, remarks=(remark,))
    silent = [name for name, role in columns.roles.items() if role in ("", "command") or name in torques]
    silent = [name for name in silent if not words_of(name) & TORQUES]
    closest = _closest(columns, q, silent, lambda fit: fit.is_close)
    if len({each.command for each in closest}) == len(q):
        return Inputs((), closest, columns.of("switch"))
    plain = tuple(name for name in named if words_of(name) & {"cmd", "command", "commands", "commanded"})
    remark = f"{', '.join(plain)}: taken for torques [N m], since no position follows them as its command"
    return Inputs((*torques, *plain), remarks=(remark,) if plain else ())


def _closest(
    columns: LogColumns, q: Sequence[str], names: Sequence[str], counts: Callable[[Following], bool] = lambda _: True
) -> tuple[Drive, ...]:
    """The column that each position follows most closely, of those positions for which one counts."""
    best: list[Drive] = []
    for position in q:
        fits = [(fit, name) for name in names if (fit := columns.follow(position, name)) is not None and counts(fit)]
        best += [Drive(name, fit) for fit, name in sorted(fits, key=lambda each: each[0].error)[:1]]
    return tuple(best)


def _is_named_command(label: str) -> bool:
    words = words_of(label)
    return bool(words & POSITION_WORDS and (words - POSITION_WORDS or words & {"action", "actions", "leader", "goal"}))


def _drives(
    columns: LogColumns, q: Sequence[str], named: Sequence[str], switches: Sequence[str]
) -> tuple[Drive | None, ...]:
    """The commands of positions by name, and how these follow them while all servos are switched on."""
    on = np.all([columns[name] != 0 for name in switches], axis=0) if switches else None
    on = on if on is not None and on.any() else None
    both = zip(q, pairs(q, named), strict=True)
    return tuple(
        None if command is None else Drive(command, columns.follow(name, command, on)) for name, command in both
    )


def _by_content(
    columns: LogColumns, q: Sequence[str], named: Sequence[str], drives: tuple[Drive | None, ...]
) -> tuple[Drive | None, ...]:
    """The pairs by name, or a pairing in another order that some position follows far more closely."""
    now = [each.fit for each in drives if each is not None and each.fit is not None]
    closest = _closest(columns, q, named) if len(now) == len(q) else ()
    better = any(a.fit.error < b.error / LATE for a, b in zip(closest, now, strict=False) if a.fit is not None)
    return closest if better and len({each.command for each in closest}) == len(q) else drives


def refuse_commands_among(columns: LogColumns, q: Sequence[str]) -> None:
    """Raise `ValueError` if one of two positions follows the other; with more positions the names are unambiguous."""
    for name, other in (q, q[::-1]) if len(q) == 2 else ():
        fit = columns.follow(name, other)
        if fit is not None and fit.is_close and fit.lag <= MAX_LAG_AMONG_POSITIONS and fit.slope > 0:
            raise InputError(
                f'{name} follows {other}, late, as a servo its command; name them by `columns["q"]` and '
                '`columns["u"]`, or name both as positions by `columns["q"]`'
            )


def without_rates(columns: LogColumns, q: tuple[str, ...], inputs: Inputs) -> tuple[tuple[str, ...], Inputs]:
    """Positions and inputs without entries of a state that are velocities of servos and not positions."""
    paired = list(zip(q, inputs.drives, strict=False))
    driven = [name for name, drive in paired if drive is not None]
    passive = [name for name, drive in paired if drive is None]
    rates = [name for name in passive if any(columns.is_slope(each, name) for each in driven)]
    if rates:
        remark = f"{', '.join(sorted(rates))} are velocities, and left out"
        remaining = [i for i, name in enumerate(q) if name not in rates]
        q, inputs = tuple(q[i] for i in remaining), inputs._replace(drives=tuple(inputs.drives[i] for i in remaining))
    else:
        remark = f"{', '.join(passive)} have no command, and move freely in this draft"
    return q, inputs._replace(remarks=(*inputs.remarks, remark)) if passive and driven else inputs


def switches_of(columns: LogColumns, names: Sequence[str], positions: Sequence[str]) -> tuple[str, ...]:
    """The switch of each servo, from columns of 0 and 1; a single such column switches all servos."""
    used = [name for name in names if set(np.unique(columns[name][np.isfinite(columns[name])]).tolist()) == {0.0, 1.0}]
    if len(used) == 1:
        return tuple(used) * len(positions)
    paired = pairs(positions, used)
    return tuple(name for name in paired if name is not None) if None not in paired else ()


def refuse_rows_of_several(columns: LogColumns) -> None:
    """Raise `ValueError` for a log that has one row per motor in place of one column per motor."""
    for name, values in columns.values.items():
        if not re.fullmatch(r"(?:(?:motor|servo|joint|device|axis|dxl|node|can)_?)?ids?", name, re.IGNORECASE):
            continue
        kinds = np.unique(values[np.isfinite(values)])
        if 1 < len(kinds) <= MAX_MOTORS and np.mean(np.diff(values) != 0) > 0.5:
            raise InputError(
                f"column {name!r} takes turns from row to row, from {kinds[0]:g} to {kinds[-1]:g}: each row is "
                f'of another motor; give each a column, in pandas as table.pivot_table(index="t", columns={name!r})'
            )


def refuse_poses(columns: LogColumns, q: Sequence[str]) -> None:
    """Raise `ValueError` for a state whose entries are a point in space and not joints."""
    entries = columns.entries
    if {"x", "y", "z"} <= {entries.get(name, name).lower().rpartition("_")[2] for name in q}:
        named = ", ".join(f"{name} {entries[name]}" for name in q if name in entries)
        raise InputError(f'the state is a pose, and no joints: {named or ", ".join(q)}; name joints by `columns["q"]`')
