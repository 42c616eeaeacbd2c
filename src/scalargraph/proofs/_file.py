"""Reads saved proofs: a JSON file is read once, and every value is checked where it is used.

A file may come from an untrusted source. Each fault raises a `ValueError` of one line, which names the file, the key,
the value and the expected one. Nothing in a file is executed or imported. The digest detects damage, not forgery: an
attacker can recompute it.
"""

import functools
import hashlib
import json
import reprlib
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from scalargraph.errors import InputError, file_name
from scalargraph.files import FileKind, read_bytes

CERTIFICATE = FileKind("a saved certificate", 2**26, "ask for the certificate as it was saved, or certify again")
MOST_VALUES, DEEPEST = 2_000_000, 8
"""Largest number of values in a file, and largest depth of nesting; both are checked before the file is parsed."""
CHUNK = 2**20
"""Number of bytes that are scanned at once."""
LARGEST = 1e150
"""Largest number accepted in a file: products of two such numbers, and sums of these, are finite."""
REMEDY = "ask for the file as it was saved, or certify again"


def read_file(path: str | Path) -> bytes:
    """The content of a saved certificate, read only once.

    Args:
        path: Path of the file.

    Returns:
        Its bytes, at most `MOST_BYTES` of them; they are not yet parsed.

    Raises:
        ValueError: There is no such file, it cannot be read, or it is too large; the message is one line.

    Example:
        >>> from pathlib import Path
        >>> from scalargraph.proofs import read_file
        >>> _ = Path("claims.json").write_text("[1, 2]")
        >>> read_file("claims.json")
        b'[1, 2]'
    """
    return read_bytes(path, CERTIFICATE)


def parse_file(path: str | Path, content: bytes) -> "Field":
    """The parsed content of a file, as one field.

    Args:
        path: Path of the file; it is used in messages only.
        content: Its bytes, as from `read_file`.

    Returns:
        The field of the whole content, with the key "".

    Raises:
        ValueError: The content is not JSON in UTF-8, contains a backslash or a repeated key, or is too large or too
            deeply nested; the message is one line.

    Example:
        >>> from scalargraph.proofs import parse_file
        >>> parse_file("claims.json", b'{"rate": 2.5}').at("rate").positive()
        2.5
    """
    file = file_name(path)
    return Field(file, "", _values(file, content))


def digest(document: dict[str, Any]) -> str:
    """SHA-256 of a certificate without its digest, in a canonical form.

    Args:
        document: The certificate as JSON data; the key "digest" is left out.

    Returns:
        64 hexadecimal digits. They detect damage, not forgery.

    Example:
        >>> from scalargraph.proofs import digest
        >>> digest({"rate": 1.0, "digest": ""}) == digest({"rate": 1.0})
        True
    """
    rest = {key: value for key, value in document.items() if key != "digest"}
    # Sorted keys and no spaces give equal data equal text, whatever the layout of the file.
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _values(file: str, content: bytes) -> Any:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no text in UTF-8, at byte {error.start}; {REMEDY}") from error
    # Without escapes every quotation mark opens or closes a string; the count of brackets below relies on this.
    if "\\" in text:
        line = 1 + text.count("\n", 0, text.index("\\"))
        raise InputError(f"{file} has a backslash on line {line}, and the strings of a certificate have none; {REMEDY}")
    if text.count(",") >= MOST_VALUES:
        raise InputError(f"{file} holds more than {MOST_VALUES} values; {REMEDY}")
    if _depth(content) > DEEPEST:
        raise InputError(f"{file} is nested more than {DEEPEST} deep; {REMEDY}")

    try:
        # Numbers beyond the range of doubles become infinite here, and are refused when they are used.
        once = functools.partial(_once, file)
        return json.loads(text, object_pairs_hook=once, parse_constant=float, parse_int=_whole)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{file} is not JSON: {error.msg} at {where}; {REMEDY}") from error


