"""Guesses the role of each column of a log, from its name and from its content."""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis import periods, without_full_turns
from covariant.calibration.identification._commands import COMMANDS, POSITIONS, TARGETS, TORQUES, pairs
from covariant.calibration.identification._servo_columns import (
    Inputs,
    Servo,
    find_inputs,
    position_units,
    refuse_commands_among,
    remarks_on,
    servos_of,
)
from covariant.logs import (
    KNOWN,
    MEANT,
    episodes_fault,
    has_sign_bit,
    is_unit_of,
    odd_clock,
    sign_bit_fault,
    unit_factor,
    unit_in_name,
    unknown_unit,
    unknown_unit_fault,
    without_unit,
    words_of,
)
from covariant.scoring import unwrap

_WORDS = {
    "left out": "true truth raw error errors err limit limits",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq effort force motor input",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x",
}
"""Words in the names of columns, by role; the first role with a match counts."""
_UNITS = {1.0: "rad", unit_factor("deg"): "deg", unit_factor("turn/4096"): "turn/4096"}
"""Units of commands that their size tells."""
REGISTERS = {
    "current": "current currents amp amps ampere",
    "load": "load loads pwm duty",
    "voltage": "volt volts voltage voltages",
    "temperature": "temp temperature temperatures",
}
"""Words of registers of a drive, by what they hold; none of these is a torque."""
CLOCKS = ((0.5, "s"), (500.0, "ms"), (5e5, "us"), (np.inf, "ns"))
"""Upper bounds of the median step of the stamps, and the unit in which they then are."""
DEGREES = 50.0
"""Span [rad] of an angle from which it is more likely in degrees."""
SAME = 0.95
"""Least correlation of a column with the slope of a position for it to count as a velocity."""
MOST_MOTORS = 64
"""Most motors of a log that has a row for each in turn."""
FEWEST_GAPS = 10
"""Least number of gaps between values for which ticks are looked for."""
OFF_TICK = 0.1
"""Largest distance of differences of positions from whole ticks, as a fraction of one."""
MOST_ROUNDING = 0.25
"""Largest rounding of printed numbers, as a fraction of a tick, at which ticks are still told from any numbers."""
OFF_UNIT = 0.05
"""Largest distance of the length of a quaternion from 1."""
SCALED_MOTION = 0.1
"""Least motion, in lengths, of four numbers whose length stays within its square, for them to be a quaternion."""


_QUATERNION = re.compile(r"(.*?)[_./\[]?([wxyzWXYZ]|[0-9]+)\]?$")
"""Name of one of the four numbers of a quaternion, as qw, q_x, orientation.y or q[3], and the letter or index."""


