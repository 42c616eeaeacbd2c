"""Recognises units in the names of columns, in the ways in which people write them."""

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from covariant.logs._units import check_unit
from scalargraph.errors import InputError

MEANT = {"t": ("s",), "q": ("rad", "m"), "u": ("N m", "N"), "v": ("rad/s", "m/s")}
MEANT |= {"truth": (*MEANT["v"], *MEANT["u"]), "position": ("m",), "angle": ("rad",)}
"""Units of each field unless the model file states others; `truth` may hold velocities or, for scoring, forces."""
_PLAIN = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "º"), "deg"),
    **dict.fromkeys(("rad", "rads", "radian", "radians"), "rad"),
    **dict.fromkeys(("mrad", "mrads"), "mrad"),
    **dict.fromkeys(("turn", "turns", "rev", "revs", "revolution", "revolutions", "rotations"), "turn"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "milli", "millis"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micro", "micros"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nano", "nanos"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "day", "days"), "24 h"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **{"mm": "mm", "cm": "cm", "um": "um", "µm": "um", "μm": "um", "microns": "um", "km": "km"},
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("nm", "newtonmeter", "newtonmeters", "newtonmetre", "newtonmetres"), "N m"),
    **{"mnm": "mN m", "ncm": "N cm", "nmm": "N mm", "knm": "kN m"},
    **{"rpm": "rpm", "r/min": "rpm", "1/min": "rpm", "dps": "deg/s", "mdps": "1e-3 deg/s", "rps": "turn/s"},
    **{"mps": "m/s", "kmh": "km/h", "kph": "km/h", "degsec": "deg/s", "radsec": "rad/s"},
    "g": "9.80665 m/s^2",
    **dict.fromkeys(("amp", "amps", "ampere", "amperes"), "A"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("watt", "watts"), "W"),
}
"""Common spellings of units, in lower case, and the library's spelling; `nm` is a torque unless a length is meant."""
_PREFIXES = {"milli": ("m", 1e-3), "micro": ("u", 1e-6), "nano": ("n", 1e-9), "centi": ("c", 1e-2), "kilo": ("k", 1e3)}
_PLAIN |= {
    prefix + word: f"{symbol}{unit}"
    for prefix, (symbol, _) in _PREFIXES.items()
    for word, unit in _PLAIN.items()
    if len(word) > 2 and unit in ("s", "m", "rad", "N", "N m", "A", "V", "W")
}
_PLAIN |= {
    written + word: f"{size:g} deg"
    for prefix, (symbol, size) in _PREFIXES.items()
    for written in (prefix, symbol)
    for word in ("deg", "degs", "degree", "degrees")
}
_RATES = {"degs": "deg/s", "rads": "rad/s"}
"""Spellings of velocity units that are also spellings of angle units."""
_NO_UNITS = {"%", "adc", "bit", "bits", "cnt", "cnts", "count", "counts", "cts", "cycles", "erpm", "inc", "increments"}
_NO_UNITS |= {"jiffies", "lsb", "percent", "pct", "permille", "pulse", "pulses", "pwm", "step", "steps"}
_NO_UNITS |= {"tick", "ticks"}
"""Words that people write instead of a unit, for numbers whose size depends on the machine."""
_FOREIGN = {"gon", "grad", "grads", "gradians", "arcmin", "arcsec", "inch", "inches", "feet", "ft", "thou", "mils"}
_FOREIGN |= {"mph", "knots", "week", "weeks", "fortnight", "hhmmss", "quads"}
_WEIGHTS = {"lb", "lbs", "lbf", "pounds", "oz", "ounces", "kg", "kgf", "gf", "dyn", "dynes"}
_FOREIGN |= _WEIGHTS
"""Units that the library does not convert; weights count only in names of forces, since `lb` may also be a leg."""
_EXACT = ("mA", "uA", "µA", "mV", "uV", "kV", "mW", "kW", "mN", "kN", "urad", "µrad")
"""Units that only their capital letters distinguish from other words."""
_LAST = {"turn", "rev", "min", "mins", "hr", "cm", "um", "km", "rps", "mps", "nm", "day", "second", "minute", "hour"}
_LAST |= {"count", "tick", "step", "steps", "pulse", "cnt", "ft", "feet", "grad", "week", "weeks", "mils", "quads"}
_LAST |= {"watt", "volt", "milli", "micro", "nano", "lb", "lbs", "oz", "kg", "gf", "dyn", "thou", "pounds", "cycles"}
"""Words that are a unit only at the end of a name: `cm_x` belongs to a centre of mass."""
_ENDS_OF_RANGES = {"min", "mins"}
"""Units of time that mean something else in names of other columns, such as q_min."""
_ROWS = re.compile(
    r"(?:frame|sample|row|scan|iter|iteration|loop|step|count|counter|index|idx|seq|sequence)"
    r"(?:[_ ]?(?:no|nr|num|number|id|idx|index|count|counter))?|(?:.*[_ ./])?(?:frames|samples|rows|iterations|seq)",
    re.IGNORECASE,
)
"""Names of columns that count rows, used in place of a time."""
_WORDLESS = {"adc", "pwm", "bit", "bits", "inc", "step", "amp"}
"""Of these, words that name the measured quantity, unless they stand in brackets."""


