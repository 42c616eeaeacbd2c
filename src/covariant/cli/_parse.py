"""Parsing of options with several numbers: lists of numbers, and ends of named variables."""

from covariant._numbers import integer, number

UNITS = {"k": 1024, "m": 1024**2}


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