class Draft(NamedTuple):
    """Role of each column of a log, with units, rate and noise.

    Attributes:
        t: Column of stamps.
        q: Columns of positions; lengths first, then angles.
        u: Columns of inputs.
        v: Columns of logged velocities.
        left_out: The other columns.
        rate: Sampling rate [Hz].
        rows: Number of samples.
        lengths: Whether each of the n positions is a length [m]; the others are angles [rad].
        quantum: One tick of the positions where they are whole ticks apart, otherwise None. One for each position where
            some are lengths and some angles.
        noise: Standard deviation of their noise, from third differences; an upper bound, since motion counts as well.
            One for each position where some are lengths and some angles.
        span: Least and largest value (n, 2) of each position, as logged.
        units: By the field t, q, u or v, the units of its columns where they are not those of a model file: s, rad,
            N m and rad/s.
        guessed: Fields whose units follow from the content and not from the header.
        quaternion: Columns of the attitude of a body that turns, scalar first, in place of positions.
        period: Period of each position after which its readings repeat, as of an encoder behind a gear; 0 for none.
        servos: What the log tells of the servo of each position, None for one without a command; empty where the inputs
            are no commands.
        switches: Columns that are 0 where servos are switched off; the last of `u`.
        registers: Columns of a drive among those that are left out, which are no torques: by "current", "load",
            "voltage", "temperature".
        remarks: Sentences on what was guessed of the inputs.
        entries: What the log calls the entries of lists, by column.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import draft
        >>> t = np.arange(0.0, 2.0, 0.01)
        >>> guess = draft({"time": t, "arm [rad]": np.sin(t), "torque": np.cos(t)})
        >>> guess.q, guess.u, guess.plain_names, round(guess.rate)
        (('arm [rad]',), ('torque',), ('arm',), 100)
    """

    t: str
    q: tuple[str, ...]
    u: tuple[str, ...]
    v: tuple[str, ...]
    left_out: tuple[str, ...]
    rate: float
    rows: int
    lengths: tuple[bool, ...]
    quantum: float | tuple[float, ...] | None
    noise: float | tuple[float, ...]
    span: Float[np.ndarray, "n 2"]
    units: dict[str, tuple[str, ...]]
    guessed: tuple[str, ...]
    quaternion: tuple[str, ...] = ()
    period: tuple[float, ...] = ()
    servos: tuple[Servo | None, ...] = ()
    switches: tuple[str, ...] = ()
    registers: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    remarks: tuple[str, ...] = ()
    entries: Mapping[str, str] = MappingProxyType({})

    @property
    def plain_names(self) -> tuple[str, ...]:
        """Names of the positions without their units, `cart` for `cart [mm]`; full names where two would coincide."""
        plain = tuple(without_unit(self.entries.get(name, name)).removesuffix(".pos") for name in self.q)
        return plain if "" not in plain and len(set(plain)) == len(plain) else self.q


