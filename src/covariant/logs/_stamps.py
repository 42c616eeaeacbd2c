"""Converts time stamps to seconds, from numbers in any unit, dates, and times since 1970."""

import re
from fractions import Fraction
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._cells import fault, floats, numbers
from covariant.logs._clock import odd_clock
from covariant.logs._columns import LogError, pyarrow
from covariant.logs._register import Register
from covariant.logs._text import DATE, TIME_OF_DAY
from covariant.logs._units import unit_factor
from covariant.signals import LATEST_STAMP, check_rounding
from scalargraph.errors import InputError

LATEST = 1e8
"""Stamps beyond this [s], three years, count from 1970; smaller ones count from the start of the machine."""
DAY, HOUR = 86_400.0, 3600.0
"""Seconds after which times of day begin anew."""


class Stamps(NamedTuple):
    """Stamps of a log.

    Attributes:
        t: Stamps (T,) [s].
        origin_ns: Time [ns since 1970] at which t is zero; None if t is as in the file.
    """

    t: Float[np.ndarray, "T"]
    origin_ns: int | None


def stamps(where: str, column: Any, given: str | None) -> Stamps:
    """Read the stamps in a column of numbers, of dates as 2024-05-01T12:00:00.25Z, of times of day, or of Arrow's.

    Dates, and times since 1970, are counted from the first one, without loss of digits. Times of day are seconds since
    midnight; they, and counters, go on where they begin anew.

    Args:
        where: Log and column, the beginning of error messages.
        column: A chunked array of Arrow.
        given: Unit of the numbers; None means seconds.

    Returns:
        The stamps.

    Raises:
        LogError: A cell is not a stamp; the message names the first one.
    """
    pa = pyarrow()
    if dated(column):
        _need_no_unit(where, given, "dates")
        ticks = _dates(pa, where, column)
        # Integers are subtracted before conversion to floats, so that no digit of a date is lost.
        return Stamps((ticks - ticks[0]) * 1e-9, int(ticks[0]))
    if _of_day(column):
        _need_no_unit(where, given, "times of day")
        return Stamps(Register.continued(_times_of_day(pa, where, column), (DAY, HOUR)), None)
    if pa.types.is_duration(column.type):
        _need_no_unit(where, given, str(column.type))
        column, given = column.cast(pa.int64()), column.type.unit
    factor = 1.0 if given is None else unit_factor(given)
    values = numbers(where, column, needed=True)
    if column.type in (pa.float32(), pa.float16()) and (np.diff(values) > 0).all():
        try:
            check_rounding(values.astype(column.type.to_pandas_dtype()))
        except InputError as error:
            raise LogError(f"{where}: {error}") from error
    odd = odd_clock(values, given)
    if odd is not None:
        raise LogError(f"{where} {odd}")
    too_late = np.abs(values) * factor > LATEST_STAMP
    if too_late.any():
        row = int(too_late.argmax())
        unit = next((unit for unit in ("ms", "us") if abs(values[row]) * unit_factor(unit) < LATEST_STAMP), "ns")
        raise LogError(
            f"{where}, row {row + 1}: found {column[row].as_py()}, which in {given or 's'} is after the year 2200; "
            f'write t = "{unit}" under [units] of the model file, or the unit that the stamps are in'
        )
    if not len(values) or abs(values[0] * factor) < LATEST:
        return Stamps(Register.continued(values) * factor, None)
    first, since_first = _since_first(pa, column, values)
    # The product of a fraction and a whole number of nanoseconds is exact.
    return Stamps(since_first * factor, round(first * round(factor * 1e9)))


def _since_first(pa: ModuleType, column: Any, values: np.ndarray) -> tuple[Fraction, np.ndarray]:
    """The first number, and all numbers minus the first; exactly if possible, since a float has only 16 digits."""
    # int64 covers nanoseconds since 1970; decimals have 18 digits before the point, enough for microseconds.
    for exact in (pa.int64(), pa.decimal128(30, 12)):
        try:
            plain = pa.compute.utf8_trim_whitespace(column) if pa.types.is_string(column.type) else column
            digits = plain.cast(exact)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            continue
        since_first = pa.compute.subtract(digits, digits[0]).cast(pa.float64(), safe=False)
        return Fraction(digits[0].as_py()), since_first.to_numpy()
    return Fraction(float(values[0])), values - values[0]


