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
}
"""How people write units of angles and time, in lower case, and how they are written here."""
_SUFFIXES = (
    *_PLAIN,
    *("turn", "turns", "rev", "rpm", "deg_s", "rad_s", "m", "mm", "cm", "um", "km", "m_s", "mm_s"),
    *("N", "mN", "kN", "Nm", "mNm"),
)
_IN_NAME = re.compile(
    rf"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$|[_ ]({'|'.join(_SUFFIXES)}|(?i:{'|'.join(_PLAIN)}))$",
)
"""The unit at the end of the name of a column, as in `q1 [deg]`, `time (ms)`, `time ms`, `angle_deg` or `cart_m`."""
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
    is_number = re.fullmatch(r"[-+.0-9e]*", text)  # q(1) is a name
    return text if not is_number and is_unit_of(text, meant) else None


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
    """Whether a text is a unit of the same kind as one of several units.

    Args:
        text: A unit, as "deg/s".
        meant: The units it is compared with.
    """
    for unit in meant:
        with contextlib.suppress(ValueError):
            check_unit(text, unit)
            return True
    return False
