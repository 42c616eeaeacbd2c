"""Inputs of a log of servos: commands that positions follow, switches, and registers that are no torques."""

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
    command_unit,
    copied,
    follow,
    pairs,
    pairs_by_name,
)
from covariant.logs import MEANT, unit_factor, unit_in_name, unknown_unit, words_of

EXPLICIT = words_of("action actions leader goal goals target targets pos position positions angle q qpos")
"""Words that, in the name of a command, say that it is one of a position."""
UNRELATED = 0.9
"""Error of a regression from which a position that moves does not follow a command by its name either."""
SOFT = 0.7
"""Least motion for one of a command, at which the mean distance between them is an offset and no sag."""
SHOWN = 1.05
"""How much larger the error must be without a lag, for the lag to count."""
NORMALISED = 100.5
"""Largest number of positions in per cent of their range, which servos of some data sets are logged in."""
MOST_RADIANS = 7.0
"""Largest angle of a servo in radians, a turn and a little."""
LATEST_TWIN = 0.15
"""Longest time [s] by which a position follows its command among columns that are all named as positions."""
MOST_DEGREES = 720.0
"""Largest angle of a servo in degrees."""
TICKS = 4096
"""Numbers of an encoder of 12 bits, as most serial-bus servos have."""
FEWEST_TICKS = 1023
"""Largest number from which whole numbers within `TICKS` are ticks for certain, and not degrees or another encoder."""


class Servo(NamedTuple):
    """What a log tells of the servo of a position.

    Attributes:
        command: Column of its command.
        unit: Size [rad] of one of the command.
        lag: Time [s] by which the position follows; None where it is not seen to.
        offset: What has to be added to the command [rad].

    Example:
        >>> from covariant.calibration.identification import Servo
        >>> Servo("cmd_hip", unit=1.0, lag=0.08, offset=0.0).command
        'cmd_hip'
    """

    command: str
    unit: float
    lag: float | None
    offset: float


class Inputs(NamedTuple):
    """The inputs of a log: columns, whether they are commands, how positions follow these, and remarks."""

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
    """Inputs by name and content; `clock` are the stamps [s], `given` the columns of u that are known."""
    torques = tuple(name for name, kind in kinds.items() if kind == "u")
    if given is not None:
        return _given_inputs(columns, labels, tuple(given), clock, q)
    named = tuple(name for name, kind in kinds.items() if kind == "command")
    switches = tuple(name for name, kind in kinds.items() if kind == "switch")
    paired = pairs(q, named)
    on = _switched_on(columns, switches)
    found = _follow_all(columns, clock, q, paired, on)
    follows = [each is not None and each.error < FOLLOWS for each in found]
    # Names may be in another order than the positions: what follows far more closely counts.
    if not pairs_by_name(q, named) and len(named) == len(q) > 1:
        paired, found = _by_content(columns, clock, q, named, paired, found)
        follows = [each is not None and each.error < FOLLOWS for each in found]
    moving = [each.whole for each in found if each is not None]
    by_name = any(_is_named_command(labels[each]) for each in named) or bool(switches)
    is_command = any(follows) or (by_name and (not moving or min(moving) < UNRELATED))
    plain = tuple(name for name in named if words_of(name) & {"cmd", "command", "commands", "commanded"})
    if torques or not any(paired) or not is_command:
        return _without_commands(columns, clock, q, kinds, torques, plain, paired, follows)
    return Inputs((), paired, found, switches)


def _given_inputs(
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    given: tuple[str, ...],
    clock: np.ndarray,
    q: Sequence[str],
) -> Inputs:
    """Inputs that the user names: commands where positions follow them as such, or their names say so."""
    named = [n for n in given if not words_of(n) & TORQUES and not unit_in_name(labels[n], MEANT["u"])]
    paired = pairs(q, named)
    if not any(paired):
        return Inputs(given)
    found = _follow_all(columns, clock, q, paired)
    by_content = any(each is not None and each.error < FOLLOWS for each in found)
    if not by_content and not all(_is_named_command(labels[name]) for name in named):
        return Inputs(given)
    return Inputs((), paired, found, tuple(name for name in given if name not in paired))


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
    """Torques as inputs, or columns that positions follow closely although their names say nothing of it."""
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
        near = [(name, how) for name, how in each if how is not None and _is_close(how)]
        if near:
            best.append(min(near, key=lambda pair: pair[1].error))
    if len(best) == len(q) == len({name for name, _ in best}):
        switches = tuple(name for name, kind in kinds.items() if kind == "switch")
        return Inputs((), tuple(name for name, _ in best), tuple(how for _, how in best), switches)
    named = ", ".join(plain)
    remark = f"{named}: taken for torques [N m], since no position follows them as its command"
    return Inputs((*torques, *plain), remarks=(remark,) if plain else ())