def _alternatives(words: Iterable[str]) -> str:
    """A regular expression that matches the longest of several words."""
    return "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))


_NAMED = {word for word in {*_PLAIN, *_NO_UNITS, *_FOREIGN} - _WORDLESS if len(word) > 1 or not word.isalnum()}
# A word begins after anything but a letter, or with a capital after a small letter, as in qDeg.
_BEGIN, _END = r"(?:(?<![^\W\d_])|(?<=[a-z])(?=[A-Z]))", r"(?:(?![^\W\d_])|(?<=[a-z])(?=[A-Z]))"
_PER = r"(?:[_/ .]|[_ ]?(?i:per)[_ ]?|p)"
_WORD = re.compile(
    rf"{_BEGIN}(?:"
    rf"(?P<over>(?i:{_alternatives(_NAMED - {'nm', 'mins'})})|m(?!ph)){_PER}"
    r"(?P<under>(?i:s|sec|second|min|h|rev|turn))(?P<power>\^?2|²)?"
    r"|(?P<force>[mkcuµM]?N)[-_ .*·]?(?P<arm>[cm]?m)"
    r"|(?P<imperial>(?i:(?:ozf?|lbs?|lbf|kgf?|gf)[-_ .*·]?(?:in|inch|ft|foot|cm|mm|m)"
    r"|(?:in|inch|ft|foot)[-_ .*·]?(?:ozf?|lbs?|lbf)))"
    # Ticks of 10 ms are matched with their number; a digit alone is an index, as in q1deg.
    rf"|(?P<plain>(?<![0-9])10+(?:ms|us|ns)|(?i:{_alternatives(_NAMED)})|{_alternatives(_EXACT)})"
    rf"){_END}"
)
"""A unit among the words of a name, as in `deg_q`, `timeMs`, `q1deg`, `w_deg_per_s` or `torque_N_m`."""
_GLUED = re.compile(
    r"(?:deg|degrees|(?<!e)rpm|msec|usec|nsec|millis|micros|nanos|°|º|%|counts|(?<![aeiou])mm"
    r"|(?<=time|tamp)(?:ms|us|ns)|(?<=[_ ./])(?:hz|amp))$",
    re.IGNORECASE,
)
"""Units glued to a word, as in `pitchdeg`, `timems` and `q°`, or at the end of a name, as in `i_amp`."""
_LETTER = re.compile(r"(?:^|(?<=[_ ./]))[AVWNJmshg]$")
"""A unit of one letter, which must follow a separator: `cart_m`."""
_BRACKETS = re.compile(
    r"(?P<stem>.*?)(?P<space>\s*)"
    r"(?:\[(?P<square>[^\[\]()]*)\]|\((?P<round>[^\[\]()]*)\)|\{(?P<curly>[^{}]*)\}|<(?P<pointed>[^<>]*)>)\s*$"
)
"""A name with something in brackets at its end."""
_INDEX = re.compile(r"(?!.*[0-9]\s*(?:\.\.|-)\s*[0-9])[-+.,:;\s0-9e]*")
"""Content of brackets that is an index, as in q[0], q[0, 1] and q(1); a range as in q [0..4095] is not."""
KNOWN = {
    "t": ("s, ms, us, ns, min, h", 't = "0.01 s" for samples of 10 ms'),
    "q": ("rad, mrad, deg, turn, rev and m, mm, cm", 'q = "turn/4096" for ticks of a 4096th of a turn'),
    "u": ("N m, mN m and N, kN", 'u = "0.05 N m" where one of it makes 0.05 N m'),
    "v": ("rad/s, deg/s, rpm and m/s, mm/s", 'v = "turn/4096/s" for ticks of a 4096th of a turn a second'),
    "truth": ("rad/s, deg/s, rpm and m/s, mm/s", 'truth = "deg/s"'),
    "position": ("m, mm, cm", 'position = "0.0254 m" for inches'),
    "angle": ("rad, mrad, deg, turn, rev", 'angle = "turn/4096" for ticks of a 4096th of a turn'),
}
"""Units of the columns of each field, and how a model file states others under [units]."""
_TURNS = {"th", "theta", "phi", "psi", "angle", "ang"}
"""Words for angles: theta_m is the angle of a motor, not a length."""


