"""Defines the kinds of keys of a model file: the values that each accepts, and how they are read."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from covariant.models._parameters import ANY_SIGN, POSITIVE, ZERO_OR_MORE
from scalargraph.errors import InputError

_EXPECTED = {POSITIVE: "positive number", ZERO_OR_MORE: "number ≥ 0", ANY_SIGN: "finite number"}

Counts = Mapping[str, int]
"""Length of a list with one number for each "coordinate", "velocity", "state" or "input", or for each "component" of an
error of measured configurations; 0 if the model has none."""


@dataclass(frozen=True)
class Number:
    """A key for a number, or for a list with one number for each coordinate, state or input.

    Attributes:
        path: Table and key, as in an override.
        least: `POSITIVE`, `ZERO_OR_MORE` or `ANY_SIGN`.
        each: The things that may have a number each; only a state-space model has states.
        replaces: Keys of the table that state the same in another way; an override of this key removes them.
        whole: Whether it must be an integer.
    """

    path: str
    least: float = POSITIVE
    each: Literal["", "coordinate", "component", "velocity", "state", "input"] = ""
    replaces: tuple[str, ...] = ()
    whole: bool = False

    @property
    def _one(self) -> str:
        return ("whole " if self.whole else "") + _EXPECTED[self.least]

    @property
    def values(self) -> str:
        """Values that are accepted."""
        return self._one + (f", or a list with one for each {self.each}" if self.each else "")

    def read(self, value: object, counts: Counts) -> float | tuple[float, ...]:
        """Read the number or numbers of a document; raises `ValueError` for invalid ones."""
        if self.each == "state" and not counts["state"]:
            raise InputError(f"{self.path} is for a state-space model, and this one is mechanical")
        if not self.each or not isinstance(value, list):
            return self.checked(value)
        if len(value) != counts[self.each]:
            count = counts[self.each]
            raise InputError(f"{self.path} lists {len(value)} numbers; give {count}, or one number without brackets")
        return tuple(map(self.checked, value))

    def checked(self, value: Any) -> float:
        """Check one number; raises `ValueError` if it is not a number, or out of its range."""
        numeric = isinstance(value, int | float) and not isinstance(value, bool)  # True is an int in Python
        if not numeric or not self.least <= value <= sys.float_info.max or (self.whole and value % 1):
            raise InputError(f"{self.path} must be a {self._one}; got {value!r}")
        return float(value)


@dataclass(frozen=True)
class Choice:
    """A key for one of several words."""

    path: str
    words: tuple[str, ...]
    replaces = ()

    @property
    def values(self) -> str:
        """Values that are accepted."""
        return "one of " + ", ".join(map(repr, self.words))

    def read(self, value: Any, counts: Counts) -> str:
        """Read the word of a document; raises `ValueError` for any other."""
        if value not in self.words:
            raise InputError(f"{self.path} must be {self.values}; got {value!r}")
        return value


@dataclass(frozen=True)
class Deviations:
    """A key for relative standard deviations of numbers of [parameters], by name."""

    path: str
    replaces = ()
    values = "positive number for each name"

    def read(self, value: object, counts: Counts) -> dict[str, float]:
        """Read the deviations of a document; raises `ValueError` for invalid ones."""
        if not isinstance(value, dict):
            raise InputError(
                f"{self.path} must name numbers of [parameters], each with the standard deviation of its relative "
                f'error, as in {{"mass[0]" = 0.3}}; got {value!r}'
            )
        if value and counts["state"]:
            raise InputError(f"{self.path} is for a mechanical model, and this one is a state-space model")
        return {name: Number(f"{self.path}.{name}").checked(entry) for name, entry in value.items()}


Key = Number | Choice | Deviations
"""A key of a model file."""
