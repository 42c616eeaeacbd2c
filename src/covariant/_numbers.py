"""Numbers as text: what counts as a number in a log, an option or an override."""

import re

DECIMAL = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""A decimal number in ASCII. Python's own `float` would also accept `1_0` and the digits of other scripts."""
SPECIAL = r"[+-]?(?i:nan|inf|infinity)"
NUMBER = rf"(?:{DECIMAL}|{SPECIAL})"

_NUMBER = re.compile(NUMBER)


def number(text: str) -> float:
    """The number that a text holds, spaces around it allowed; raises `ValueError` where it holds anything else."""
    plain = text.strip()
    if not _NUMBER.fullmatch(plain):
        raise ValueError(f"{text!r} is not a decimal number")
    return float(plain)


def integer(text: str) -> int:
    """The integer that a text holds, without point or exponent; raises `ValueError` where it holds anything else."""
    plain = text.strip()
    if not re.fullmatch(r"[+-]?[0-9]+", plain):
        raise ValueError(f"{text!r} is not a whole number")
    return int(plain)