def unit_in_name(name: str, meant: Sequence[str]) -> str | None:
    """Unit in the name of a column: in brackets at its end, or among its words.

    Args:
        name: Name of a column, as "q1 [deg]" or "time_ms".
        meant: Units of the quantities that the column may hold, as `("rad", "m")`.

    Returns:
        The unit, if it is of one of these kinds; otherwise None.

    Example:
        >>> from covariant.logs import unit_in_name
        >>> unit_in_name("q1 [deg]", ("rad", "m")), unit_in_name("timeMs", ("s",)), unit_in_name("q1", ("rad", "m"))
        ('deg', 'ms', None)
    """
    for found in _statements(name):
        unit = _unit_of(found.text, meant)
        if unit is not None and not (unit == "m" and _TURNS & words_of(name)):
            return unit
        if found.bracketed and _is_stated(found.text):
            return None  # a text in brackets takes precedence over the words before it
    return None


class _Statement(NamedTuple):
    """A text in the name of a column that may be a unit, its position, and whether it is in brackets."""

    text: str
    start: int
    end: int
    bracketed: bool = False


def _statements(name: str) -> Iterator[_Statement]:
    """Texts in a name that may be units, the likeliest first: the one in brackets, the last word, the words before."""
    brackets = _BRACKETS.fullmatch(name)
    stem = name
    if brackets is not None:
        stem = brackets["stem"]
        whole = _Statement(_content(brackets), len(stem), len(name), bracketed=True)
        # A remark in brackets may contain a unit: q (left, deg).
        yield from (whole, *(whole._replace(text=word.text) for word in _words(whole.text)))
    yield from _words(stem)


def _words(text: str) -> Iterator[_Statement]:
    """The words of a text that may be units, the last one first."""
    words = [_Statement(_written(match), *match.span()) for match in _WORD.finditer(text)]
    for pattern in (_GLUED, _LETTER):
        if not (words and words[-1].end == len(text)) and (match := pattern.search(text)) is not None:
            words.append(_Statement(match[0], *match.span()))
    for word in reversed(words):
        # An index may follow the unit: q_deg_1.
        if word.text.lower() not in _LAST or not re.search(r"[^\W\d_]", text[word.end :]):
            yield word


def _content(brackets: re.Match[str]) -> str:
    return next(text for key, text in brackets.groupdict().items() if key not in ("stem", "space") and text is not None)


def _written(match: re.Match[str]) -> str:
    """A unit that is written among words, with a slash for division and a space for multiplication."""
    if match["over"]:
        return f"{match['over']}/{match['under']}" + ("^2" if match["power"] else "")
    if match["force"]:
        return f"{match['force']} {match['arm']}"
    return match["imperial"] or match["plain"]


def _unit_of(text: str, meant: Sequence[str]) -> str | None:
    """A unit of the same kind as one of several units, in the library's spelling; None if the text is not one."""
    text = text.strip().rstrip(".")
    if _INDEX.fullmatch(text):
        return None
    spaced = re.sub(r"(?<=N)\s*[-_.×]\s*(?=[cm]?m$)", " ", text)
    # For example: deg s^-1.
    divided = re.sub(r"[ ·*.]?\b([^\W\d_]+)(?:\^?[-−]1|⁻¹)", r"/\1", spaced)
    # For example: degrees/s, newton meters.
    by_word = re.sub(r"[^\W\d_]+", lambda word: _PLAIN.get(word[0].lower(), word[0]), divided.replace("_", "/"))
    for unit in (_PLAIN.get(text.lower()), _RATES.get(text.lower()), spaced, by_word):
        if unit is not None and is_unit_of(unit, meant):
            return unit
    return None


def _is_stated(text: str) -> bool:
    """Whether a text means a unit of any kind, whether the library knows it or not."""
    text = text.strip()
    plain = text.lower()
    return bool(text) and (
        plain in _NO_UNITS or plain in _FOREIGN or plain in _PLAIN or _unit_of(text, ("",)) is not None
    )