def _once(file: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object (dictionary) in which no key occurs twice."""
    record = dict(pairs)
    if len(record) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f"{file}: the key {brief(twice)} is there twice; {REMEDY}")
    return record


def _depth(content: bytes) -> int:
    """Depth of nested brackets outside strings; a string that is not closed ends with the file."""
    depth, deepest, quoted = 0, 0, False
    for start in range(0, len(content), CHUNK):
        letters = np.frombuffer(content[start : start + CHUNK], np.uint8)
        # Each quotation mark toggles whether the bytes after it are inside a string; the state is carried between
        # chunks.
        inside = np.logical_xor.accumulate(np.append(quoted, letters == ord('"')))[1:]
        opened, closed = np.isin(letters, list(b"[{")) & ~inside, np.isin(letters, list(b"]}")) & ~inside
        depths = depth + np.cumsum(opened.astype(int) - closed)
        depth, deepest, quoted = int(depths[-1]), max(deepest, int(depths.max())), bool(inside[-1])
    return deepest


def _whole(digits: str) -> int | float:
    # Integers of fewer than 16 digits are exact as floats. Longer ones become floats, because `int` is slow for many
    # digits and refuses thousands.
    return int(digits) if len(digits) < 16 else float(digits)


def brief(value: object) -> str:
    """A value as one short line, for messages."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    return short.repr(value)


class Field(NamedTuple):
    """A value of a file with its key. Its methods check the value and return it.

    If the value is wrong, they raise a `ValueError` of one line with file, key, value and the expected value.

    Attributes:
        file: Name of the file.
        key: Full key, such as `claims[2].levels`; "" for the whole content.
        value: The value, of any type of JSON.

    Example:
        >>> from scalargraph.proofs import parse_file
        >>> field = parse_file("claims.json", b'{"rate": -1.5}').at("rate")
        >>> field.key, field.number()
        ('rate', -1.5)
        >>> field.positive()
        Traceback (most recent call last):
        scalargraph.errors.InputError: claims.json: rate must be a positive number; found -1.5; ...
    """

    file: str
    key: str
    value: Any

    def refuse(self, wanted: str) -> NoReturn:
        """Raise the `ValueError` of this field.

        Args:
            wanted: Expected value, in words that follow "must be".

        Raises:
            ValueError: Always.
        """
        what = f"{self.file}: {self.key}" if self.key else self.file
        raise InputError(f"{what} must be {wanted}; found {brief(self.value)}; {REMEDY}")

    def need(self, holds: object, wanted: str) -> None:
        """Refuse the field unless a condition holds.

        Args:
            holds: Condition, a truth value.
            wanted: Expected value, as for `refuse`.

        Raises:
            ValueError: The condition does not hold.
        """
        if not holds:
            self.refuse(wanted)

    def at(self, key: str) -> "Field":
        """The entry of an object by key; the key must exist.

        Args:
            key: Key of the entry.

        Raises:
            KeyError: There is no such key; call `record` first, which checks this.
        """
        return Field(self.file, f"{self.key}.{key}" if self.key else key, self.value[key])

    def record(self, keys: list[str]) -> dict[str, "Field"]:
        """The entries of an object that has exactly these keys.

        Args:
            keys: All keys, in any order.

        Returns:
            The fields of the entries by key.
        """
        self.need(isinstance(self.value, dict), f"an object with {', '.join(keys)}")
        given, wanted = self.value.keys(), set(keys)
        for wrong, how in ((given - wanted, "is not known"), (wanted - given, "is missing")):
            if wrong:
                key = f"{self.key}.{brief(min(wrong))}" if self.key else brief(min(wrong))
                raise InputError(f"{self.file}: the key {key} {how}; wanted are {', '.join(keys)}; {REMEDY}")
        return {key: self.at(key) for key in keys}

    def rows(self, least: int, most: int) -> list["Field"]:
        """The entries of a list.

        Args:
            least: Smallest number of entries.
            most: Largest number of entries.
        """
        several = f"{least}" if least == most else f"{least} to {most}"
        self.need(isinstance(self.value, list) and least <= len(self.value) <= most, f"a list of {several} entries")
        return [Field(self.file, f"{self.key}[{k}]", value) for k, value in enumerate(self.value)]

    def number(self) -> float:
        """A finite number, as a float, of magnitude at most `LARGEST`; true and false are refused."""
        self.need(is_number(self.value), f"a finite number, below {LARGEST:g}")
        return float(self.value)

    def positive(self) -> float:
        """A number above zero, as a float."""
        amount = self.number()
        self.need(amount > 0, "a positive number")
        return amount

    def whole(self, least: int, most: int) -> int:
        """An integer; true and false are refused.

        Args:
            least: Smallest value.
            most: Largest value.
        """
        self.need(type(self.value) is int and least <= self.value <= most, f"a whole number from {least} to {most}")
        return self.value

    def text(self, most: int) -> str:
        """A printable string.

        Args:
            most: Largest number of characters.
        """
        fits = type(self.value) is str and len(self.value) <= most and self.value.isprintable()
        self.need(fits, f"a text of {most} letters at most")
        return self.value

    def one_of(self, choices: tuple | list) -> Any:
        """One of several values; the type must be equal too, so that true is not accepted for 1.

        Args:
            choices: Allowed values.
        """
        fits = any(type(self.value) is type(choice) and self.value == choice for choice in choices)
        self.need(fits, f"one of {', '.join(map(repr, choices))}")
        return self.value

    def vector(self, fewest: int, most: int, least: float = -LARGEST) -> np.ndarray:
        """A list of numbers, as an array.

        Args:
            fewest: Smallest number of entries.
            most: Largest number of entries.
            least: Smallest value of each entry; by default the number −`LARGEST`.
        """
        numbers = self.rows(fewest, most)
        for number in numbers:
            number.need(number.number() >= least, f"{least:g} or larger")
        return np.array([number.number() for number in numbers], float)

    def pair(self, fewest: int, most: int) -> np.ndarray:
        """Bounds of k variables, from an object {"low": [...], "high": [...]}.

        Args:
            fewest: Smallest number of variables.
            most: Largest number of variables.

        Returns:
            Lower and upper bounds (2, k), in order.
        """
        fields = self.record(["low", "high"])
        low = fields["low"].vector(fewest, most)
        high = fields["high"].vector(len(low), len(low))
        for k, field in enumerate(fields["high"].rows(0, most)):
            field.need(low[k] <= high[k], f"{low[k]:g} or larger, as its lower bound")
        return np.stack([low, high])


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; true and false do not count as numbers."""
    # Comparing the exact type excludes bool, a subclass of int; NaN fails the comparison of sizes.
    return type(value) in (int, float) and abs(value) <= LARGEST
