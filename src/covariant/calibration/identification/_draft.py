"""Guesses the role of each column of a log, from its name and from its content."""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis import periods, without_full_turns
from covariant.calibration.identification._commands import is_slope
from covariant.calibration.identification._roles import REGISTERS, role
from covariant.calibration.identification._servo_columns import (
    find_inputs,
    refuse_commands_among,
    refuse_poses,
    refuse_rows_of_several,
    switches_of,
    without_rates,
)
from covariant.calibration.identification._servo_units import (
    DraftedServo,
    plausible_rates,
    remarks_on,
    servos_of,
    stated_by_user,
    unit_labels,
    units_of_commands,
)
from covariant.logs import (
    MEANT,
    episodes_fault,
    has_sign_bit,
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
from scalargraph.errors import InputError

CLOCKS = ((0.5, "s"), (500.0, "ms"), (5e5, "us"), (np.inf, "ns"))
"""Upper bounds of the median step of the stamps, and the unit in which they then are."""
DEGREES = 50.0
"""Span [rad] of an angle from which it is more likely in degrees."""
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
    servos: tuple[DraftedServo | None, ...] = ()
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
            raise InputError(f"there is no column {name!r} of numbers{_columns_there(columns)}")
    fixed = {name for names in given.values() for name in names}
    # Units that the log states are written as in a name, so that one parser reads both.
    labels = {name: f"{name} [{stated[name]}]" if stated and name in stated else name for name in columns}
    known, entries = dict(units or {}), dict(entries or {})
    # q_d is a desired position, unless there is a q_c.
    desired = {
        name for name in columns if words_of(name) & {"q", "dq"} and re.sub("_d(?![a-z])", "_c", name) not in columns
    }
    marks = {name: "desired" for name in desired if "d" in words_of(name)}
    kinds = {name: role(labels[name], entries.get(name, marks.get(name, ""))) for name in columns if name not in fixed}
    t = given["t"][0] if "t" in given else _stamps(columns, kinds)
    _refuse_episodes(t, columns)
    step = _step(t, columns[t])
    refuse_rows_of_several(columns)
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
        raise InputError(
            f'no column is named like a position, as q1 or theta; name them by `columns["q"]`{_columns_there(columns)}'
        )
    episodes = episodes_fault(columns[t], columns, columns.__getitem__, rising=True)
    _one_family("q", q, given, columns)
    refuse_poses(q, entries)
    labels |= stated_by_user("t", (t,), known) | stated_by_user("q", q, known)
    clock = columns[t] * unit_factor(_unit_of_stamps(labels[t], columns[t]))
    inputs = find_inputs(columns, labels, kinds, given.get("u"), clock, q)
    if "q" not in given:
        q, inputs = without_rates(columns, clock, q, inputs)
        refuse_commands_among(columns, clock, q)
    commands = tuple(name for name in inputs.commands if name is not None)
    _one_family("u", inputs.u, given, columns)
    if len(inputs.u) > len(q):
        raise InputError(
            f'{len(inputs.u)} inputs ({", ".join(inputs.u)}) for {len(q)} positions; name them by `columns["u"]`'
            f"{_columns_there(columns)}"
        )
    for name in (*q, *commands):
        if has_sign_bit(columns[name]):
            raise InputError(sign_bit_fault(name))
    labels |= stated_by_user("u", commands or inputs.u, known)
    ticks = unit_labels(columns, q, labels, bool(commands))
    labels |= ticks
    v = given.get("v") or tuple(name for name, kind in kinds.items() if kind == "v")
    if not v:
        unnamed = [name for name, kind in kinds.items() if kind == "" and name != t]
        v = tuple(name for p in q for name in unnamed if is_slope(columns[t], columns[p], columns[name]))
    v = v if len(v) == len(q) else ()
    labels |= stated_by_user("v", v, known)
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
        raise InputError(f"row 1 lacks a position ({', '.join(q)}); cut the log to begin later")
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
        switches = switches_of(inputs.switches, [name for name, servo in zip(q, servos, strict=True) if servo], columns)
        u = (*(servo.command for servo in servos if servo is not None), *switches)
        units |= units_of_commands(servos, len(switches), labels, units.get("q", ("rad",) * len(q)))
        v, odd_rates = plausible_rates(columns, clock, q, factors, v, labels)
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


def _unit_of_stamps(label: str, t: np.ndarray) -> str:
    return unit_in_name(label, MEANT["t"]) or next(unit for limit, unit in CLOCKS if np.median(np.diff(t)) < limit)


def _refuse_unknown_units(fields: Mapping[str, Sequence[str]], labels: Mapping[str, str]) -> None:
    """Raise `ValueError` for a column whose label states a unit that is none of its field."""
    for field, names in fields.items():
        for name in names:
            text = unknown_unit(labels[name], MEANT[field], [labels[each] for each in names])
            if text is not None:
                raise InputError(unknown_unit_fault(name, field, text, labels[name] != name, drafted=True))


def _units(
    fields: Mapping[str, tuple[str, ...]], t: Float[np.ndarray, "T"], span: Float[np.ndarray, "n 2"]
) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """Units of the columns of each field, where they are not those of a model file, and the fields that were guessed.

    `t` are the stamps, `span` (n, 2) that of the positions, both as logged.
    """
    stated = {field: [unit_in_name(name, MEANT[field]) for name in names] for field, names in fields.items()}
    odd = odd_clock(t, stated["t"][0])
    if odd is not None:
        raise InputError(f"column {fields['t'][0]!r} {odd}")
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
    raise InputError(f'{what}; name the one of the stamps by `columns["t"]`{_columns_there(columns)}')


def _refuse_episodes(name: str, columns: Mapping[str, np.ndarray]) -> None:
    """Raise `ValueError` for stamps that start again with each episode."""
    fault = episodes_fault(columns[name], columns, columns.__getitem__)
    if fault is not None:
        raise InputError(f"column {name!r} {fault}")


def _step(name: str, t: np.ndarray) -> float:
    """Median step of the stamps; raises `ValueError` where they do not rise."""
    if len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise InputError(
            f'the stamps {name} do not rise from row to row; sort the log, or name others by `columns["t"]`'
        )
    return float(np.median(np.diff(t)))


def _one_family(key: str, names: Sequence[str], fixed: Mapping[str, Sequence[str]], columns) -> None:
    """Raise `ValueError` where names such as q1, q2 and th1, th2 say that there are several kinds of them."""
    stems = {re.sub(r"[0-9]+", "#", name) for name in names}
    if key not in fixed and 1 < len(stems) < len(names):
        raise InputError(
            f'{", ".join(names)} may all be {key}; name those that are by `columns["{key}"]`{_columns_there(columns)}'
        )


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
        if match is not None and role(name) not in ("left out", "t"):
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
                raise InputError(
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
        raise InputError(f"row 1 lacks an attitude ({', '.join(names)}); cut the log to begin later")
    # A torque about each axis of the body, or none that is known.
    u = given.get("u") or tuple(name for name, kind in kinds.items() if kind == "u")
    if "u" in given and len(u) not in (0, 3):
        raise InputError(f"{len(u)} inputs ({', '.join(u)}) for a body that turns, needs 3 torques or none")
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
