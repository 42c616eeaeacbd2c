"""Units of positions, commands and rates of servos, and the servo that a log shows for each position."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._commands import (
    FEWEST_CHANGES,
    FOLLOWS,
    FOLLOWS_CLOSELY,
    command_unit,
    copied,
)
from covariant.calibration.identification._servo_columns import Inputs
from covariant.logs import KNOWN, MEANT, is_unit_of, unit_factor, unit_in_name, unknown_unit, words_of
from scalargraph.errors import InputError

MIN_STIFF_SLOPE = 0.7
"""Least slope of a position over its command from which their mean distance is an offset and not a sag."""
LAG_ERROR_RATIO = 1.05
"""Ratio of the regression errors without and with a lag from which the lag counts."""
MAX_PER_CENT = 100.5
"""Largest value of positions that are logged in per cent of their range, as in some data sets."""
MAX_RADIANS = 7.0
"""Largest plausible angle of a servo in radians, a little more than a turn."""
MAX_DEGREES = 720.0
"""Largest plausible angle of a servo in degrees."""
TICKS = 4096
"""Ticks per turn of a 12-bit encoder, which most serial-bus servos have."""
CERTAIN_TICKS = 1023
"""Whole numbers below `TICKS` are certainly ticks, and not degrees or another encoder, if the largest exceeds this."""
_UNITS = {1.0: "rad", unit_factor("deg"): "deg", unit_factor("turn/4096"): "turn/4096"}
"""Units of commands that are recognised by their size."""


class DraftedServo(NamedTuple):
    """The servo of a position, as far as a log shows it.

    Attributes:
        command: Column of its command.
        unit: Angle [rad] of one unit of the command.
        lag: Time [s] by which the position lags the command; None if the log shows no lag.
        offset: Angle [rad] to add to the command.

    Example:
        >>> from covariant.calibration.identification import DraftedServo
        >>> DraftedServo("cmd_hip", unit=1.0, lag=0.08, offset=0.0).command
        'cmd_hip'
    """

    command: str
    unit: float
    lag: float | None
    offset: float


def position_units(
    logged: Float[np.ndarray, "T n"], names: Sequence[str], stated: Sequence[str | None], servos: bool
) -> list[str] | None:
    """Units of positions that state none: ticks, or degrees for servos; None if the values decide neither.

    Raises `ValueError` if the values are ambiguous.
    """
    without_unit = [i for i, text in enumerate(stated) if text is None]
    values = logged[:, without_unit]
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return None
    largest, whole = float(np.abs(values).max()), bool((values % 1 == 0).all())
    listed = ", ".join(names[i] for i in without_unit)
    answer = "name their unit by `overrides=['units.q=\"turn/4096\"']`, one for each in brackets where they differ"
    if whole and largest > CERTAIN_TICKS:
        if values.min() >= 0 and largest < TICKS:
            return [f"turn/{TICKS}" if text is None else text for text in stated]
        raise InputError(
            f"the positions {listed} are whole numbers from {values.min():g} to {values.max():g}, as ticks; {answer}"
        )
    if not servos or largest <= MAX_RADIANS:
        return None
    if largest > MAX_DEGREES:
        raise InputError(
            f"the positions {listed} are between {values.min():.4g} and {values.max():.4g}, more than a servo turns in "
            f"degrees; {answer}"
        )
    if whole:
        raise InputError(
            f"the positions {listed} are whole numbers from {values.min():g} to {values.max():g}: ticks or degrees; "
            f"{answer}"
        )
    if largest <= MAX_PER_CENT:
        raise InputError(
            f"the positions {listed} are between {values.min():.4g} and {values.max():.4g}: degrees, or per cent of "
            "the range of each servo, as LeRobot logs them unless use_degrees is set, which is no angle. Name their "
            "unit by `overrides=['units.q=\"deg\"']`; for -100 to 100 it is a 200th of the range of each joint, as "
            '`overrides=[\'units.q=["1.1 deg", "0.9 deg"]\']` for ranges of 220 and 180 degrees, from the calibration '
            "file of the arm: (range_max - range_min) / 4096 * 360 / 200; of a gripper from 0 to 100 it is a 100th"
        )
    return ["deg" if text is None else text for text in stated]


def stated_by_user(field: str, names: Sequence[str], known: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Labels of columns with the units that the user gives for them."""
    texts = known.get(field, ())
    if not texts or not names:
        return {}
    if len(texts) not in (1, len(names)):
        raise InputError(
            f"{len(texts)} units are given for {field}, which has {len(names)} columns ({', '.join(names)})"
        )
    for text in texts:
        if not is_unit_of(text, MEANT["q"] if field == "u" else MEANT[field]) and not is_unit_of(text, MEANT[field]):
            raise InputError(f"unit {text!r} is no unit of {field}; known are {KNOWN[field][0]}, as {KNOWN[field][1]}")
    return {name: f"{name} [{texts[i if len(texts) > 1 else 0]}]" for i, name in enumerate(names)}