def draft(
    columns: Mapping[str, np.ndarray],
    given: Mapping[str, Sequence[str] | None] | None = None,
    stated: Mapping[str, str] | None = None,
    units: Mapping[str, Sequence[str]] | None = None,
    entries: Mapping[str, str] | None = None,
) -> Draft:
    """Guess the role of each column of a log, from its name and, where that says nothing, from its content.

    Four columns that vary and whose squares sum to 1 in every row are the attitude of a body, unless positions are
    given.

    Args:
        columns: The columns (T,) by name, numbers only.
        given: Names by the field t, q, u or v that are known and not to be guessed.
        stated: Units that the log states beside the names, by column.
        units: Units of the columns of the fields t, q, u or v that are known: one, or one for each column.
        entries: What the log calls the entries of its columns of lists, by column.

    Returns:
        The role of each column, with rate, units, ticks and noise.

    Raises:
        ValueError: It is not clear which columns are the stamps, the positions or the inputs, or in which unit servos
            are logged, or the first row lacks a position. One line, which lists the columns.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import draft
        >>> t = np.arange(0.0, 2.0, 0.01)
        >>> guess = draft({"a": 1e3 * t, "q1 [deg]": 30 * np.sin(t), "b": 0 * t}, given={"u": ["b"]})
        >>> guess.t, guess.u, guess.units, guess.guessed
        ('a', ('b',), {'t': ('ms',), 'q': ('deg',)}, ('t',))
    """
    given = {key: tuple(names) for key, names in (given or {}).items() if names is not None}
    for name in [name for names in given.values() for name in names]:
        if name not in columns:
            raise ValueError(f"there is no column {name!r} of numbers{_columns_there(columns)}")
    fixed = {name for names in given.values() for name in names}
    # Units that the log states are written as in a name, so that one parser reads both.
    labels = {name: f"{name} [{stated[name]}]" if stated and name in stated else name for name in columns}
    known, entries = dict(units or {}), dict(entries or {})
    # q_d is a desired position, unless there is a q_c.
    desired = {
        name for name in columns if words_of(name) & {"q", "dq"} and re.sub("_d(?![a-z])", "_c", name) not in columns
    }
    marks = {name: "desired" for name in desired if "d" in words_of(name)}
    kinds = {name: _kind(labels[name], entries.get(name, marks.get(name, ""))) for name in columns if name not in fixed}
    t = given["t"][0] if "t" in given else _stamps(columns, kinds)
    _refuse_episodes(t, columns)
    step = _step(t, columns[t])
    _refuse_rows_of_several(columns)
    registers = {
        kind: tuple(name for name, role in kinds.items() if role == kind)
        for kind in REGISTERS
        if kind in kinds.values()
    }
    quaternion = () if "q" in given else _quaternion({name: columns[name] for name, kind in kinds.items() if name != t})
    if quaternion:
        return _draft_of_attitude(columns, labels, kinds, given, t, quaternion)
    q = given.get("q") or tuple(name for name, kind in kinds.items() if kind == "q" and name != t)
    if not q:
        raise ValueError(
            f'no column is named like a position, as q1 or theta; name them by `columns["q"]`{_columns_there(columns)}'
        )
    episodes = episodes_fault(columns[t], columns, columns.__getitem__, rising=True)
    _one_family("q", q, given, columns)
    _refuse_poses(q, entries)
    labels |= _stated_by_user("t", (t,), known) | _stated_by_user("q", q, known)
    clock = columns[t] * unit_factor(_unit_of_stamps(labels[t], columns[t]))
    inputs = find_inputs(columns, labels, kinds, given.get("u"), clock, q)
    if "q" not in given:
        q, inputs = _without_rates(columns, clock, q, inputs)
        refuse_commands_among(columns, clock, q)
    commands = tuple(name for name in inputs.commands if name is not None)
    _one_family("u", inputs.u, given, columns)
    if len(inputs.u) > len(q):
        raise ValueError(
            f'{len(inputs.u)} inputs ({", ".join(inputs.u)}) for {len(q)} positions; name them by `columns["u"]`'
            f"{_columns_there(columns)}"
        )
    for name in (*q, *commands):
        if has_sign_bit(columns[name]):
            raise ValueError(sign_bit_fault(name))
    labels |= _stated_by_user("u", commands or inputs.u, known)
    ticks = _unit_labels(columns, q, labels, bool(commands))
    labels |= ticks
    v = given.get("v") or tuple(name for name, kind in kinds.items() if kind == "v")
    if not v:
        unnamed = [name for name, kind in kinds.items() if kind == "" and name != t]
        v = tuple(name for p in q for name in unnamed if _is_slope(columns[t], columns[p], columns[name]))
    v = v if len(v) == len(q) else ()
    labels |= _stated_by_user("v", v, known)
    _refuse_unknown_units({"t": (t,), "q": q, "u": inputs.u, "v": v}, labels)
    lengths = tuple(unit_in_name(labels[name], ("m",)) is not None for name in q)
    order = sorted(range(len(q)), key=lambda i: not lengths[i])
    q, lengths = tuple(q[i] for i in order), tuple(lengths[i] for i in order)
    v = tuple(v[i] for i in order) if v else ()
    u = inputs.u
    if "u" not in given:  # forces before torques, as lengths come before angles
        u = tuple(sorted(u, key=lambda name: unit_in_name(labels[name], ("N m",)) is not None))
    logged = np.column_stack([columns[name] for name in q])
    if np.isnan(logged[0]).any():
        raise ValueError(f"row 1 lacks a position ({', '.join(q)}); cut the log to begin later")
    span = np.stack([np.nanmin(logged, axis=0), np.nanmax(logged, axis=0)], axis=1)
    fields = {"t": (t,), "q": q, "u": u, "v": v}
    units, guessed = _units(
        {field: tuple(labels[name] for name in names) for field, names in fields.items()}, columns[t], span
    )
    seconds = unit_factor(units.get("t", ("s",))[0])
    factors = [unit_factor(text) for text in units.get("q", ("rad",) * len(q))]
    y = logged * factors
    guessed += ("q",) if ticks and "q" not in guessed and "q" not in known else ()
    servos, switches, remarks = (), (), list(inputs.remarks)
    remarks += [] if episodes is None else [f"the log {episodes}"]
    if commands:
        paired = inputs._replace(
            commands=tuple(inputs.commands[i] for i in order), following=tuple(inputs.following[i] for i in order)
        )
        servos = servos_of(paired, columns, labels, q, units.get("q", ("rad",) * len(q)))
        switches = _switches(inputs.switches, [name for name, servo in zip(q, servos, strict=True) if servo], columns)
        u = (*(servo.command for servo in servos if servo is not None), *switches)
        units |= _units_of_commands(servos, len(switches), labels, units.get("q", ("rad",) * len(q)))
        v, odd_rates = _plausible_rates(columns, clock, q, factors, v, labels)
        remarks += [*odd_rates, *remarks_on(paired, servos, columns, q, factors, entries, "q" in known)]
    rounding = [_rounding(column) * factor for column, factor in zip(logged.T, np.abs(factors), strict=True)]
    # Readings are whole ticks as they are: a period is known less exactly.
    tick, wraps = _tick(y, rounding), _periods(columns[t], y, rounding, lengths)
    continuous = unwrap(y, (), wraps)
    noises = _noise(continuous, lengths)
    if len(set(lengths)) == 2 or (servos and len(q) > 1):  # a tick of a metre is none of a radian
        each_tick = [_tick(y[:, [i]], [rounding[i]]) for i in range(len(q))]
        tick = None if None in each_tick else tuple(each for each in each_tick if each is not None)
        noises = tuple(
            _noise(column[:, None], (is_length,)) for column, is_length in zip(continuous.T, lengths, strict=True)
        )
        if tick is not None and np.ptp(tick) < OFF_TICK / 100 * tick[0]:
            tick = tick[0]
    return Draft(
        t,
        q,
        u,
        v,
        tuple(name for name in columns if name not in (t, *q, *u, *v)),
        1 / (step * seconds),
        len(y),
        lengths,
        tick,
        noises,
        span,
        units,
        guessed,
        period=tuple(wraps.tolist()),
        servos=servos,
        switches=switches,
        registers=registers,
        remarks=tuple(remarks),
        entries=entries,
    )


