"""Parsing of options with several numbers: lists of numbers, and ends of named variables."""

from covariant._numbers import integer, number

UNITS = {"k": 1024, "m": 1024**2}


def number_list(option: str, text: str | None) -> list[float] | None:
    """Parse numbers separated by commas.

    Args:
        option: Name of the option without its dashes, for messages.
        text: Its value; None where the option is absent.

    Returns:
        The numbers, or None where the option is absent.

    Raises:
        ValueError: One line that names the option.

    Example:
        >>> number_list("velocity", "1,2.5")
        [1.0, 2.5]
    """
    if text is None:
        return None
    try:
        return [number(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{option}: {text!r} is not a list of numbers separated by commas") from None


def count_list(option: str, text: str) -> list[int]:
    """Parse whole numbers separated by commas.

    Args:
        option: Name of the option without its dashes, for messages.
        text: Its value.

    Returns:
        The numbers.

    Raises:
        ValueError: One line that names the option.
    """
    try:
        return [integer(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{option}: {text!r} is not a list of whole numbers separated by commas") from None


def interval_map(option: str, text: str | None) -> dict[str, tuple[float, float]] | None:
    """Parse low and high ends of variables, `name=low:high`, separated by commas.

    Args:
        option: Name of the option without its dashes, for messages.
        text: Its value; None where the option is absent.

    Returns:
        The ends by name, or None where the option is absent.

    Raises:
        ValueError: One line that names the option.

    Example:
        >>> interval_map("region", "r=0:1,theta=-1:1")
        {'r': (0.0, 1.0), 'theta': (-1.0, 1.0)}
    """
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
    """Parse a number of bytes, such as `64k`, `1M` or `65536`, where k is 1024.

    Args:
        option: Name of the option without its dashes, for messages.
        text: Its value; None where the option is absent.

    Returns:
        The number of bytes, or None where the option is absent.

    Raises:
        ValueError: One line that names the option.

    Example:
        >>> byte_count("flash", "64k")
        65536
    """
    if text is None:
        return None
    digits, unit = (text[:-1], text[-1].lower()) if text[-1:].lower() in UNITS else (text, "")
    try:
        count = int(number(digits) * UNITS.get(unit, 1))
    except (ValueError, OverflowError):  # no number, or infinity
        count = 0
    if count <= 0:
        raise ValueError(f"--{option} must be a number of bytes, such as 64k, 1M or 65536; got {text!r}")
    return count


def name_list(text: str | None) -> tuple[str, ...] | None:
    """Parse names separated by commas.

    Args:
        text: Value of the option; None where it is absent.

    Returns:
        The names without blanks around them, or None where the option is absent.
    """
    return None if text is None else tuple(part.strip() for part in text.split(","))