def unit_labels(
    columns: Mapping[str, np.ndarray], q: Sequence[str], labels: Mapping[str, str], servos: bool
) -> dict[str, str]:
    """Labels of positions with the unit that their values show; empty if the general rules decide."""
    texts = [unit_in_name(labels[name], MEANT["q"]) for name in q]
    if None not in texts:
        return {}
    units = position_units(np.column_stack([columns[name] for name in q]), q, texts, servos)
    return {} if units is None else {name: f"{name} [{unit}]" for name, unit in zip(q, units, strict=True)}


def servos_of(
    inputs: Inputs,
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    q: Sequence[str],
    q_units: Sequence[str],
) -> tuple[DraftedServo | None, ...]:
    """The servo of each position with the unit of its command; raises `ValueError` for an ambiguous unit."""
    servos: list[DraftedServo | None] = []
    for position, text, command, follow_fit in zip(q, q_units, inputs.commands, inputs.following, strict=True):
        if command is None:
            servos.append(None)
            continue
        rows = copied(columns[position], columns[command])
        if rows is not None:
            where = "of the same row" if rows == 0 else "of the next row"
            raise InputError(
                f"column {command!r} is a copy of {position!r} {where}: a log of what was measured, and no command; "
                'name the inputs by `columns["u"]`, or none with []'
            )
        factor, named = unit_factor(text), unit_in_name(labels[command], MEANT["q"])
        unknown = unknown_unit(labels[command], MEANT["q"])
        if unknown is not None and unknown.lower() not in ("tick", "ticks", "count", "counts"):
            raise InputError(
                f"column {command!r} has {unknown!r} in its name, which is no unit of a command; name what one of it "
                "is by `overrides=['units.u=\"deg\"']`"
            )
        close = follow_fit is not None and follow_fit.error < FOLLOWS
        unit = (
            unit_factor(named)
            if named
            else command_unit(follow_fit.slope, factor, close)
            if close and follow_fit
            else factor
        )
        size = 0.0 if follow_fit is None else abs(follow_fit.slope) * factor
        # A position never moves farther than its command, however well it follows.
        if unit is None or size > 1.5 * abs(unit) or (named and close and size < 0.15 * abs(unit)):
            raise InputError(
                f"column {command!r}: {position} [{text}] moves by {size:.3g} rad for one of it, which is no unit of a "
                f"command{' in ' + named if named else ''}; name it by `overrides=['units.u=\"deg\"']`, or "
                f"`overrides=['units.u=\"{size:.3g} rad\"']` if so much is meant"
            )
        if follow_fit is None or not close:
            servos.append(DraftedServo(command, unit, None, 0.0))
        else:
            # For a soft servo the mean distance may be sag, so it is no offset; a slow motion shows no lag.
            is_stiff = MIN_STIFF_SLOPE < abs(follow_fit.slope * factor / unit) < 2 - MIN_STIFF_SLOPE
            offset = follow_fit.position * factor - follow_fit.command * unit if is_stiff else 0.0
            servos.append(
                DraftedServo(command, unit, follow_fit.lag if follow_fit.late > LAG_ERROR_RATIO else None, offset)
            )
    return tuple(servos)