def _is_close(how: Following) -> bool:
    """Whether a column is a command by content alone: followed closely, late, and by as much as it changes."""
    return how.error < FOLLOWS_CLOSELY and how.late > LATE and how.lag > 0 and 0.7 < abs(how.slope) < 1.3


def _is_named_command(label: str) -> bool:
    words = words_of(label)
    return bool(words & EXPLICIT) and bool(words - EXPLICIT or words & {"action", "actions", "leader", "goal"})


def _switched_on(columns: Mapping[str, np.ndarray], switches: Sequence[str]) -> np.ndarray | None:
    """Rows (T,) in which no servo is switched off; None without switches, or where one is always off."""
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
    found: Sequence[Following | None],
) -> tuple[tuple[str | None, ...], tuple[Following | None, ...]]:
    """The pairs, or those of another order that every position follows far more closely."""
    best: list[tuple[str, Following]] = []
    for position, now in zip(q, found, strict=True):
        each = [(name, follow(clock, columns[position], columns[name])) for name in named]
        near = [(name, how) for name, how in each if how is not None]
        if not near or now is None:
            return tuple(paired), tuple(found)
        best.append(min(near, key=lambda pair: pair[1].error))
    if len({name for name, _ in best}) < len(q):
        return tuple(paired), tuple(found)
    closer = [how.error < now.error / LATE for (_, how), now in zip(best, found, strict=True) if now is not None]
    if not any(closer):
        return tuple(paired), tuple(found)
    return tuple(name for name, _ in best), tuple(how for _, how in best)


def position_units(
    logged: Float[np.ndarray, "T n"], names: Sequence[str], stated: Sequence[str | None], servos: bool
) -> list[str] | None:
    """Units of positions that state none: ticks, or degrees of servos; None where that rule says nothing.

    Raises `ValueError` where the numbers may be in two units.
    """
    open_ones = [i for i, text in enumerate(stated) if text is None]
    values = logged[:, open_ones]
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return None
    largest, whole = float(np.abs(values).max()), bool((values % 1 == 0).all())
    listed = ", ".join(names[i] for i in open_ones)
    answer = "name their unit by `overrides=['units.q=\"turn/4096\"']`, one for each in brackets where they differ"
    if whole and largest > FEWEST_TICKS:
        if values.min() >= 0 and largest < TICKS:
            return [f"turn/{TICKS}" if text is None else text for text in stated]
        raise ValueError(
            f"the positions {listed} are whole numbers from {values.min():g} to {values.max():g}, as ticks; {answer}"
        )
    if not servos or largest <= MOST_RADIANS:
        return None
    if largest > MOST_DEGREES:
        raise ValueError(
            f"the positions {listed} are between {values.min():.4g} and {values.max():.4g}, more than a servo turns in "
            f"degrees; {answer}"
        )
    if whole:
        raise ValueError(
            f"the positions {listed} are whole numbers from {values.min():g} to {values.max():g}: ticks or degrees; "
            f"{answer}"
        )
    if largest <= NORMALISED:
        raise ValueError(
            f"the positions {listed} are between {values.min():.4g} and {values.max():.4g}: degrees, or per cent of "
            "the range of each servo, as LeRobot logs them unless use_degrees is set, which is no angle. Name their "
            "unit by `overrides=['units.q=\"deg\"']`; for -100 to 100 it is a 200th of the range of each joint, as "
            '`overrides=[\'units.q=["1.1 deg", "0.9 deg"]\']` for ranges of 220 and 180 degrees, from the calibration '
            "file of the arm: (range_max - range_min) / 4096 * 360 / 200; of a gripper from 0 to 100 it is a 100th"
        )
    return ["deg" if text is None else text for text in stated]