def unknown_unit(name: str, meant: Sequence[str], others: Sequence[str] = ()) -> str | None:
    """Text in the name of a column that stands for a unit, but not for a known one of its quantity.

    It is in brackets, or the last word of the name. Not counted are an index, as in `position[1]`; keys, as in
    `position[hip]` beside `position[knee]` or `torque_A` beside `torque_B`; and a remark in other brackets, as in
    `q (left)`, unless it contains another unit or a number of ticks, counts or per cent, as in `q (raw ticks)`.

    Args:
        name: Name of a column, as "q1 [ticks]".
        meant: Units of the quantities that the column may hold.
        others: Names of all columns of the same field.

    Returns:
        The text; None if the name states no unit, or a known one.

    Example:
        >>> from covariant.logs import unknown_unit
        >>> [unknown_unit(name, ("rad", "m")) for name in ("q1 [ticks]", "q1_counts", "q1 [deg]", "q[1]")]
        ['ticks', 'counts', None, None]
    """
    if not meant or unit_in_name(name, meant) is not None:
        return None
    match = _BRACKETS.fullmatch(name)
    if match is not None and (text := _content(match).strip()) and not _INDEX.fullmatch(text):
        if match["square"] is None or not match["stem"]:
            # Examples: q (0-4095), q (raw ticks), u (A rms), and t in the letters of another language.
            is_unit = _is_stated(text) or any(_words(text)) or text[0].isdigit()
            is_unit |= not text.isascii() if is_unit_of("s", meant) else re.match(r"[AVW]\W", text) is not None
            return text if is_unit else None
        matches = [other for other in map(_BRACKETS.fullmatch, others) if other and other["stem"] == match["stem"]]
        keys = {other["square"] for other in matches}
        return text if _is_stated(text) or match["space"] or len(keys) < 2 else None
    stem = name if match is None else match["stem"]
    is_time, is_force = is_unit_of("s", meant), is_unit_of("N", meant) or is_unit_of("N m", meant)
    if is_time and _ROWS.fullmatch(stem.strip()):
        return stem.strip()
    for word in _statements(stem):
        is_last = not re.search(r"[^\W\d_]", stem[word.end :])
        if word.text.lower() in _WEIGHTS and not is_force:
            continue
        if len(word.text) > 1 and word.text.lower() not in _ENDS_OF_RANGES:
            if is_last or (not is_time and word.text.lower() in _NO_UNITS):
                return word.text
        elif word.text == "%":
            return word.text
        elif (is_force and word.text in "AVW") or (not is_time and word.text == "V"):
            siblings = [each for each in others if each[:-1] == stem[:-1]]
            # A and V may also be names, such as joints A and B, as other columns show.
            return word.text if all(each[-1:] in "AVW" for each in siblings) else None
    return None


def unknown_unit_fault(
    name: str, field: str, text: str, stated: bool = False, drafted: bool = False, sensor: str | None = None
) -> str:
    """Message of an error: the units that a field may have, and what to do about another one.

    Args:
        name: Name of the column.
        field: A key of `KNOWN`.
        text: The unit that is not known.
        stated: Whether the log itself states it, instead of the name of the column.
        drafted: Whether the model file has yet to be drafted.
        sensor: SI unit of the readings, if the column belongs to a sensor; None for a field.

    Example:
        >>> from covariant.logs import unknown_unit_fault
        >>> unknown_unit_fault("t [frames]", "t", "frames").partition(". ")[0]
        "column 't [frames]' has 'frames' in brackets, which is no unit of t here; known are s, ms, us, ns, min, h"
    """
    where = "its attributes" if stated else "its name" if _BRACKETS.fullmatch(name) is None else "brackets"
    if sensor is not None:
        return (
            f"column {name!r} has {text!r} in {where}, which is no unit of what is measured in {sensor}; write "
            f'what one of it is, as units = "0.1 {sensor}" in the table of the sensor, or rename the column'
        )
    known, example = KNOWN[field]
    unit = _unit_of(text, ("",))
    own = f', or {field} = "{unit}" where the model takes it in that unit' if field != "t" and unit is not None else ""
    remedy = (
        f"Say what one of it is by `overrides=['units.{example.replace(' = ', '=', 1).partition(' for')[0]}']`{own}"
        if drafted
        else f"Write what one of it is under [units] of the model file, as {example}{own}, or rename the column"
    )
    return f"column {name!r} has {text!r} in {where}, which is no unit of {field} here; known are {known}. {remedy}"


def without_unit(name: str) -> str:
    """Name of a column without its unit.

    Example:
        >>> from covariant.logs import without_unit
        >>> without_unit("q1 [deg]")
        'q1'
    """
    for found in _statements(name):
        is_last = found.end == len(name.rstrip())
        kinds = [unit for units in MEANT.values() for unit in units] if is_last else MEANT["q"]
        if _unit_of(found.text, kinds) or (found.bracketed and not _INDEX.fullmatch(found.text)):
            before, after = name[: found.start].rstrip("_ ./-:,"), name[found.end :]
            return (before + after if before else after.strip("_ ./-:,")) or name
    return name.strip()


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
        text: A unit, perhaps with a number, as "0.05 N m".
        meant: Units of the kinds that it may be of.

    Example:
        >>> from covariant.logs import is_unit_of
        >>> is_unit_of("0.05 N m", ("N", "N m")), is_unit_of("rpm", ("rad",))
        (True, False)
    """
    for unit in meant:
        with contextlib.suppress(InputError):
            check_unit(text, unit)
            return True
    return False