def _without_rates(
    columns: Mapping[str, np.ndarray], clock: np.ndarray, q: tuple[str, ...], inputs: Inputs
) -> tuple[tuple[str, ...], Inputs]:
    """Positions and inputs without entries of a state that are no positions of servos, but their velocities."""
    driven = [name for name, command in zip(q, inputs.commands, strict=False) if command is not None]
    rates = {
        name
        for name, command in zip(q, inputs.commands, strict=False)
        if command is None and any(_is_slope(clock, columns[each], columns[name]) for each in driven)
    }
    kept = [i for i, name in enumerate(q) if name not in rates]
    if not rates:
        passive = [name for name, command in zip(q, inputs.commands, strict=False) if command is None]
        remark = f"{', '.join(passive)} have no command, and move freely in this draft"
        return q, inputs._replace(remarks=(*inputs.remarks, remark)) if passive and driven else inputs
    return tuple(q[i] for i in kept), inputs._replace(
        commands=tuple(inputs.commands[i] for i in kept),
        following=tuple(inputs.following[i] for i in kept),
        remarks=(*inputs.remarks, f"{', '.join(sorted(rates))} are velocities, and left out"),
    )


def _stated_by_user(field: str, names: Sequence[str], known: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Labels of columns with the units that the user gives for them."""
    texts = known.get(field, ())
    if not texts or not names:
        return {}
    if len(texts) not in (1, len(names)):
        raise ValueError(
            f"{len(texts)} units are given for {field}, which has {len(names)} columns ({', '.join(names)})"
        )
    for text in texts:
        if not is_unit_of(text, MEANT["q"] if field == "u" else MEANT[field]) and not is_unit_of(text, MEANT[field]):
            raise ValueError(f"unit {text!r} is no unit of {field}; known are {KNOWN[field][0]}, as {KNOWN[field][1]}")
    return {name: f"{name} [{texts[i if len(texts) > 1 else 0]}]" for i, name in enumerate(names)}


def _unit_of_stamps(label: str, t: np.ndarray) -> str:
    return unit_in_name(label, MEANT["t"]) or next(unit for limit, unit in CLOCKS if np.median(np.diff(t)) < limit)


def _unit_labels(
    columns: Mapping[str, np.ndarray], q: Sequence[str], labels: Mapping[str, str], servos: bool
) -> dict[str, str]:
    """Labels of positions with a unit that their numbers show; empty where the usual rule decides."""
    texts = [unit_in_name(labels[name], MEANT["q"]) for name in q]
    if None not in texts:
        return {}
    units = position_units(np.column_stack([columns[name] for name in q]), q, texts, servos)
    return {} if units is None else {name: f"{name} [{unit}]" for name, unit in zip(q, units, strict=True)}


def _switches(names: Sequence[str], positions: Sequence[str], columns: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """The switch of each servo: columns of 0 and 1 in which a servo is off for a while; one may be that of all."""
    used = [name for name in names if set(np.unique(columns[name][np.isfinite(columns[name])]).tolist()) == {0.0, 1.0}]
    if len(used) == 1:
        return tuple(used) * len(positions)
    paired = pairs(positions, used)
    return tuple(name for name in paired if name is not None) if None not in paired else ()


def _units_of_commands(
    servos: Sequence[Servo | None], switches: int, labels: Mapping[str, str], of_positions: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Units of the columns of commands, where they are not radians without a word of it; a switch has none."""
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


def _plausible_rates(
    columns: Mapping[str, np.ndarray],
    clock: np.ndarray,
    q: Sequence[str],
    factors: Sequence[float],
    v: tuple[str, ...],
    labels: Mapping[str, str],
) -> tuple[tuple[str, ...], list[str]]:
    """Registers of velocities, none where they are in another unit than their name says, with a sentence on it."""
    for position, factor, name in zip(q, factors, v, strict=False):
        slope = np.gradient(columns[position], clock) * factor
        unit = unit_factor(unit_in_name(labels[name], MEANT["v"]) or "rad/s")
        valid = np.isfinite(slope) & np.isfinite(columns[name])
        size = float(np.sum(slope[valid] ** 2))
        ratio = float(np.sum(slope[valid] * columns[name][valid])) * unit / size if size else 1.0
        if np.count_nonzero(np.diff(columns[position])) > FEWEST_GAPS and not 0.4 < ratio < 1.6:
            return (), [
                f"the registers of velocity {', '.join(v)} are left out: {name} is {ratio:.3g} times the slope of "
                f"{position}"
            ]
    return v, []


def _refuse_rows_of_several(columns: Mapping[str, np.ndarray]) -> None:
    """Raise `ValueError` for a log with a row for each motor in turn, in place of a column."""
    for name, values in columns.items():
        if not re.fullmatch(r"(?:(?:motor|servo|joint|device|axis|dxl|node|can)_?)?ids?", name, re.IGNORECASE):
            continue
        kinds = np.unique(values[np.isfinite(values)])
        if 1 < len(kinds) <= MOST_MOTORS and np.mean(np.diff(values) != 0) > 0.5:
            raise ValueError(
                f"column {name!r} takes turns from row to row, from {kinds[0]:g} to {kinds[-1]:g}: each row is "
                f'of another motor; give each a column, in pandas as table.pivot_table(index="t", columns={name!r})'
            )


def _refuse_poses(q: Sequence[str], entries: Mapping[str, str]) -> None:
    """Raise `ValueError` for a state whose entries are a point in space, and no joints."""
    if {"x", "y", "z"} <= {entries.get(name, name).lower().rpartition("_")[2] for name in q}:
        named = ", ".join(f"{name} {entries[name]}" for name in q if name in entries)
        raise ValueError(f'the state is a pose, and no joints: {named or ", ".join(q)}; name joints by `columns["q"]`')


def _refuse_unknown_units(fields: Mapping[str, Sequence[str]], labels: Mapping[str, str]) -> None:
    """Raise `ValueError` for a column whose label states a unit that is none of its field."""
    for field, names in fields.items():
        for name in names:
            text = unknown_unit(labels[name], MEANT[field], [labels[each] for each in names])
            if text is not None:
                raise ValueError(unknown_unit_fault(name, field, text, labels[name] != name, drafted=True))


def _units(
    fields: Mapping[str, tuple[str, ...]], t: Float[np.ndarray, "T"], span: Float[np.ndarray, "n 2"]
) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """Units of the columns of each field, where they are not those of a model file, and the fields that were guessed.

    `t` are the stamps, `span` (n, 2) that of the positions, both as logged.
    """
    stated = {field: [unit_in_name(name, MEANT[field]) for name in names] for field, names in fields.items()}
    odd = odd_clock(t, stated["t"][0])
    if odd is not None:
        raise ValueError(f"column {fields['t'][0]!r} {odd}")
    step = np.median(np.diff(t))
    content = {"t": next(unit for limit, unit in CLOCKS if step < limit)}
    unstated = [width for width, unit in zip(np.ptp(span, axis=1), stated["q"], strict=True) if unit is None]
    content["q"] = "deg" if max(unstated, default=0.0) > DEGREES else "rad"
    units, guessed = {}, []
    for field, named in stated.items():
        if None in named and field in content:
            guessed.append(field)
        texts = tuple(text or (content[field] if field in content else MEANT[field][0]) for text in named)
        if any(unit_factor(text) != 1 for text in texts):
            units[field] = texts
    return units, tuple(field for field in guessed if field in units)


def _columns_there(columns: Mapping[str, np.ndarray]) -> str:
    return f"; the columns of numbers are {', '.join(columns) or 'none'}"


def _kind(name: str, entry: str = "") -> str:
    """Role of a column by its name, a key of `_WORDS`: by its words, else by its unit; empty where neither shows it.

    Of a drive it may be a "command" of its position, the "switch" of its torque, or one of `REGISTERS`. `entry` is what
    the log calls the entry of a list, whose column says that it is a state or an action.
    """
    words = words_of(f"{name} {entry}")
    if words & set(_WORDS["left out"].split()):
        return "left out"
    if words & {"enable", "enabled"}:
        return "switch"
    register = next((kind for kind, synonyms in REGISTERS.items() if words & set(synonyms.split())), "")
    is_rate = bool(words & set(_WORDS["v"].split())) or unit_in_name(name, MEANT["v"]) is not None
    is_torque = bool(words & TORQUES) or unit_in_name(name, MEANT["u"]) is not None
    if words & COMMANDS:
        if is_rate or register:
            return "left out"
        return "command" if not is_torque else "left out" if words & TARGETS else "u"
    if register and not words & POSITIONS and not is_torque:
        return register
    if words & POSITIONS and not is_torque and not is_rate:
        return "q"
    # Entries of a state are positions unless they say otherwise.
    if re.fullmatch(r"(?:.*[_./])?state\[[0-9]+\]", name):
        return "v" if is_rate else "u" if is_torque else "q"
    roles = [kind for kind, synonyms in _WORDS.items() if words & set(synonyms.split())]
    # A unit of velocity decides, whatever the words: q1 [rad/s] is no position.
    if unit_in_name(name, MEANT["v"]):
        return "v"
    roles += [kind for kind, units in MEANT.items() if unit_in_name(name, units)]
    return next(iter(roles), "")


def _stamps(columns: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> str:
    rising = [name for name, values in columns.items() if np.isfinite(values).all() and (np.diff(values) > 0).all()]
    named = [name for name in rising if kinds.get(name) == "t"]
    candidates = named or [name for name in rising if kinds.get(name) == ""]
    for name in [each for each, kind in kinds.items() if kind == "t" and not named]:
        _refuse_episodes(name, columns)
    if len(candidates) == 1:
        return candidates[0]
    what = (
        f"{', '.join(candidates)} all rise from row to row"
        if candidates
        else "no column of stamps rises from row to row"
    )
    raise ValueError(f'{what}; name the one of the stamps by `columns["t"]`{_columns_there(columns)}')


def _refuse_episodes(name: str, columns: Mapping[str, np.ndarray]) -> None:
    """Raise `ValueError` for stamps that start again with each episode."""
    fault = episodes_fault(columns[name], columns, columns.__getitem__)
    if fault is not None:
        raise ValueError(f"column {name!r} {fault}")


def _step(name: str, t: np.ndarray) -> float:
    """Median step of the stamps; raises `ValueError` where they do not rise."""
    if len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise ValueError(
            f'the stamps {name} do not rise from row to row; sort the log, or name others by `columns["t"]`'
        )
    return float(np.median(np.diff(t)))


def _one_family(key: str, names: Sequence[str], fixed: Mapping[str, Sequence[str]], columns) -> None:
    """Raise `ValueError` where names such as q1, q2 and th1, th2 say that there are several kinds of them."""
    stems = {re.sub(r"[0-9]+", "#", name) for name in names}
    if key not in fixed and 1 < len(stems) < len(names):
        raise ValueError(
            f'{", ".join(names)} may all be {key}; name those that are by `columns["{key}"]`{_columns_there(columns)}'
        )


def _is_slope(t: np.ndarray, y: np.ndarray, v: np.ndarray) -> bool:
    """Whether a column follows the slope of a position."""
    slope = np.gradient(y, t)
    valid = np.isfinite(slope) & np.isfinite(v)
    if valid.sum() < 10 or np.ptp(v[valid]) == 0 or np.ptp(slope[valid]) == 0:
        return False
    return bool(np.corrcoef(slope[valid], v[valid])[0, 1] > SAME)


def _periods(
    t: np.ndarray, y: np.ndarray, rounding: Sequence[float], lengths: Sequence[bool]
) -> Float[np.ndarray, "n"]:
    """Periods (n,) at which the positions jump, 0 for none and for angles that do at a full turn."""
    ticks = [_tick(y[:, [i]], [rounding[i]]) or 0.0 for i in range(y.shape[1])]
    found = periods(t, y, np.array(ticks))
    return without_full_turns(found, tuple(i for i, is_length in enumerate(lengths) if not is_length))


def _noise(y: np.ndarray, lengths: Sequence[bool]) -> float:
    """Upper bound of the standard deviation of noise, from third differences; a wrapped angle counts as no motion."""
    if len(y) <= 4:
        return 0.0
    steps = np.diff(y, axis=0)
    # A step beyond half a turn is one across the seam of the angle.
    steps = np.where(lengths, steps, steps - 2 * np.pi * np.round(steps / (2 * np.pi)))
    # Third differences of white noise have 1 + 9 + 9 + 1 = 20 times its variance.
    return float(np.sqrt(np.nanmean(np.diff(steps, 2, axis=0) ** 2) / 20))


def _rounding(column: np.ndarray) -> float:
    """Power of ten to which the numbers of a column are printed; 0 where they have too many digits."""
    values = column[np.isfinite(column)]
    for digits in range(7):
        scaled = values * 10.0**digits
        if np.allclose(scaled, np.round(scaled), rtol=0, atol=1e-6 + 1e-12 * np.abs(scaled).max(initial=0.0)):
            return 10.0**-digits
    return 0.0


def _tick(y: np.ndarray, rounding: Sequence[float]) -> float | None:
    """Tick of which all differences of positions are multiples, from the gaps between their values, or None.

    `rounding` is to what each column is printed, by which a gap may be off.
    """
    columns = [np.unique(column[np.isfinite(column)]) for column in y.T]
    gaps: np.ndarray = np.concatenate([np.diff(values) for values in columns])
    # Smaller gaps are rounding.
    gaps = gaps[gaps > 1e-6 * np.nanmax(np.abs(y))]
    if len(gaps) < FEWEST_GAPS:
        return None
    # A low quantile, since a single wrong cell can make the minimum too small.
    smallest = float(np.quantile(gaps, 0.02))
    few = np.asarray(gaps, float)[gaps < 50 * smallest]
    # Printed with few decimals, equal ticks differ: 0.0879 deg becomes 0.08 or 0.09. Their mean is exact.
    tick = float(few[few < 1.5 * smallest].mean())
    tick = float(np.sum(few) / np.sum(np.round(few / tick)))
    off = np.abs(few - tick * np.round(few / tick))
    # Where the rounding is no small part of the tick, every number is a multiple of the tick up to it.
    printed = max(rounding)
    allowed = printed if printed < MOST_ROUNDING * tick else 0.0
    if np.quantile(off, 0.95) > max(OFF_TICK * tick, 1.01 * allowed):
        return None
    return tick


def _quaternion(columns: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of four columns that are a unit quaternion which moves, scalar first; none where no four are."""
    groups: dict[str, dict[str, str]] = {}
    for name in columns:
        match = _QUATERNION.match(name)
        if match is not None and _kind(name) not in ("left out", "t"):
            groups.setdefault(match[1], {})[match[2].lower()] = name
    for group in groups.values():
        for order in ("wxyz", "0123", "1234"):
            # The first four of seven joints are none.
            if set(order) != {key for key in group if key.isdigit() == order.isdigit()}:
                continue
            names = tuple(group[key] for key in order)
            q = np.column_stack([columns[name] for name in names])
            q = q[np.isfinite(q).all(axis=1)]
            if not len(q) or not np.ptp(q, axis=0).any():
                continue
            lengths, motion = np.linalg.norm(q, axis=1), np.ptp(q, axis=0).max()
            if np.abs(lengths - 1).max() < OFF_UNIT:
                return names
            # Whole numbers of a sensor, as 16384 for 1
            if motion > SCALED_MOTION * lengths.max() and np.ptp(lengths) < SCALED_MOTION**2 * lengths.max():
                raise ValueError(
                    f"{', '.join(names)} are a quaternion of length {np.median(lengths):.5g}; divide them by it in the "
                    'log, or name the positions by `columns["q"]`'
                )
    return ()


def _draft_of_attitude(
    columns: Mapping[str, np.ndarray],
    labels: Mapping[str, str],
    kinds: Mapping[str, str],
    given: Mapping[str, Sequence[str]],
    t: str,
    names: tuple[str, ...],
) -> Draft:
    """Roles of the columns of a log of a body that turns."""
    q = np.column_stack([columns[name] for name in names])
    if np.isnan(q[0]).any():
        raise ValueError(f"row 1 lacks an attitude ({', '.join(names)}); cut the log to begin later")
    # A torque about each axis of the body, or none that is known.
    u = given.get("u") or tuple(name for name, kind in kinds.items() if kind == "u")
    if "u" in given and len(u) not in (0, 3):
        raise ValueError(f"{len(u)} inputs ({', '.join(u)}) for a body that turns, needs 3 torques or none")
    u = tuple(u) if len(u) == 3 else ()
    _refuse_unknown_units({"t": (t,), "u": u}, labels)
    fields = {"t": (labels[t],), "q": (), "u": tuple(labels[name] for name in u), "v": ()}
    units, guessed = _units(fields, columns[t], np.empty((0, 2)))
    step = float(np.median(np.diff(columns[t]))) * unit_factor(units.get("t", ("s",))[0])
    # A turn by a small angle changes the quaternion by half of it; q and -q are one attitude.
    signs = np.cumprod(np.sign(np.where(np.nansum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)))
    noise = 2 * _noise(q * np.concatenate([[1.0], signs])[:, None], (True,) * 4)
    left_out = tuple(name for name in columns if name not in (t, *names, *u))
    return Draft(
        t, (), u, (), left_out, 1 / step, len(q), (), None, noise, np.empty((0, 2)), units, guessed, quaternion=names
    )
