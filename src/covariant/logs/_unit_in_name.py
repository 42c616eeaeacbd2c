"""Units at the end of the names of columns."""

import contextlib
import re
from collections.abc import Sequence

from covariant.logs._units import check_unit

MEANT = {"t": ("s",), "q": ("rad", "m"), "u": ("N m", "N"), "v": ("rad/s", "m/s")}
MEANT |= {"truth": MEANT["v"], "position": ("m",), "angle": ("rad",)}
"""Units in which the columns of each field are logged unless the model file states others."""
_PLAIN = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad", "rads", "radian", "radians"), "rad"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"), "ns"),
    **{f"{turn}/{per}": f"{turn}/s" for turn in ("deg", "rad") for per in ("s", "sec")},
    "mrad": "mrad",
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("newton", "newtons"), "N"),
}
"""How people write units, in lower case, and how they are written here."""
_SUFFIXES = (
    *_PLAIN,
    *("turn", "turns", "rev", "rpm", "deg_s", "rad_s", "m", "mm", "cm", "um", "km", "m_s", "mm_s"),
    *("N", "mN", "kN", "Nm", "mNm"),
)
_IN_NAME = re.compile(
    rf"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$|[_ ]({'|'.join(_SUFFIXES)}|(?i:{'|'.join(_PLAIN)}))$",
)
"""The unit at the end of the name of a column, as in `q1 [deg]`, `time (ms)`, `time ms`, `angle_deg` or `cart_m`."""
_BRACKETS = re.compile(r"(?P<stem>.*?)(?P<space>\s*)(?:\[(?P<square>[^\[\]()]*)\]|\((?P<round>[^\[\]()]*)\))\s*$")
"""A name with something in brackets at its end."""
_INDEX = re.compile(r"[-+.,:;\s0-9e]*")
"""What is in the brackets of q[0], q[0, 1] and q(1)."""
_NO_UNITS = {"%", "adc", "bit", "bits", "cnt", "cnts", "count", "counts", "encoder counts", "inc", "increments", "lsb"}
_NO_UNITS |= {"percent", "pct", "permille", "pulse", "pulses", "pwm", "raw counts", "step", "steps", "tick", "ticks"}
"""What people write in the place of a unit for a number whose size depends on the machine."""
KNOWN = {
    "t": ("s, ms, us, ns, min, h", 't = "0.01 s" for samples of 10 ms'),
    "q": ("rad, mrad, deg, turn, rev and m, mm, cm", 'q = "turn/4096" for ticks of a 4096th of a turn'),
    "u": ("N m, mN m and N, kN", 'u = "0.05 N m" where one of it makes 0.05 N m'),
    "v": ("rad/s, deg/s, rpm and m/s, mm/s", 'v = "turn/4096/s" for ticks of a 4096th of a turn a second'),
    "truth": ("rad/s, deg/s, rpm and m/s, mm/s", 'truth = "deg/s"'),
    "position": ("m, mm, cm", 'position = "0.0254 m" for inches'),
    "angle": ("rad, mrad, deg, turn, rev", 'angle = "turn/4096" for ticks of a 4096th of a turn'),
}
"""Units of the columns of each field, and how a model file states another one under [units]."""
_TURNS = {"th", "theta", "phi", "psi", "angle", "ang"}
"""Words of angles: theta_m is the angle of a motor, not a length."""


def unit_in_name(name: str, meant: Sequence[str]) -> str | None:
    """Unit at the end of the name of a column.

    Args:
        name: Name of a column, as "q1 [deg]" or "time_ms".
        meant: Units of the quantities that the column may hold, as `("rad", "m")`.

    Returns:
        The unit, where it is of one of these kinds; otherwise None.

    Example:
        >>> from covariant.logs import unit_in_name
        >>> unit_in_name("q1 [deg]", ("rad", "m")), unit_in_name("time_ms", ("s",)), unit_in_name("q1", ("rad", "m"))
        ('deg', 'ms', None)
    """
    match = _IN_NAME.search(name)
    if match is None:
        return None
    text = match[1] or match[2]
    if match[2] == "m" and _TURNS & words_of(name):
        return None
    text = _PLAIN.get(text.lower(), text).replace("_", "/")
    if not is_unit_of(text, meant):  # degrees/s, newton meters
        text = re.sub(r"[^\W\d_]+", lambda word: _PLAIN.get(word[0].lower(), word[0]), text)
    return text if not _INDEX.fullmatch(text) and is_unit_of(text, meant) else None


