"""The door for files of users: what they may be and ask for at most, said before any work is done. Loads nothing heavy.

Every file that somebody names is opened here: a model file, a robot, a log, a study, a certificate, a store. It has to
be a regular file of a bounded size, as a pipe or a device may never end.
"""

import os
import re
import tomllib
from typing import Any

from scalargraph.errors import InputError, file_name
from scalargraph.files import FileKind, read_bytes

MODEL = FileKind("a model file", 2**20, "a model file holds a few numbers; give its path")
ROBOT = FileKind("a URDF or MJCF file", 2**23, "put meshes and other shapes into files of their own")
MESH = FileKind("a mesh or another part of a robot", 2**28, "take a coarser mesh, or remove it")
STUDY = FileKind("a study", 2**24, "give ranges {low, high, count} in place of long lists")
TEXT_LOG = FileKind("a log of text", 2**29, "cut it, or save it as Parquet, which is read by columns")
BINARY_LOG = FileKind("a log", 2**36, "cut it into several logs")
STORE = FileKind("a part of a store", 2**26, "make the store anew")

MOST_LINKS, MOST_COORDINATES = 400, 80
"""Largest number of links of a robot, fixed ones included, and of coordinates, or entries of a list of parameters: the
work to make a model grows with their cube."""
MOST_ENTRIES, MOST_CELLS = 20_000, 2**24
"""Largest number of entries of an MJCF file, copies included, and of cells of a height field or another array."""
MOST_ROWS, MOST_COLUMNS = 5 * 10**7, 10_000
"""Largest number of rows of a log, 14 hours at 1 kHz, and of its columns."""
DEEPEST = 16
"""Largest depth of nested tables, lists and dotted keys of a TOML document."""
_SEGMENT = r"""(?:"[^"\n]{0,200}"|'[^'\n]{0,200}'|[\w-]{1,200})"""
_DOTTED = re.compile(rf"(?<![\w-]){_SEGMENT}(?:[ \t]*\.[ \t]*{_SEGMENT}){{{DEEPEST},}}")
"""A dotted key that is too deep: the time of the parser grows with the square of its dots."""


def read_toml(path: str | os.PathLike[str], kind: FileKind) -> dict[str, Any]:
    """Content of a TOML file of a user."""
    return parse_toml(read_text(path, kind), f"{file_name(path)}: ")


def read_text(path: str | os.PathLike[str], kind: FileKind) -> str:
    """Text of a file of a user, with the line ends of Unix."""
    try:
        return read_bytes(path, kind).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{file_name(path)}: is no text in UTF-8, at byte {error.start}; save it as such") from error


def parse_toml(text: str, where: str = "") -> dict[str, Any]:
    """Parse a TOML document that is nested `DEEPEST` deep at most; `where` begins the message of an `InputError`."""
    too_deep = f"{where}tables, lists or keys are nested more than {DEEPEST} deep; write them flat"
    if _DOTTED.search(text):
        raise InputError(too_deep)
    try:
        content = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(too_deep) from error
    except ValueError as error:  # of the parser, or of `int` for a number of thousands of digits
        raise InputError(f"{where}not a TOML document: {error}") from error
    level: list[Any] = [content]
    for _ in range(DEEPEST):
        level = [each for part in level for each in (part.values() if isinstance(part, dict) else part)]
        level = [each for each in level if isinstance(each, dict | list)]
    if level:
        raise InputError(too_deep)
    return content


def check_count(count: int | float, most: int, what: str) -> None:
    """Refuse a robot with too many parts."""
    if count > most:
        raise InputError(f"it has {count:g} {what}, more than {most}; keep the part whose state is estimated")
