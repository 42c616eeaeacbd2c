"""Columns of a log, and their roles by their names."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

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
from covariant.logs import KNOWN, MEANT, is_unit_of, unit_in_name, words_of
from scalargraph.errors import InputError

_WORDS = {
    "left out": "true truth raw error errors err limit limits",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq effort force motor input",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x",
}
"""Words in the names of columns, by role; the first role with a match counts."""
REGISTERS = {
    "current": "current currents amp amps ampere",
    "load": "load loads pwm duty",
    "voltage": "volt volts voltage voltages",
    "temperature": "temp temperature temperatures",
}
"""Words of registers of a drive, by what they hold; none of these is a torque."""


def role(name: str, entry: str = "") -> str:
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
    """

    values: Mapping[str, np.ndarray]
    labels: Mapping[str, str]
    roles: Mapping[str, str]
    given: Mapping[str, tuple[str, ...]]
    units: Mapping[str, Sequence[str]]
    entries: Mapping[str, str]
    t: str
    clock: Float[np.ndarray, "T"]

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
        for text in texts:
            if not is_unit_of(text, MEANT["q"] if field == "u" else MEANT[field]) and not is_unit_of(
                text, MEANT[field]
            ):
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

    def is_slope(self, position: str, name: str) -> bool:
        """Whether a column follows the slope of a position."""
        v, slope = self.values[name], np.gradient(self.values[position], self.clock)
        valid = np.isfinite(slope) & np.isfinite(v)
        if valid.sum() < 10 or np.ptp(v[valid]) == 0 or np.ptp(slope[valid]) == 0:
            return False
        return bool(np.corrcoef(slope[valid], v[valid])[0, 1] > SAME)

    @property
    def listed(self) -> str:
        """The end of a message that lists the columns."""
        return f"; the columns of numbers are {', '.join(self.values) or 'none'}"
