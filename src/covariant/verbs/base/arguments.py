"""Checks of the numbers that verbs take: how many, of which sign, for which names. One line names what is wrong."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant._names import unknown
from scalargraph.errors import InputError

Region = Mapping[str, Sequence[float | int]]
"""Low and high ends of coordinates by name, such as `{"theta": (-1.0, 1.0)}`."""
Amounts = float | int | Sequence[Any] | np.ndarray
"""A number, or numbers."""
Overrides = Sequence[str] | Mapping[str, Any]
"""Values that replace those of a model file, as for `models.load`, for verbs that check before they load."""
OverridesOfLogs = Overrides | Sequence[Mapping[str, Any]]
"""`Overrides` for all logs, or a mapping for each of several logs."""
Scheduler = Any
"""Address of the scheduler of a Dask cluster, or a `distributed.Client`."""
GAINS = {"alpha": "1/s", "beta": "1/s²", "speed": "unit/s"}
"""Gains that a verb takes, with the bound of the speeds that belongs to them, and their units."""
ColumnNames = Mapping[str, str | Sequence[str] | None]
"""Columns of a log for the fields t, q, u, v and truth: names, or one text with names separated by commas."""


def numbers(
    argument: str, given: Amounts, names: Sequence[str], *, positive: bool = False, one: bool = False
) -> Float[np.ndarray, "n"]:
    """Convert an argument to one number for each name.

    Args:
        argument: The argument that holds the numbers, for messages.
        given: A number or numbers.
        names: What the numbers are for, n names.
        positive: Whether the numbers must be positive; otherwise they must be finite.
        one: Whether one number also stands for all names.

    Returns:
        The numbers (n,).

    Raises:
        ValueError: One line that names the argument, and what is needed.

    Example:
        >>> numbers("velocity", 2.0, ("shoulder", "elbow"), positive=True, one=True)
        array([2., 2.])
    """
    values = _values(argument, given)
    counts = (1, len(names)) if one else (len(names),)
    fits = values.ndim == 1 and len(values) in counts
    # `initial`: a model without inputs has no number here, and an empty array has no minimum.
    if not fits or not np.isfinite(values).all() or (positive and values.min(initial=1.0) <= 0):
        whose = f", for {', '.join(names)}" if names else ""
        needed = "one number, or " if one and len(names) > 1 else ""
        kind = "positive" if positive else "finite"
        raise InputError(f"{argument} needs {needed}{len(names)} {kind} numbers{whose}; got {_format_values(values)}")
    return np.full(len(names), values[0]) if len(values) < len(names) else values


def finite(argument: str, given: Amounts | None) -> None:
    """Check that an argument is finite numbers, of any count, or None."""
    values = _values(argument, 0.0 if given is None else given)
    if not np.isfinite(values).all():
        raise InputError(f"{argument} must be finite numbers; got {_format_values(values)}")


def amounts(argument: str, given: Amounts, names: Sequence[str]) -> Float[np.ndarray, "n"]:
    """Convert an argument to one bound ≥ 0 for each name."""
    finite(argument, given)
    limits = numbers(argument, given, names, one=True)
    # As above: there may be no bound at all.
    if limits.min(initial=0.0) < 0:
        raise InputError(f"{argument}: bounds must not be negative; got {_format_values(limits)}")
    return limits


def bounds(
    argument: str, given: Region, names: Sequence[str], what: str = "state", *, equal: bool = False
) -> dict[str, tuple[float, float]]:
    """Convert an argument to low and high ends by name."""
    intervals = {}
    for name, pair in given.items():
        if name not in names:
            raise InputError(f"{argument}: {unknown(what, name, names)}")
        ends = numbers(f"{argument} {name}", pair, ("the low end", "the high end"))
        low, high = float(ends[0]), float(ends[1])
        if not (low < high or (equal and low == high)):
            raise InputError(f"{argument}: the low end of {name} must be below the high one; got {low:g} and {high:g}")
        intervals[name] = low, high
    return intervals


def above_zero(argument: str, value: float | int) -> float:
    """Check that an argument is a positive finite number."""
    if not 0 < value < math.inf:  # false for NaN too
        raise InputError(f"{argument} must be a positive number; got {value:g}")
    return float(value)


def given_gains(alpha: Amounts | None, beta: Amounts | None, speed: Amounts | None = None) -> dict[str, Any] | None:
    """Check the gains α and β, which belong together, and the speed that belongs to them: numbers, or arrays (n,)."""
    given = {name: each for name, each in zip(GAINS, (alpha, beta, speed), strict=True) if each is not None}
    if not given:
        return None
    if alpha is None or beta is None:
        raise InputError("`alpha` and `beta` belong together: give both or neither, and `speed` with them alone")
    values = [_values(name, value) for name, value in given.items()]
    if not all(each.ndim == 1 and each.size and ((each > 0) & (each < math.inf)).all() for each in values):
        names, got = (" and ".join(texts) for texts in (map("`{}`".format, given), map(_format_values, values)))
        raise InputError(f"{names} must be positive numbers; got {got}")
    return {name: float(each[0]) if len(each) == 1 else each for name, each in zip(given, values, strict=True)}


def _values(argument: str, given: Amounts) -> Float[np.ndarray, "..."]:
    try:
        return np.atleast_1d(np.asarray(given, float))
    except (TypeError, ValueError):
        raise InputError(f"{argument}: {given!r} is not a list of numbers") from None


def _format_values(values: Float[np.ndarray, "..."]) -> str:
    return ", ".join(f"{value:g}" for value in values.ravel()) or "none"