def dated(column: Any) -> bool:
    """Whether a column of Arrow holds dates, as timestamps or as text."""
    return pyarrow().types.is_timestamp(column.type) or _begins(column, DATE)


def _begins(column: Any, pattern: str) -> bool:
    """Whether a column of Arrow holds text whose first cell matches a pattern."""
    is_text = pyarrow().types.is_string(column.type) and len(column) > 0
    return is_text and re.match(pattern, column[0].as_py() or "") is not None


def timed(column: Any) -> bool:
    """Whether the type of a column, or its text, shows that it holds time."""
    return dated(column) or _of_day(column) or pyarrow().types.is_duration(column.type)


def _of_day(column: Any) -> bool:
    """Whether a column of Arrow holds times of day, by its type or as text."""
    return pyarrow().types.is_time(column.type) or _begins(column, TIME_OF_DAY)


def _times_of_day(pa: ModuleType, where: str, column: Any) -> Float[np.ndarray, "T"]:
    """Seconds (T,) of times of day."""
    if pa.types.is_time(column.type):
        column = column.cast(pa.time64("ns"), safe=False).cast(pa.int64())
        return numbers(where, column, needed=True) * 1e-9
    parts = pa.compute.extract_regex(pa.compute.replace_substring(column, ",", "."), TIME_OF_DAY)
    if parts.null_count:
        row = pa.compute.index(parts.is_null(), True).as_py()
        raise LogError(
            f"{where}, row {row + 1}: found {column[row].as_py()!r}, needs a time of day as in row 1, "
            f"{column[0].as_py()!r}"
        )
    t = np.zeros(len(column))
    for name, seconds in (("days", DAY), ("hours", HOUR), ("minutes", 60.0), ("seconds", 1.0)):
        digits = pa.compute.struct_field(parts, name)
        count = floats(pa.compute.if_else(pa.compute.equal(digits, ""), "0", digits).cast(pa.float64()))
        half = pa.compute.utf8_lower(pa.compute.struct_field(parts, "half"))
        if name == "hours" and half[0].as_py():  # 12 AM is midnight
            count = count % 12 + 12 * (half.to_numpy(zero_copy_only=False) == "p")
        t += seconds * count
    return t


def _need_no_unit(where: str, unit: str | None, what: str) -> None:
    if unit is not None:
        raise LogError(f"{where} holds {what}, which need no unit; leave [units] t away")


def _dates(pa: ModuleType, where: str, column: Any) -> np.ndarray:
    """Nanoseconds since 1970 (T,); a date without a zone is read as UTC."""
    if pa.types.is_string(column.type):
        plain = pa.compute.utf8_trim_whitespace(column)
        # ISO 8601 also allows a comma before the fraction of a second; Arrow accepts only a point.
        plain = pa.compute.replace_substring_regex(plain, r"(:[0-9]{2}),([0-9]+)", r"\1.\2")
        zone = None if re.search(r"(Z|[+-][0-9]{2}:?[0-9]{2})$", plain[0].as_py()) is None else "UTC"
        try:
            column = plain.cast(pa.timestamp("ns", zone))
        except pa.ArrowInvalid as error:
            quoted = re.search(r"'(.*)'", str(error))
            row = -1 if quoted is None else pa.compute.index(plain, quoted[1]).as_py()
            raise LogError(
                f"{where}, row {row + 1}: found {plain[row].as_py()!r}, needs a date as in row 1, "
                f"{plain[0].as_py()!r}, with nine digits after the second at most"
            ) from error
    if column.null_count:
        raise fault(where, pa.compute.index(column.is_null(), True).as_py(), None, needed=True)
    return column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64()).to_numpy()