def unknown_unit(name: str, meant: Sequence[str], others: Sequence[str] = ()) -> str | None:
    """Text in brackets at the end of the name of a column that stands for a unit, and is none of its quantity.

    An index, as in `position[1]`, is none, nor are keys, as in `position[hip]` beside `position[knee]`, nor is a remark
    in round brackets, as in `q (left)`, unless it is another unit or a number of ticks, counts or per cent.

    Args:
        name: Name of a column, as "q1 [ticks]".
        meant: Units of the quantities that the column may hold.
        others: Names of all columns of the same field.

    Returns:
        The text; None where the name states no unit, or a known one.

    Example:
        >>> from covariant.logs import unknown_unit
        >>> [unknown_unit(name, ("rad", "m")) for name in ("q1 [ticks]", "q1 [deg]", "q[1]")]
        ['ticks', None, None]
    """
    match = _BRACKETS.fullmatch(name)
    if match is None or not meant or unit_in_name(name, meant) is not None:
        return None
    text = (match["square"] if match["square"] is not None else match["round"]).strip()
    if _INDEX.fullmatch(text):
        return None
    is_unit = text.lower() in _NO_UNITS or _is_any_unit(text)
    if match["round"] is not None or not match["stem"]:
        return text if is_unit else None
    stems = [other.group("stem", "square") for other in map(_BRACKETS.fullmatch, others) if other is not None]
    keys = {key for stem, key in stems if stem == match["stem"]}
    return text if is_unit or match["space"] or len(keys) < 2 else None


def unknown_unit_fault(
    field: str, text: str, stated: bool = False, drafted: bool = False, sensor: str | None = None
) -> str:
    """The end of an error message: what units a field has, and what to do about another one.

    Args:
        field: A key of `KNOWN`.
        text: The unit that is not known.
        stated: Whether it is stated by the log itself, and not in the name of the column.
        drafted: Whether the model file is still to be drafted.
        sensor: SI unit of the readings of a sensor, which the columns are of; None for a field.

    Example:
        >>> from covariant.logs import unknown_unit_fault
        >>> unknown_unit_fault("t", "frames").partition(". ")[0]
        "has 'frames' in brackets, which is no unit of t here; known are s, ms, us, ns, min, h"
    """
    where = "its attributes" if stated else "brackets"
    if sensor is not None:
        return (
            f"has {text!r} in {where}, which is no unit of what is measured in {sensor}; write what one of it is, as "
            f'units = "0.1 {sensor}" in the table of the sensor, or rename the column'
        )
    known, example = KNOWN[field]
    own = (
        f', or {field} = "{text}" where the model takes it in that unit' if field != "t" and _is_any_unit(text) else ""
    )
    remedy = (
        f"Rename the column, and write what one of it is under [units] of the draft, as {example}{own}"
        if drafted
        else f"Write what one of it is under [units] of the model file, as {example}{own}, or rename the column"
    )
    return f"has {text!r} in {where}, which is no unit of {field} here; known are {known}. {remedy}"


def _is_any_unit(text: str) -> bool:
    with contextlib.suppress(ValueError):
        check_unit(text, "")
        return True
    return False


def without_unit(name: str) -> str:
    """Name of a column without the unit at its end.

    Example:
        >>> from covariant.logs import without_unit
        >>> without_unit("q1 [deg]")
        'q1'
    """
    return _IN_NAME.sub("", name).strip()


def words_of(name: str) -> set[str]:
    """Words in a name, in lower case.

    Example:
        >>> from covariant.logs import words_of
        >>> sorted(words_of("Motor_angle 2"))
        ['angle', 'motor']
    """
    return set(re.findall(r"[a-z]+", name.lower()))


def is_unit_of(text: str, meant: Sequence[str]) -> bool:
    """Whether a text is a unit of the same kind as one of several units."""
    for unit in meant:
        with contextlib.suppress(ValueError):
            check_unit(text, unit)
            return True
    return False
