"""The door for files of users: what they may be and ask for at most, said before any work is done. Loads nothing heavy.

Every file that somebody names is opened here: a model file, a robot, a log, a study, a certificate, a store. It has to
be a regular file of a bounded size, as a pipe or a device may never end.
"""

import contextlib
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from covariant._errors import InputError, file_name


class FileKind(NamedTuple):
    """A kind of file that users name.

    Attributes:
        what: The kind, in words.
        most_bytes: Largest size [bytes].
        advice: What to do about a larger one.
    """

    what: str
    most_bytes: int
    advice: str = ""


MODEL = FileKind("a model file", 2**20, "a model file holds a few numbers; give its path")
ROBOT = FileKind("a URDF or MJCF file", 2**23, "put meshes and other shapes into files of their own")
MESH = FileKind("a mesh or another part of a robot", 2**28, "take a coarser mesh, or remove it")
STUDY = FileKind("a study", 2**24, "give ranges {low, high, count} in place of long lists")
CERTIFICATE = FileKind("a saved certificate", 2**26, "ask for the certificate as it was saved, or certify again")
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


def check_file(path: str | os.PathLike[str], kind: FileKind) -> Path:
    """Check that a path is a regular file of bounded size, without opening it.

    Raises:
        InputError: One line that names the path, what it is, and what to do.
    """
    with _named(path, kind):
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{file_name(path)}: is a folder; give the path of {kind.what}")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{file_name(path)}: is no file; write what it delivers to one, and give its path")
        if status.st_size > kind.most_bytes:
            raise _too_large(path, kind)
    return Path(path)


def read_bytes(path: str | os.PathLike[str], kind: FileKind) -> bytes:
    """Content of a file of a user; raises `InputError`, one line that names it, where it cannot be read."""
    with _named(path, kind):
        with check_file(path, kind).open("rb") as file:
            # One byte more than allowed shows that a file grows, without reading all of it.
            content = file.read(kind.most_bytes + 1)
        if len(content) > kind.most_bytes:
            raise _too_large(path, kind)
        return content


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


@contextlib.contextmanager
def bounded(path: str | os.PathLike[str]) -> Iterator[None]:
    """Context in which a file of a user is parsed; where it asks for too much memory or nesting, the error names it."""
    try:
        yield
    except RecursionError as error:
        raise InputError(f"{file_name(path)}: is nested too deep to be read; write it flat") from error
    except MemoryError as error:
        raise InputError(f"{file_name(path)}: asks for more memory than there is; make it smaller") from error


@contextlib.contextmanager
def _named(path: str | os.PathLike[str], kind: FileKind) -> Iterator[None]:
    try:
        with bounded(path):
            yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{file_name(path)}: {reason}; give the path of {kind.what}") from error
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file_name(path)}: is no path ({error}); give the path of {kind.what}") from error


def check_count(count: int | float, most: int, what: str) -> None:
    """Refuse a robot with too many parts."""
    if count > most:
        raise InputError(f"it has {count:g} {what}, more than {most}; keep the part whose state is estimated")


def _too_large(path: str | os.PathLike[str], kind: FileKind) -> InputError:
    limit = f"{kind.most_bytes >> 20} MiB"
    return InputError(f"{file_name(path)}: is larger than {kind.what} may be, {limit}; {kind.advice}")
