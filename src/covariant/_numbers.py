"""Numbers as text: what counts as a number in a log, an option or an override."""

import re

from scalargraph.errors import InputError

DECIMAL = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""A decimal number in ASCII. Python's own `float` would also accept `1_0` and the digits of other scripts."""
SPECIAL = r"[+-]?(?i:nan|inf|infinity)"
NUMBER = rf"(?:{DECIMAL}|{SPECIAL})"

_NUMBER = re.compile(NUMBER)


def number(text: str) -> float:
    """Decimal number in a text, with spaces around it allowed."""
    plain = text.strip()
    if not _NUMBER.fullmatch(plain):
        raise InputError(f"{text!r} is not a decimal number")
    return float(plain)


def integer(text: str) -> int:
    """Integer in a text, without point or exponent, with spaces around it allowed."""
    plain = text.strip()
    if not re.fullmatch(r"[+-]?[0-9]+", plain):
        raise InputError(f"{text!r} is not a whole number")
    return int(plain)
