"""Columns of a log, and their roles by their names."""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._commands import (
    COMMANDS,
    POSITIONS,
    SAME,
    TARGETS,
    TORQUES,
    Following,
    follow,
)
from covariant.calibration.identification._names import ACTUATORS, AXES, FEED_FORWARD, REGISTERS, WORDS
from covariant.logs import KNOWN, MEANT, is_unit_of, unit_factor, unit_in_name, words_of
from scalargraph.errors import InputError

T = TypeVar("T")


def role(name: str, entry: str = "") -> str:
    """Role of a column by its name, a key of `WORDS`: by its words, else by its unit; empty where neither shows it.

    Of a drive it may be a "command" of its position, a "feed-forward" torque beside it, the "switch" of its torque, or
    one of `REGISTERS`. `entry` is what
    the log calls the entry of a list, whose column says that it is a state or an action.
    """
    words = words_of(f"{name} {entry}")
    if words & set(WORDS["left out"].split()):
        return "left out"
    if words & {"enable", "enabled"}:
        return "switch"
    register = next((kind for kind, synonyms in REGISTERS.items() if words & set(synonyms.split())), "")
    if words & AXES or (words & {"q", "d"} and (register == "current" or words & {"i", "u"})):
        return register or "current"  # of the axes of a motor, and no joint
    is_rate = bool(words & set(WORDS["v"].split())) or unit_in_name(name, MEANT["v"]) is not None
    is_torque = bool(words & TORQUES) or unit_in_name(name, MEANT["u"]) is not None
    if words & ACTUATORS and not words & set(WORDS["v"].split()):
        return "u"
    if is_torque and words & FEED_FORWARD:
        return "feed-forward"
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
    by_unit = next((kind for kind in ("v", "u", *MEANT) if unit_in_name(name, MEANT[kind])), "")
    # A unit of velocity decides, whatever the words: q1 [rad/s] is no position.
    if by_unit in ("v", "u"):
        return by_unit
    return next((kind for kind, synonyms in WORDS.items() if words & set(synonyms.split())), by_unit)


@dataclasses.dataclass(frozen=True)
class LogColumns:
    """Columns of a log, and what is known of them before any is looked at.

    Attributes:
        values: The columns (T,) by name, numbers only.
        labels: Their names, with units that the log or the user states.
        roles: Roles by name, of the columns that the user does not name.
        given: Names by the field t, q, u or v that the user states.
        units: Units by field that the user states: one, or one for each column.
        entries: What the log calls the entries of lists, by column.
        t: Name of the stamps.
        clock: The stamps (T,) [s].
        product: Drive or program that gave the names, "" for none.
        questions: What cannot be told of the columns, to be asked at once.
    """

    values: Mapping[str, np.ndarray]
    labels: Mapping[str, str]
    roles: Mapping[str, str]
    given: Mapping[str, tuple[str, ...]]
    units: Mapping[str, Sequence[str]]
    entries: Mapping[str, str]
    t: str
    clock: Float[np.ndarray, "T"]
    product: str = ""
    questions: list[str] = dataclasses.field(default_factory=list)

    def ask(self, ask: Callable[..., T], *arguments: Any, otherwise: T) -> T:
        """What a function tells of the columns; its question is kept, and `otherwise` is taken, where it refuses."""
        try:
            return ask(*arguments)
        except InputError as error:
            self.questions.extend({str(error)} - set(self.questions))
            return otherwise

    def __getitem__(self, name: str) -> Float[np.ndarray, "T"]:
        return self.values[name]

    def stack(self, names: Sequence[str]) -> Float[np.ndarray, "T n"]:
        return np.column_stack([self.values[name] for name in names])

    def of(self, role: str) -> tuple[str, ...]:
        """Names of the columns of a role, without the stamps."""
        return tuple(name for name, each in self.roles.items() if each == role and name != self.t)

    def unit(self, name: str, field: str) -> str | None:
        """The unit that the label of a column states, if it is one of a field."""
        return unit_in_name(self.labels[name], MEANT[field])

    def with_units(self, field: str, names: Sequence[str]) -> "LogColumns":
        """The columns with the units that the user gives for these."""
        texts = self.units.get(field, ())
        if not texts or not names:
            return self
        if len(texts) not in (1, len(names)):
            raise InputError(
                f"{len(texts)} units are given for {field}, which has {len(names)} columns ({', '.join(names)})"
            )
        meant = (*MEANT[field], *(MEANT["q"] if field == "u" else ()))
        for text in texts:
            if not is_unit_of(text, meant):
                raise InputError(
                    f"unit {text!r} is no unit of {field}; known are {KNOWN[field][0]}, as {KNOWN[field][1]}"
                )
        return self.labelled(dict(zip(names, texts if len(texts) > 1 else [texts[0]] * len(names), strict=True)))

    def labelled(self, units: Mapping[str, str]) -> "LogColumns":
        """The columns with units by name."""
        labels = {name: f"{name} [{unit}]" for name, unit in units.items()}
        return dataclasses.replace(self, labels={**self.labels, **labels})

    def follow(self, position: str, command: str, on: np.ndarray | None = None) -> Following | None:
        """How a position follows a command, in the rows (T,) in which the servo is switched on."""
        return follow(self.clock, self.values[position], self.values[command], on)

    def slope_ratio(self, position: str, name: str) -> float | None:
        """How many times the slope of a position a column is, in their units; None where it does not follow it."""
        turn = 2 * np.pi / unit_factor(self.unit(position, "q") or "rad")
        turns = np.append(0.0, np.cumsum(np.rint(np.nan_to_num(np.diff(self.values[position])) / turn)))
        v, slope = self.values[name], np.gradient(self.values[position] - turn * turns, self.clock)
        valid = np.isfinite(slope) & np.isfinite(v)
        if valid.sum() < 10 or np.ptp(v[valid]) == 0 or np.ptp(slope[valid]) == 0:
            return None
        if np.abs(np.corrcoef(slope[valid], v[valid])[0, 1]) < SAME:
            return None
        units = unit_factor(self.unit(name, "v") or "rad/s") / unit_factor(self.unit(position, "q") or "rad")
        return units * float(slope[valid] @ v[valid]) / float(slope[valid] @ slope[valid])

    def is_slope(self, position: str, name: str) -> bool:
        """Whether a column follows the slope of a position."""
        ratio = self.slope_ratio(position, name)
        return ratio is not None and ratio > 0

    @property
    def listed(self) -> str:
        """The end of a message that lists the columns."""
        return f"; the columns of numbers are {', '.join(self.values) or 'none'}"