def units_of_commands(
    servos: Sequence[DraftedServo | None], switches: int, labels: Mapping[str, str], of_positions: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Units of the inputs; empty if all commands are in radians and no name states a unit; a switch has none."""
    texts = []
    for unit, servo in zip(of_positions, servos, strict=True):
        if servo is not None:
            factor = servo.unit / unit_factor(unit)
            text = (
                unit
                if factor == 1
                else f"-1 {unit}"
                if factor == -1
                else _UNITS.get(servo.unit, f"{servo.unit:.6g} rad")
            )
            texts.append(unit_in_name(labels[servo.command], MEANT["q"]) or text)
    in_names = any(unit_in_name(servo.command, MEANT["q"]) for servo in servos if servo is not None)
    plain = all(unit_factor(text) == 1 for text in texts)
    return {} if plain and not in_names else {"u": (*texts, *("1",) * switches)}


def plausible_rates(
    columns: Mapping[str, np.ndarray],
    clock: np.ndarray,
    q: Sequence[str],
    factors: Sequence[float],
    v: tuple[str, ...],
    labels: Mapping[str, str],
) -> tuple[tuple[str, ...], list[str]]:
    """Velocity registers; none, and a remark, if the slopes of the positions contradict their unit."""
    for position, factor, name in zip(q, factors, v, strict=False):
        slope = np.gradient(columns[position], clock) * factor
        unit = unit_factor(unit_in_name(labels[name], MEANT["v"]) or "rad/s")
        valid = np.isfinite(slope) & np.isfinite(columns[name])
        size = float(np.sum(slope[valid] ** 2))
        ratio = float(np.sum(slope[valid] * columns[name][valid])) * unit / size if size else 1.0
        if np.count_nonzero(np.diff(columns[position])) > FEWEST_CHANGES and not 0.4 < ratio < 1.6:
            return (), [
                f"the registers of velocity {', '.join(v)} are left out: {name} is {ratio:.3g} times the slope of "
                f"{position}"
            ]
    return v, []


def remarks_on(
    inputs: Inputs,
    servos: Sequence[DraftedServo | None],
    columns: Mapping[str, np.ndarray],
    q: Sequence[str],
    factors: Sequence[float],
    entries: Mapping[str, str],
    known: bool,
) -> list[str]:
    """Remarks on commands that may be in another unit or have gaps; `known` is true if the user stated units."""
    remarks = []
    for position, factor, servo, follow_fit in zip(q, factors, servos, inputs.following, strict=True):
        if servo is None:
            continue
        gaps = int(np.count_nonzero(~np.isfinite(columns[servo.command])))
        if gaps:
            remarks.append(
                f"{servo.command} is empty in {gaps} rows: hold the last one in the log, in pandas by .ffill()"
            )
        if follow_fit is not None and follow_fit.error >= FOLLOWS:
            remarks.append(
                f"{position} hardly follows {servo.command}, its command by name: {100 * follow_fit.whole:.0f} % of "
                "its motion is another"
            )
        ratio = 1.0 if follow_fit is None else abs(follow_fit.slope * factor / servo.unit)
        if follow_fit is not None and follow_fit.error < FOLLOWS_CLOSELY and not 0.9 < ratio < 1.1:
            remarks.append(f"{position} moves by {ratio:.2g} for one of {servo.command}: a soft servo, or another unit")
        name = entries.get(position, position)
        if not known and words_of(name) & {"gripper", "jaw", "finger", "hand", "claw"}:
            remarks.append(f"{name} is taken for an angle; grippers are often logged as a part of their range")
    return remarks
