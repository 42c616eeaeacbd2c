"""Parsing of options with several numbers: lists of numbers, and ends of named variables."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant._numbers import integer, number

UNITS = {"k": 1024, "m": 1024**2}
Ends = dict[str, tuple[float, float]]


def number_list(option: str, text: str | None) -> list[float] | None:
    """Numbers separated by commas; None where the option is absent. Raises `ValueError` naming the option."""
    if text is None:
        return None
    try:
        return [number(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{option}: {text!r} is not a list of numbers separated by commas") from None


def count_list(option: str, text: str) -> list[int]:
    """Whole numbers separated by commas; raises `ValueError` naming the option."""
    try:
        return [integer(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{option}: {text!r} is not a list of whole numbers separated by commas") from None


def interval_map(option: str, text: str | None) -> dict[str, tuple[float, float]] | None:
    """Low and high ends from `name=low:high`, separated by commas; raises `ValueError` naming the option."""
    if text is None:
        return None
    ends: dict[str, tuple[float, float]] = {}
    for part in text.split(","):
        name, _, pair = (piece.strip() for piece in part.partition("="))
        try:
            low, high = map(number, pair.split(":"))
        except ValueError:
            raise ValueError(f"--{option}: {part!r} does not have the form NAME=LOW:HIGH") from None
        if name in ends:
            raise ValueError(f"--{option}: {name} is given twice; keep one of them")
        ends[name] = low, high
    return ends


def byte_count(option: str, text: str | None) -> int | None:
    """Bytes from a text such as `64k`, `1M` or `65536`, where k is 1024; raises `ValueError` naming the option."""
    if text is None:
        return None
    digits, unit = (text[:-1], text[-1].lower()) if text[-1:].lower() in UNITS else (text, "")
    try:
        count = int(number(digits) * UNITS.get(unit, 1))
    except (ValueError, OverflowError):
        count = 0
    if count <= 0:
        raise ValueError(f"--{option} must be a number of bytes, such as 64k, 1M or 65536; got {text!r}")
    return count


def name_list(text: str | None) -> tuple[str, ...] | None:
    """Names separated by commas; None where the option is absent."""
    return None if text is None else tuple(part.strip() for part in text.split(","))


def ends(option: str, text: str | None, names: Sequence[str], what: str = "state", equal: bool = False) -> Ends:
    """Low and high ends from `name=low:high`, separated by commas; `equal` allows both ends to be the same.

    Raises `ValueError`, one line for the user, naming the option and what is wrong.
    """
    found: Ends = {}
    for part in text.split(",") if text is not None else ():
        name, _, numbers_ = (piece.strip() for piece in part.partition("="))
        try:
            low, high = map(number, numbers_.split(":"))
        except ValueError:
            raise ValueError(f"{option}: {part!r} does not have the form NAME=LOW:HIGH") from None
        if name not in names:
            raise ValueError(f"{option}: there is no {what} {name!r}; the {what}s are {', '.join(names)}")
        if name in found:
            raise ValueError(f"{option}: {name} is given twice; keep one of them")
        if not (math.isfinite(low) and math.isfinite(high) and (low < high or (equal and low == high))):
            raise ValueError(f"{option}: the low end of {name} must be below the high one, both finite; got {numbers_}")
        found[name] = low, high
    return found


def numbers(
    option: str, text: str | None, names: Sequence[str], positive: bool = False, one: bool = False
) -> Float[np.ndarray, "n"] | None:
    """Numbers separated by commas, one for each name; `one` also allows one for all. None where nothing is given.

    Raises `ValueError`, one line for the user, naming the option and what is wrong.
    """
    if text is None:
        return None
    kind = "positive" if positive else "finite"
    try:
        values = np.array([number(part) for part in text.split(",")])
    except ValueError:
        raise ValueError(f"{option}: {text!r} is not a list of numbers separated by commas") from None
    counts = (1, len(names)) if one else (len(names),)
    if len(values) not in counts or not np.isfinite(values).all() or (positive and values.min() <= 0):
        whose = f", for {', '.join(names)}" if names else ""
        needed = "one number, or " if one and len(names) > 1 else ""
        raise ValueError(f"{option} needs {needed}{len(names)} {kind} numbers separated by commas{whose}; got {text!r}")
    return np.full(len(names), values[0]) if len(values) < len(names) else values


def bytes_of(option: str, text: str | None) -> float:
    """The number of bytes that a text such as `64k`, `1M` or `65536` says, where k is 1024; without one, infinity.

    Raises `ValueError` where it says none.
    """
    if text is None:
        return math.inf
    digits, unit = (text[:-1], text[-1].lower()) if text[-1:].lower() in UNITS else (text, "")
    try:
        return above_zero(option, number(digits) * UNITS.get(unit, 1))
    except ValueError:
        raise ValueError(f"{option} must be a number of bytes, such as 64k, 1M or 65536; got {text!r}") from None


def above_zero(option: str, value: float) -> float:
    """The value, unchanged. Raises `ValueError` unless it is a positive number."""
    if not 0 < value < math.inf:
        raise ValueError(f"{option} must be a positive number; got {value}")
    return value
