"""Reading of files of proofs: JSON data, read once, with every value checked where it is used.

A file may come from anybody. A fault is a `ValueError` of one line, which names the file and the key, what was found
there and what was expected. Nothing in a file is executed, imported or trusted. The digest detects damage, not forgery,
since whoever changes a file can recompute it.
"""

import functools
import hashlib
import json
import reprlib
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

MOST_BYTES, MOST_VALUES, DEEPEST = 64 * 2**20, 2_000_000, 8
"""Largest size of a file [bytes], number of values in it, and depth of nesting, all checked before it is parsed."""
CHUNK = 2**20
"""Number of bytes that are examined at once."""
LARGEST = 1e150
"""Largest number in a file, so that products of two numbers, and sums of these, are finite."""
REMEDY = "ask for the file as it was saved, or certify again"


def read_file(path: str | Path) -> bytes:
    """The content of a file, which is read only once. Raises `ValueError` where there is none, or too much."""
    file = file_name(path)
    try:
        if not Path(path).is_file():  # a pipe or a device may never end
            missing = "is no file" if Path(path).exists() else "does not exist"
            raise ValueError(f"{file} {missing}; give the path of a saved certificate")
        with Path(path).open("rb") as opened:
            content = opened.read(MOST_BYTES + 1)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ValueError(f"{file} cannot be read: {reason}; give the path of a saved certificate") from error
    if len(content) > MOST_BYTES:
        raise ValueError(f"{file} is larger than a certificate may be, {MOST_BYTES >> 20} MiB; {REMEDY}")
    return content


def file_name(path: str | Path) -> str:
    """A path as one printable line."""
    return str(path) if str(path).isprintable() else ascii(str(path))


def parse_file(path: str | Path, content: bytes) -> "Field":
    """The parsed content of a file, as one field.

    Raises `ValueError`, one line, where it is not JSON, or too large or too deep.
    """
    file = file_name(path)
    return Field(file, "", _values(file, content))


def digest(document: dict[str, Any]) -> str:
    """SHA-256 of a certificate without its digest, in a canonical form."""
    rest = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _values(file: str, content: bytes) -> Any:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is no text in UTF-8, at byte {error.start}; {REMEDY}") from error
    if "\\" in text:
        line = 1 + text.count("\n", 0, text.index("\\"))
        raise ValueError(f"{file} has a backslash on line {line}, and the strings of a certificate have none; {REMEDY}")
    if text.count(",") >= MOST_VALUES:
        raise ValueError(f"{file} holds more than {MOST_VALUES} values; {REMEDY}")
    if _depth(content) > DEEPEST:
        raise ValueError(f"{file} is nested more than {DEEPEST} deep; {REMEDY}")

    try:
        # Numbers beyond the range of doubles become infinite here, and are refused where they are used.
        return json.loads(
            text, object_pairs_hook=functools.partial(_once, file), parse_constant=float, parse_int=_whole
        )
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise ValueError(f"{file} is not JSON: {error.msg} at {where}; {REMEDY}") from error


def _once(file: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object in which no key occurs twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"{file}: the key {brief(twice)} is there twice; {REMEDY}")
    return found


def _depth(content: bytes) -> int:
    """Depth of nested brackets outside strings; a string that is not closed ends with the file."""
    depth, deepest, quoted = 0, 0, False
    for start in range(0, len(content), CHUNK):
        letters = np.frombuffer(content[start : start + CHUNK], np.uint8)
        inside = np.logical_xor.accumulate(np.append(quoted, letters == ord('"')))[1:]
        opened, closed = np.isin(letters, list(b"[{")) & ~inside, np.isin(letters, list(b"]}")) & ~inside
        depths = depth + np.cumsum(opened.astype(int) - closed)
        depth, deepest, quoted = int(depths[-1]), max(deepest, int(depths.max())), bool(inside[-1])
    return deepest


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) < 16 else float(digits)


def brief(value: Any) -> str:
    """A value as one short line."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    return short.repr(value)


class Field(NamedTuple):
    """A value of a file and its place: the file, and the key from the top, such as `claims[2].levels`.

    Its methods return the checked value. Each raises `ValueError` naming file and key, what was found and expected.
    """

    file: str
    key: str
    value: Any

    def refuse(self, wanted: str) -> NoReturn:
        what = f"{self.file}: {self.key}" if self.key else self.file
        raise ValueError(f"{what} must be {wanted}; found {brief(self.value)}; {REMEDY}")

    def need(self, holds: Any, wanted: str) -> None:
        if not holds:
            self.refuse(wanted)

    def at(self, key: str) -> "Field":
        return Field(self.file, f"{self.key}.{key}" if self.key else key, self.value[key])

    def record(self, keys: list[str]) -> dict[str, "Field"]:
        """The entries of an object that has exactly these keys."""
        self.need(isinstance(self.value, dict), f"an object with {', '.join(keys)}")
        for wrong, how in (
            (self.value.keys() - set(keys), "is not known"),
            (set(keys) - self.value.keys(), "is missing"),
        ):
            if wrong:
                key = f"{self.key}.{brief(min(wrong))}" if self.key else brief(min(wrong))
                raise ValueError(f"{self.file}: the key {key} {how}; wanted are {', '.join(keys)}; {REMEDY}")
        return {key: self.at(key) for key in keys}

    def rows(self, least: int, most: int) -> list["Field"]:
        """The entries of a list of `least` to `most` values."""
        several = f"{least}" if least == most else f"{least} to {most}"
        self.need(isinstance(self.value, list) and least <= len(self.value) <= most, f"a list of {several} entries")
        return [Field(self.file, f"{self.key}[{k}]", value) for k, value in enumerate(self.value)]

    def number(self) -> float:
        """A number; a truth value is not one."""
        self.need(is_number(self.value), f"a finite number, below {LARGEST:g}")
        return float(self.value)

    def positive(self) -> float:
        found = self.number()
        self.need(found > 0, "a positive number")
        return found

    def whole(self, least: int, most: int) -> int:
        self.need(type(self.value) is int and least <= self.value <= most, f"a whole number from {least} to {most}")
        return self.value

    def text(self, most: int) -> str:
        fits = type(self.value) is str and len(self.value) <= most and self.value.isprintable()
        self.need(fits, f"a text of {most} letters at most")
        return self.value

    def one_of(self, choices: Any) -> Any:
        fits = any(type(self.value) is type(choice) and self.value == choice for choice in choices)
        self.need(fits, f"one of {', '.join(map(repr, choices))}")
        return self.value

    def vector(self, fewest: int, most: int, least: float = -LARGEST) -> np.ndarray:
        """Numbers that are not below `least`."""
        numbers = self.rows(fewest, most)
        for number in numbers:
            number.need(number.number() >= least, f"{least:g} or larger")
        return np.array([number.number() for number in numbers], float)

    def pair(self, fewest: int, most: int) -> np.ndarray:
        """Bounds {"low", "high"} of variables (2, k)."""
        fields = self.record(["low", "high"])
        low = fields["low"].vector(fewest, most)
        high = fields["high"].vector(len(low), len(low))
        for k, field in enumerate(fields["high"].rows(0, most)):
            field.need(low[k] <= high[k], f"{low[k]:g} or larger, as its lower bound")
        return np.stack([low, high])


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; a truth value is not one."""
    return type(value) in (int, float) and abs(value) <= LARGEST
