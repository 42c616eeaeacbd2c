"""Converts units of the columns of a log: the factor from a unit to SI units and radians."""

import math
import re
from typing import NamedTuple

from covariant._numbers import DECIMAL
from scalargraph.errors import InputError


class _Unit(NamedTuple):
    """A unit: factor and exponents of s, rad, m, kg and A; exponents None for a bare number, which fits any unit."""

    factor: float
    exponents: tuple[int, ...] | None


_NEWTON, _JOULE = (-2, 0, 1, 1, 0), (-2, 0, 2, 1, 0)
_SYMBOLS = {
    "s": _Unit(1.0, (1, 0, 0, 0, 0)),
    "sec": _Unit(1.0, (1, 0, 0, 0, 0)),
    "min": _Unit(60.0, (1, 0, 0, 0, 0)),
    "h": _Unit(3600.0, (1, 0, 0, 0, 0)),
    "Hz": _Unit(1.0, (-1, 0, 0, 0, 0)),
    "rad": _Unit(1.0, (0, 1, 0, 0, 0)),
    "deg": _Unit(math.pi / 180, (0, 1, 0, 0, 0)),
    "°": _Unit(math.pi / 180, (0, 1, 0, 0, 0)),
    "turn": _Unit(2 * math.pi, (0, 1, 0, 0, 0)),
    "turns": _Unit(2 * math.pi, (0, 1, 0, 0, 0)),
    "rev": _Unit(2 * math.pi, (0, 1, 0, 0, 0)),
    "rpm": _Unit(2 * math.pi / 60, (-1, 1, 0, 0, 0)),
    "m": _Unit(1.0, (0, 0, 1, 0, 0)),
    "g": _Unit(1e-3, (0, 0, 0, 1, 0)),
    "N": _Unit(1.0, _NEWTON),
    "Nm": _Unit(1.0, _JOULE),
    "J": _Unit(1.0, _JOULE),
    "W": _Unit(1.0, (-3, 0, 2, 1, 0)),
    "Pa": _Unit(1.0, (-2, 0, -1, 1, 0)),
    "bar": _Unit(1e5, (-2, 0, -1, 1, 0)),
    "A": _Unit(1.0, (0, 0, 0, 0, 1)),
    "V": _Unit(1.0, (-3, 0, 2, 1, -1)),
}
_PREFIXED = ("s", "rad", "m", "g", "Hz", "N", "Nm", "J", "W", "Pa", "A", "V")
_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_POWERS = {"": 1, "2": 2, "²": 2, "3": 3, "³": 3}
_FACTOR = re.compile(rf"(?P<number>{DECIMAL})|(?P<symbol>[^\W\d_²³]+|°)(?P<power>\^?[23]|[²³])?")


def _unit(text: str) -> _Unit:
    """Parse a unit: factors are multiplied, and a slash divides by the next one; raises `ValueError`."""
    size, exponents, has_symbol, rest, sign = 1.0, [0] * 5, False, text.strip(), 1
    while rest or sign < 0 or not text.strip():
        match = _FACTOR.match(rest)
        part = None if match is None else _part(match)
        if match is None or part is None:
            raise InputError(
                f"unit {text!r} is not understood at {rest[:12]!r}; write it as in ms, us, deg, deg/s, mm, mN m, "
                "turn/4096 for ticks of a 4096th of a turn, or -1 N m for the other sign"
            )
        # A slash divides by the next factor only. A zero divisor becomes infinity, which the check below refuses.
        size *= part.factor if sign > 0 else 1 / (part.factor or math.inf)
        if part.exponents is not None:
            has_symbol = True
            exponents = [e + sign * more for e, more in zip(exponents, part.exponents, strict=True)]
        rest, sign = rest[match.end() :].strip(), 1
        if rest[:1] in ("/", "*", "·"):
            sign, rest = -1 if rest[0] == "/" else 1, rest[1:].strip()
    if not size or not math.isfinite(size):
        raise InputError(f"unit {text!r} is {size:g}; a unit must be a finite number other than zero")
    return _Unit(size, tuple(exponents) if has_symbol else None)


def _part(match: re.Match[str]) -> _Unit | None:
    """The unit of one factor of a text; None if no unit has this name."""
    if match["number"]:
        return _Unit(float(match["number"]), None)
    name, power = match["symbol"], _POWERS[(match["power"] or "").removeprefix("^")]
    base = _SYMBOLS.get(name)
    if base is None and name[1:] in _PREFIXED and name[0] in _PREFIXES:
        base = _SYMBOLS[name[1:]]
        base = base._replace(factor=base.factor * _PREFIXES[name[0]])
    if base is None or base.exponents is None:
        return None
    # A power applies to the prefix too: mm² is (mm)², SI Brochure, section 3.
    return _Unit(base.factor**power, tuple(power * e for e in base.exponents))


def unit_factor(text: str) -> float:
    """Factor that converts a number in a unit to SI units and radians.

    Args:
        text: The unit: `ms`, `deg/s`, `mN m`, `turn/4096` for ticks of a 4096th of a turn, `-1 N m` for the opposite
            sign, or a bare number, `1e-3`.

    Returns:
        The factor, finite and not zero.

    Raises:
        ValueError: The text is not a unit; the message is one line that quotes it.

    Example:
        >>> from covariant.logs import unit_factor
        >>> unit_factor("ms"), unit_factor("-1 mN m"), round(unit_factor("turn/4096"), 6)
        (0.001, -0.001, 0.001534)
    """
    return _unit(text).factor


def check_unit(text: str, wanted: str) -> None:
    """Check that a unit measures the same kind of quantity as another.

    A bare number fits any unit, and any unit fits if `wanted` is unknown.

    Args:
        text: The unit.
        wanted: A unit of the kind that is needed.

    Raises:
        ValueError: The text is not a unit, or the unit is of another kind.

    Example:
        >>> from covariant.logs import check_unit
        >>> check_unit("deg", "rad")
        >>> check_unit("mm", "rad")
        Traceback (most recent call last):
        scalargraph.errors.InputError: unit 'mm' is no unit of what is measured in rad
    """
    parsed = _unit(text)
    try:
        needed = _unit(wanted)
    except InputError:
        return
    if None not in (parsed.exponents, needed.exponents) and parsed.exponents != needed.exponents:
        raise InputError(f"unit {text!r} is no unit of what is measured in {wanted}")
