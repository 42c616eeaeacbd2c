"""Guesses the role of each column of a log, from its name and from its content."""

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant import logs
from covariant.calibration.diagnosis import periods
from covariant.calibration.identification._explained import driving, explained, odd_rates, quaternion, velocities
from covariant.calibration.identification._names import (
    DEGREES,
    LENGTHS,
    REGISTERS,
    TURNS,
    paired,
    positions_of,
    product_of,
)
from covariant.calibration.identification._roles import LogColumns, role
from covariant.calibration.identification._servo_columns import (
    Inputs,
    find_inputs,
    refuse_commands_among,
    refuse_poses,
    refuse_rows_of_several,
    switches_of,
    without_rates,
)
from covariant.calibration.identification._servo_units import (
    DraftedServo,
    position_units,
    remarks_on,
    servos_of,
    units_of_commands,
)
from covariant.calibration.identification._ship_columns import ShipColumns, ship_columns
from covariant.calibration.identification._stamp_columns import find_stamps, refuse_stamps, seconds, unit_of_time
from covariant.scoring import unwrap
from scalargraph.errors import InputError

HIDDEN = 50.0
"""Usual change of the steps from row to row, in ticks, from which noise hides these: they are how numbers were printed.
"""
SAME_TICK = 1e-4
"""Relative difference up to which ticks are equal, or such a part of a turn."""


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
        is_ship: Whether the positions are the pose of a ship in the plane, and the inputs its rudder and propeller.

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
    is_ship: bool = False

    @property
    def unused(self) -> tuple[list[str], list[str]]:
        """Registers of a drive, and the other columns that are left out."""
        registers = [name for names in self.registers.values() for name in names]
        return registers, [name for name in self.left_out if name not in registers]

    @property
    def driven(self) -> list[int]:
        """Indices of the positions that the inputs drive, by their names; empty if these do not say so."""
        return positions_of(self.q, self.u)

    @property
    def units_of_positions(self) -> tuple[str, ...]:
        return self.units.get("q", ("rad",) * len(self.q))

    @property
    def plain_names(self) -> tuple[str, ...]:
        """Names of the positions without their units, `cart` for `cart [mm]`; full names where two would coincide."""
        plain = tuple(logs.without_unit(self.entries.get(name, name)).removesuffix(".pos") for name in self.q)
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
        ValueError: It is not clear which columns are the stamps, the positions or the inputs, or in which unit they
            are, or the first row lacks a position. One line with all such questions, which lists the columns.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import draft
        >>> t = np.arange(0.0, 2.0, 0.01)
        >>> guess = draft({"a": 1e3 * t, "q1 [deg]": 30 * np.sin(t), "b": 0 * t}, given={"u": ["b"]})
        >>> guess.t, guess.u, guess.units, guess.guessed
        ('a', ('b',), {'t': ('ms',), 'q': ('deg',)}, ('t',))
    """
    known = {key: tuple(names) for key, names in (given or {}).items() if names is not None}
    log = _read(columns, known, stated or {}, units or {}, dict(entries or {}))
    guess = log.ask(_drafted, log, otherwise=None)
    texts = [each.replace(log.listed, "") for each in log.questions]
    if guess is None or texts:
        asked = "; ".join(f"({k}) {text}" for k, text in enumerate(texts, 1))
        asked = f"{len(texts)} things cannot be told: {asked}" if len(texts) > 1 else texts[0]
        raise InputError(asked + (log.listed if any(log.listed in each for each in log.questions) else ""))
    return guess


def _drafted(log: LogColumns) -> Draft | None:
    """The draft of columns; None without stamps, since the log was asked for them."""
    attitude = () if "q" in log.given else quaternion(log)
    if attitude:
        return _draft_of_attitude(log, attitude) if log.t else None
    if "q" not in log.given and (ship := ship_columns(log)):
        return _draft_of_ship(log, ship) if log.t else None
    log, q, inputs = _positions_and_inputs(log)
    log, v, guessed = _labels(log, q, inputs)
    if not log.t:
        return None
    # Lengths come before angles, and forces before torques.
    order = sorted(range(len(q)), key=lambda i: not _is_length(log, q[i]))
    q, v = tuple(q[i] for i in order), tuple(v[i] for i in order if v)
    inputs = inputs._replace(drives=tuple(inputs.drives[i] for i in order if inputs.drives))
    torques = {name: logs.unit_in_name(log.labels[name], ("N m",)) is not None for name in inputs.u}
    u = inputs.u if "u" in log.given else tuple(sorted(paired(q, inputs.u), key=torques.__getitem__))
    guess = _roles_and_units(log, q, u, v)
    if "q" not in log.units:
        guess = guess._replace(guessed=tuple(dict.fromkeys((*guess.guessed, *guessed))))
    own = "drives in a unit of its own: one of it in SI units is taken for 1 N or N m"
    remarks = [*inputs.remarks, *odd_rates(log, q, v), *(f"{name} {own}" for name in driving(log, u))]
    remarks += [f"its names are those that {log.product} prints"] * bool(log.product)
    episodes = logs.episodes_fault(log[log.t], log.values, log.values.__getitem__, rising=True)
    remarks += [] if episodes is None else [f"the log {episodes}"]
    registers = {kind: log.of(kind) for kind in REGISTERS if log.of(kind)}
    guess = guess._replace(registers=registers, remarks=tuple(remarks), entries=log.entries)
    return _with_resolution(_with_servos(guess, log, inputs) if inputs.named else guess, log)


def _read(
    columns: Mapping[str, np.ndarray],
    given: Mapping[str, tuple[str, ...]],
    stated: Mapping[str, str],
    units: Mapping[str, Sequence[str]],
    entries: Mapping[str, str],
) -> LogColumns:
    """The columns with their roles by name, of a log whose stamps rise from row to row."""
    fixed = [name for names in given.values() for name in names]
    # Units that the log states are written as in a name, so that one parser reads both.
    labels = {name: f"{name} [{stated[name]}]" if name in stated else name for name in columns}
    log = LogColumns(columns, labels, {}, given, units, entries, "", np.empty(0))
    for name in fixed:
        if name not in columns:
            raise InputError(f"there is no column {name!r} of numbers{log.listed}")
    # q_d is a desired position, unless there is a q_c.
    desired = {
        name
        for name in columns
        if logs.words_of(name) & {"q", "dq"} and re.sub("_d(?![a-z])", "_c", name) not in columns
    }
    marks = {name: "desired" for name in desired if "d" in logs.words_of(name)}
    roles = {name: role(labels[name], entries.get(name, marks.get(name, ""))) for name in columns if name not in fixed}
    # A JointState has the position of a joint under its name, beside what else is known of it.
    beside = {name.rpartition("/")[0] for name, each in roles.items() if each in ("v", "u")}
    roles |= {name: "q" for name, each in roles.items() if not each and name in beside}
    if product := product_of(columns):
        fields = roles | {name: field for field, names in given.items() for name in names}
        turns = {name: TURNS[each] for name, each in fields.items() if each in TURNS and labels[name] == name}
        log = dataclasses.replace(log.labelled(turns), product=product)
    log = dataclasses.replace(log, roles=roles)
    t = given["t"][0] if "t" in given else log.ask(find_stamps, log, otherwise="")
    rows = len(next(iter(columns.values()), ()))
    values = dict(columns) | ({t: logs.Register.continued(columns[t])} if t else {})
    log = dataclasses.replace(log, t=t, values=values, clock=np.arange(rows) * 0.01)
    if t:
        log.ask(refuse_stamps, log, otherwise=None)
    log.ask(refuse_rows_of_several, log, otherwise=None)
    return log


def _positions_and_inputs(log: LogColumns) -> tuple[LogColumns, tuple[str, ...], Inputs]:
    """The columns with the units of stamps and positions that the user states, the positions, and the inputs."""
    q = log.given.get("q") or log.of("q")
    if not q:
        also = "" if "u" in log.given or log.of("u") or log.of("command") else ', and inputs by `columns["u"]`'
        raise InputError(
            f'no column is named like a position, as q1 or theta; name them by `columns["q"]`{also}{log.listed}'
        )
    log = log.with_units("t", (log.t,)).with_units("q", q)
    log = dataclasses.replace(log, clock=seconds(log, q))
    if "q" not in log.given:
        log, q = explained(log, q)
    log.ask(_one_family, "q", q, log, otherwise=None)
    last = Counter("/".join(name.split("/")[-2:]) for name in q)
    if "q" not in log.given and len(last) < len(q) and max(last.values()) > 1:
        twice = ", ".join(name for name, count in last.items() if count > 1)
        raise InputError(f'several topics have {twice}; name the positions of one by `columns["q"]`{log.listed}')
    refuse_poses(log, q)
    inputs = find_inputs(log, q)
    if "q" not in log.given:
        q, inputs = without_rates(log, q, inputs)
        log.ask(refuse_commands_among, log, q, otherwise=None)
    log.ask(_one_family, "u", inputs.u, log, otherwise=None)
    if len(inputs.u) > len(q):
        raise InputError(
            f'{len(inputs.u)} inputs ({", ".join(inputs.u)}) for {len(q)} positions; name them by `columns["u"]`'
            f"{log.listed}"
        )
    coded = {name: logs.Register.of(log[name]) for name in (*q, *inputs.named, *inputs.u)}
    # Positions in two's complement begin anew there, as those of an encoder on a circle do.
    faults = [each.fault(name) for name, each in coded.items() if not (each.span and name in q)]
    log.questions.extend(filter(None, faults))
    return log, q, inputs


def _labels(log: LogColumns, q: tuple[str, ...], inputs: Inputs) -> tuple[LogColumns, tuple[str, ...], tuple[str, ...]]:
    """The columns with all units that are known, the velocities, and the fields whose units values show."""
    log = log.with_units("u", inputs.named or inputs.u)
    by_value = log.ask(position_units, log, q, bool(inputs.named), otherwise={})
    log = log.labelled(by_value)
    v = log.given.get("v") or velocities(log, q)
    log = log.with_units("v", v)
    torques = [name for name in inputs.u if name not in driving(log, inputs.u)]
    asked = not log.t or any(repr(log.t) in each for each in log.questions)
    _ask_unknown_units(log, {"t": () if asked else (log.t,), "q": q, "u": torques, "v": v})
    return log, v, ("q", "v") if log.product else ("q",) if by_value else ()


def _is_length(log: LogColumns, name: str) -> bool:
    unit = log.unit(name, "q")
    return logs.is_unit_of(unit, ("m",)) if unit else bool(logs.words_of(name) & LENGTHS)


def _roles_and_units(
    log: LogColumns, q: tuple[str, ...], u: tuple[str, ...], v: tuple[str, ...], quaternion: tuple[str, ...] = ()
) -> Draft:
    """A draft without its ticks, noise and servos."""
    t, logged, what = log.t, log.stack(q or quaternion), "an attitude" if quaternion else "a position"
    if np.isnan(logged[0]).any():
        raise InputError(f"row 1 lacks {what} ({', '.join(q or quaternion)}); cut the log to begin later")
    span = np.stack([np.nanmin(logged, axis=0), np.nanmax(logged, axis=0)], axis=1)[: len(q)]
    units, guessed = _units(log, {"t": (t,), "q": q, "u": u, "v": v}, span)
    left_out = tuple(name for name in log.values if name not in (t, *q, *u, *v, *quaternion))
    rate = 1 / (float(np.median(np.diff(log[t]))) * logs.unit_factor(units.get("t", ("s",))[0]))
    lengths = tuple(_is_length(log, name) for name in q)
    return Draft(t, q, u, v, left_out, rate, len(logged), lengths, None, 0.0, span, units, guessed, quaternion)


def _with_servos(guess: Draft, log: LogColumns, inputs: Inputs) -> Draft:
    """A draft with the commands of servos, and their switches, as its inputs."""
    units, factors = guess.units_of_positions, [logs.unit_factor(text) for text in guess.units_of_positions]
    servos = servos_of(log, inputs, guess.q, units)
    driven = [name for name, servo in zip(guess.q, servos, strict=True) if servo is not None]
    switches = switches_of(log, inputs.switches, driven)
    u = (*inputs.named, *switches)
    return guess._replace(
        u=u,
        left_out=tuple(name for name in log.values if name not in (guess.t, *guess.q, *u, *guess.v)),
        units=guess.units | units_of_commands(log, servos, len(switches), units),
        servos=servos,
        switches=switches,
        remarks=(*guess.remarks, *remarks_on(log, inputs, servos, guess.q, factors)),
    )


def _with_resolution(guess: Draft, log: LogColumns) -> Draft:
    """A draft with the ticks, the periods and the noise of its positions."""
    logged, lengths, n = log.stack(guess.q), guess.lengths, len(guess.q)
    y = logged * [logs.unit_factor(text) for text in guess.units_of_positions]
    seen = [column[np.isfinite(column)] for column in y.T]
    ticks = np.array([logs.Register.of(column).tick for column in seen])
    ticks[[np.median(np.abs(np.diff(x, 2, prepend=x[[0, 0]]))) for x in seen] > HIDDEN * ticks] = 0.0
    # Angles that jump at a full turn have no other period.
    wraps = periods(log[guess.t], y, ticks, tuple(i for i in range(n) if not lengths[i]))
    continuous = unwrap(y, (), wraps)
    tick, noise = tuple(ticks.tolist()) if ticks.all() else None, _noise(continuous, lengths)
    if len(set(lengths)) == 2 or (guess.servos and n > 1):
        noise = tuple(_noise(continuous[:, [i]], lengths[i : i + 1]) for i in range(n))
    if tick is not None and np.ptp(tick) < 10 * SAME_TICK * tick[0]:
        tick = tick[0]
    return guess._replace(quantum=tick, noise=noise, period=tuple(wraps.tolist()))


def _ask_unknown_units(log: LogColumns, fields: Mapping[str, Sequence[str]]) -> None:
    """Ask for the units of columns whose label states one that is none of its field."""
    for field, names in fields.items():
        for name in names:
            text = logs.unknown_unit(log.labels[name], logs.MEANT[field], [log.labels[each] for each in names])
            if text is not None:
                log.questions.append(logs.unknown_unit_fault(name, field, text, log.labels[name] != name, drafted=True))


def _units(
    log: LogColumns, fields: Mapping[str, tuple[str, ...]], span: Float[np.ndarray, "n 2"]
) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """Units of the columns of each field, where they are not those of a model file, and the fields that were guessed.

    `span` (n, 2) is that of the positions, as logged.
    """
    stated = {field: [log.unit(name, field) for name in names] for field, names in fields.items()}
    stated["u"] = [text or log.unit(name, "q") for text, name in zip(stated["u"], fields["u"], strict=True)]
    if (odd := logs.odd_clock(log[log.t], stated["t"][0])) is not None:
        raise InputError(f"column {log.labels[log.t]!r} {odd}")
    content = {"t": "s" if stated["t"][0] else unit_of_time(log, fields["q"])}
    unstated = [width for width, unit in zip(np.ptp(span, axis=1), stated["q"], strict=True) if unit is None]
    content["q"] = "deg" if max(unstated, default=0.0) > DEGREES else "rad"
    units, guessed = {}, []
    for field, named in stated.items():
        if None in named and field in content:
            guessed.append(field)
        texts = tuple(text or (content[field] if field in content else logs.MEANT[field][0]) for text in named)
        if any(logs.unit_factor(text) != 1 for text in texts):
            units[field] = texts
    return units, tuple(field for field in guessed if field in units)


def _one_family(key: str, names: Sequence[str], log: LogColumns) -> None:
    """Raise `ValueError` where names such as q1, q2 and th1, th2 say that there are several kinds of them."""
    stems = {re.sub(r"[0-9]+", "#", name) for name in names}
    if key not in log.given and 1 < len(stems) < len(names):
        raise InputError(f'{", ".join(names)} may all be {key}; name those that are by `columns["{key}"]`{log.listed}')


def _noise(y: np.ndarray, lengths: Sequence[bool]) -> float:
    """Upper bound of the standard deviation of noise, from third differences; a wrapped angle counts as no motion."""
    if len(y) <= 4:
        return 0.0
    steps = np.diff(y, axis=0)
    # A step beyond half a turn is one across the seam of the angle.
    steps = np.where(lengths, steps, steps - 2 * np.pi * np.round(steps / (2 * np.pi)))
    # Third differences of white noise have 1 + 9 + 9 + 1 = 20 times its variance.
    return float(np.sqrt(np.nanmean(np.diff(steps, 2, axis=0) ** 2) / 20))


def _draft_of_ship(log: LogColumns, ship: ShipColumns) -> Draft:
    """Roles of the columns of a log of a ship with rudder and propeller."""
    log = log.labelled({name: "m" for name in ship.pose[:2] if log.unit(name, "q") is None})
    log = log.with_units("t", (log.t,)).with_units("q", ship.pose).with_units("u", ship.u).with_units("v", ship.v)
    _ask_unknown_units(log, {"t": (log.t,), "q": ship.pose})
    guess = _roles_and_units(log, ship.pose, ship.u, ship.v)
    guess = _with_resolution(guess._replace(lengths=(True, True, False)), log)
    x, y, turn = guess.units_of_positions
    position = {"position": (x, y)} if (x, y) != ("m", "m") else {}
    units = {"t": guess.units.get("t", ("s",))} | position | {"angle": (turn,)} | ship.units(log)
    stated = {key: texts for key, texts in units.items() if any(logs.unit_factor(text) != 1 for text in texts)}
    guessed = tuple({"q": "angle"}.get(each, each) for each in guess.guessed)
    return guess._replace(units=stated, guessed=guessed, quantum=None, period=(), is_ship=True)


def _draft_of_attitude(log: LogColumns, names: tuple[str, ...]) -> Draft:
    """Roles of the columns of a log of a body that turns."""
    # A torque about each axis of the body, or none that is known.
    u = log.given.get("u") or log.of("u")
    if "u" in log.given and len(u) not in (0, 3):
        raise InputError(f"{len(u)} inputs ({', '.join(u)}) for a body that turns, needs 3 torques or none")
    u = u if len(u) == 3 else ()
    _ask_unknown_units(log, {"t": (log.t,), "u": u})
    guess, q = _roles_and_units(log, (), u, (), names), log.stack(names)
    # A turn by a small angle changes the quaternion by half of it; q and -q are one attitude.
    signs = np.cumprod(np.sign(np.where(np.nansum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)))
    return guess._replace(noise=2 * _noise(q * np.concatenate([[1.0], signs])[:, None], (True,) * 4))
