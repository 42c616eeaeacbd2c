"""Units of positions, commands and rates of servos, and the servo that a log shows for each position."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._commands import FOLLOWS, FOLLOWS_CLOSELY, Following, copied, follows
from covariant.calibration.identification._roles import LogColumns
from covariant.calibration.identification._servo_columns import Inputs
from covariant.logs import MEANT, Register, unit_factor, unit_in_name, unknown_unit, words_of
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
COUNTS = (*(2**k for k in range(9, 21)), *(1000 * k for k in (1, 2, 4, 5, 10, 20, 40)))
"""Usual counts per turn of encoders, whose tick shows in which unit they are printed."""
SAME_TICK = 1e-4
"""Relative difference up to which ticks are equal, or such a part of a turn."""


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


def unit_of_tick(values: Float[np.ndarray, "T"]) -> str | None:
    """The unit of an angle by the tick of its encoder, which is a usual part of a turn in that unit alone."""
    tick = Register.of(values).tick
    parts = {unit: turn / tick for unit, turn in (("rad", 2 * np.pi), ("deg", 360.0), ("turn", 1.0)) if tick}
    # A tick of one digit is how the number was printed.
    printed = not tick or float(f"{tick:.1g}") == float(f"{tick:.12g}")
    usual = [u for u, n in parts.items() if not printed and any(abs(n / each - 1) < SAME_TICK for each in COUNTS)]
    return usual[0] if len(usual) == 1 else None


def position_units(columns: LogColumns, q: Sequence[str], servos: bool) -> dict[str, str]:
    """Units of positions that state none, by their ticks, or degrees for servos; empty if the values decide neither.

    Raises `ValueError` if the values are ambiguous.
    """
    unstated = [name for name in q if columns.unit(name, "q") is None]
    by_tick = {name: unit for name in unstated if (unit := unit_of_tick(columns[name])) not in (None, "rad")}
    unstated = [name for name in unstated if name not in by_tick]
    values = columns.stack(unstated) if unstated else np.empty((0, 0))
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return by_tick
    largest, whole = float(np.abs(values).max()), bool((values % 1 == 0).all())
    ends = f"{values.min():.6g} to {values.max():.6g}"
    answer = "name their unit by `overrides=['units.q=\"turn/4096\"']`, one for each in brackets where they differ"
    if whole and largest > CERTAIN_TICKS:
        if values.min() >= 0 and largest < TICKS:
            return by_tick | dict.fromkeys(unstated, f"turn/{TICKS}")
        what = f"whole numbers from {ends}, as ticks; {answer}"
    elif not servos or largest <= MAX_RADIANS:
        return by_tick
    elif largest > MAX_DEGREES:
        what = f"from {ends}, more than a servo turns in degrees; {answer}"
    elif whole:
        what = f"whole numbers from {ends}: ticks or degrees; {answer}"
    elif largest <= MAX_PER_CENT:
        what = (
            f"from {ends}: degrees, or per cent of "
            "the range of each servo, as LeRobot logs them unless use_degrees is set, which is no angle. Name their "
            "unit by `overrides=['units.q=\"deg\"']`; for -100 to 100 it is a 200th of the range of each joint, as "
            '`overrides=[\'units.q=["1.1 deg", "0.9 deg"]\']` for ranges of 220 and 180 degrees, from the calibration '
            "file of the arm: (range_max - range_min) / 4096 * 360 / 200; of a gripper from 0 to 100 it is a 100th"
        )
    else:
        return by_tick | dict.fromkeys(unstated, "deg")
    raise InputError(f"the positions {', '.join(unstated)} are {what}")


def servos_of(
    columns: LogColumns, inputs: Inputs, q: Sequence[str], q_units: Sequence[str]
) -> tuple[DraftedServo | None, ...]:
    """The servo of each position with the unit of its command; raises `ValueError` for an ambiguous unit."""
    rows = zip(q, q_units, inputs.drives, strict=True)
    return tuple(None if drive is None else _servo(columns, name, text, *drive) for name, text, drive in rows)


def _servo(columns: LogColumns, position: str, text: str, command: str, fit: Following | None) -> DraftedServo:
    """The servo of a position, which is logged in the unit `text`."""
    rows = copied(columns[position], columns[command])
    if rows is not None:
        where = "of the same row" if rows == 0 else "of the next row"
        raise InputError(
            f"column {command!r} is a copy of {position!r} {where}: a log of what was measured, and no command; "
            'name the inputs by `columns["u"]`, or none with []'
        )
    unit = _unit_of_command(columns, position, text, command, fit)
    if fit is None or not follows(fit):
        return DraftedServo(command, unit, None, 0.0)
    # For a soft servo the mean distance may be sag, so it is no offset; a slow motion shows no lag.
    factor = unit_factor(text)
    is_stiff = MIN_STIFF_SLOPE < abs(fit.slope * factor / unit) < 2 - MIN_STIFF_SLOPE
    offset = fit.position * factor - fit.command * unit if is_stiff else 0.0
    return DraftedServo(command, unit, fit.lag if fit.late > LAG_ERROR_RATIO else None, offset)


def _unit_of_command(columns: LogColumns, position: str, text: str, command: str, fit: Following | None) -> float:
    """The angle [rad] of one of a command, by its label or by how far its position moves, which must fit either."""
    factor, named = unit_factor(text), columns.unit(command, "q")
    unknown = unknown_unit(columns.labels[command], MEANT["q"])
    if unknown is not None and unknown.lower() not in ("tick", "ticks", "count", "counts"):
        raise InputError(
            f"column {command!r} has {unknown!r} in its name, which is no unit of a command; name what one of it "
            "is by `overrides=['units.u=\"deg\"']`"
        )
    slope = 0.0 if fit is None else fit.slope
    unit, size = unit_factor(named) if named else factor, abs(slope) * factor
    if follows(fit) and not named:
        sign = -1.0 if slope < 0 else 1.0
        # A servo falls short of its command where it is soft, and does not go beyond it.
        near = next((each for each in _UNITS if 0.85 * each < size < 1.05 * each), None)
        near = factor if 0.15 * factor < size < 1.3 * factor else near
        unit = None if near is None else sign * near
    # A position never moves farther than its command, however well it follows.
    if unit is None or size > 1.5 * abs(unit) or (named and follows(fit) and size < 0.15 * abs(unit)):
        raise InputError(
            f"column {command!r}: {position} [{text}] moves by {size:.3g} rad for one of it, which is no unit of a "
            f"command{' in ' + named if named else ''}; name it by `overrides=['units.u=\"deg\"']`, or "
            f"`overrides=['units.u=\"{size:.3g} rad\"']` if so much is meant"
        )
    return unit


def units_of_commands(
    columns: LogColumns, servos: Sequence[DraftedServo | None], switches: int, of_positions: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Units of the inputs; empty if all commands are in radians and no name states a unit; a switch has none."""
    texts, in_names = [], False
    for unit, servo in zip(of_positions, servos, strict=True):
        if servo is not None:
            signed = {1.0: unit, -1.0: f"-1 {unit}"}.get(servo.unit / unit_factor(unit))
            by_size = signed or _UNITS.get(servo.unit, f"{servo.unit:.6g} rad")
            texts.append(columns.unit(servo.command, "q") or by_size)
            in_names |= unit_in_name(servo.command, MEANT["q"]) is not None
    plain = all(unit_factor(text) == 1 for text in texts)
    return {} if plain and not in_names else {"u": (*texts, *("1",) * switches)}


def remarks_on(
    columns: LogColumns,
    inputs: Inputs,
    servos: Sequence[DraftedServo | None],
    q: Sequence[str],
    factors: Sequence[float],
) -> list[str]:
    """Remarks on commands that may be in another unit or have gaps."""
    remarks = []
    for position, factor, servo, drive in zip(q, factors, servos, inputs.drives, strict=True):
        if servo is None or drive is None:
            continue
        follow_fit = drive.fit
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
        name = columns.entries.get(position, position)
        if "q" not in columns.units and words_of(name) & {"gripper", "jaw", "finger", "hand", "claw"}:
            remarks.append(f"{name} is taken for an angle; grippers are often logged as a part of their range")
    return remarks
