"""Units at the end of the names of columns."""

import re
from collections.abc import Sequence

from covariant.logs._units import check_unit

MEANT = {"t": ("s",), "q": ("rad", "m"), "u": ("N m", "N"), "v": ("rad/s", "m/s")}
MEANT |= {"truth": MEANT["v"], "position": ("m",), "angle": ("rad",)}
"""Units in which the columns of each field are logged where a model file says nothing else."""
_SUFFIXES = "deg|degrees|rad|turns?|rev|rpm|deg_s|rad_s|m|mm|cm|m_s|mm_s|s|sec|ms|us|ns|N|mN|kN|Nm|mNm"
_IN_NAME = re.compile(rf"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$|_({_SUFFIXES})$")
"""The unit at the end of the name of a column, as in `q1 [deg]`, `time (ms)`, `angle_deg` or `cart_m`."""
_TURNS = {"th", "theta", "phi", "psi", "angle", "ang"}
"""Words of angles: theta_m is the angle of a motor, not a length."""
_PLAIN = {"degrees": "deg", "deg/sec": "deg/s", "rad/sec": "rad/s", "seconds": "s", "degree": "deg"}


def unit_in_name(name: str, meant: Sequence[str]) -> str | None:
    """The unit that the name of a column ends with, where it is of one of the kinds that are meant; otherwise None.

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
    text = _PLAIN.get(text, text).replace("_", "/")
    is_number = re.fullmatch(r"[-+.0-9e]*", text)  # q(1) is a name
    return text if not is_number and any(_fits(text, unit) for unit in meant) else None


def without_unit(name: str) -> str:
    """A name without the unit at its end."""
    return _IN_NAME.sub("", name).strip()


def words_of(name: str) -> set[str]:
    """The words in a name, in lower case."""
    return set(re.findall(r"[a-z]+", name.lower()))


def _fits(text: str, meant: str) -> bool:
    try:
        check_unit(text, meant)
    except ValueError:
        return False
    return True