def servos_of(
    inputs: Inputs,
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    q: Sequence[str],
    q_units: Sequence[str],
) -> tuple[Servo | None, ...]:
    """What the log tells of each servo, with the unit of its command; raises `ValueError` for one that is unclear."""
    servos: list[Servo | None] = []
    for position, text, command, how in zip(q, q_units, inputs.commands, inputs.following, strict=True):
        if command is None:
            servos.append(None)
            continue
        rows = copied(columns[position], columns[command])
        if rows is not None:
            where = "of the same row" if rows == 0 else "of the next row"
            raise ValueError(
                f"column {command!r} is a copy of {position!r} {where}: a log of what was measured, and no command; "
                'name the inputs by `columns["u"]`, or none with []'
            )
        factor, named = unit_factor(text), unit_in_name(labels[command], MEANT["q"])
        odd = unknown_unit(labels[command], MEANT["q"])
        if odd is not None and odd.lower() not in ("tick", "ticks", "count", "counts"):
            raise ValueError(
                f"column {command!r} has {odd!r} in its name, which is no unit of a command; name what one of it is by "
                "`overrides=['units.u=\"deg\"']`"
            )
        close = how is not None and how.error < FOLLOWS
        unit = unit_factor(named) if named else command_unit(how.slope, factor, close) if close and how else factor
        size = 0.0 if how is None else abs(how.slope) * factor
        # A servo does not go beyond its command, be it followed well or not.
        if unit is None or size > 1.5 * abs(unit) or (named and close and size < 0.15 * abs(unit)):
            raise ValueError(
                f"column {command!r}: {position} [{text}] moves by {size:.3g} rad for one of it, which is no unit of a "
                f"command{' in ' + named if named else ''}; name it by `overrides=['units.u=\"deg\"']`, or "
                f"`overrides=['units.u=\"{size:.3g} rad\"']` if so much is meant"
            )
        if how is None or not close:
            servos.append(Servo(command, unit, None, 0.0))
        else:
            # A soft servo sags, and a slow motion shows no lag.
            stiff = SOFT < abs(how.slope * factor / unit) < 2 - SOFT
            offset = how.position * factor - how.command * unit if stiff else 0.0
            servos.append(Servo(command, unit, how.lag if how.late > SHOWN else None, offset))
    return tuple(servos)


def remarks_on(
    inputs: Inputs,
    servos: Sequence[Servo | None],
    columns: Mapping[str, np.ndarray],
    q: Sequence[str],
    factors: Sequence[float],
    entries: Mapping[str, str],
    known: bool,
) -> list[str]:
    """Sentences on commands that may be in another unit or have gaps; `known` says whether the user gave units."""
    remarks = []
    for position, factor, servo, how in zip(q, factors, servos, inputs.following, strict=True):
        if servo is None:
            continue
        gaps = int(np.count_nonzero(~np.isfinite(columns[servo.command])))
        if gaps:
            remarks.append(
                f"{servo.command} is empty in {gaps} rows: hold the last one in the log, in pandas by .ffill()"
            )
        if how is not None and how.error >= FOLLOWS:
            remarks.append(
                f"{position} hardly follows {servo.command}, its command by name: {100 * how.whole:.0f} % of its "
                "motion is another"
            )
        ratio = 1.0 if how is None else abs(how.slope * factor / servo.unit)
        if how is not None and how.error < FOLLOWS_CLOSELY and not 0.9 < ratio < 1.1:
            remarks.append(f"{position} moves by {ratio:.2g} for one of {servo.command}: a soft servo, or another unit")
        name = entries.get(position, position)
        if not known and words_of(name) & {"gripper", "jaw", "finger", "hand", "claw"}:
            remarks.append(f"{name} is taken for an angle; grippers are often logged as a part of their range")
    return remarks


def refuse_commands_among(columns: Mapping[str, np.ndarray], clock: np.ndarray, q: Sequence[str]) -> None:
    """Raise `ValueError` for two positions of which one follows the other; names of more say which are of a kind."""
    if len(q) != 2:
        return
    for name, other in (q, q[::-1]):
        how = follow(clock, columns[name], columns[other])
        if how is not None and _is_close(how) and how.lag <= LATEST_TWIN and how.slope > 0:
            raise ValueError(
                f'{name} follows {other}, late, as a servo its command; name them by `columns["q"]` and '
                '`columns["u"]`, or name both as positions by `columns["q"]`'
            )
