"""Reads users' files of bounded size, and writes files atomically: a path holds the old file or all of the new one."""

import contextlib
import hashlib
import io
import os
import re
import shutil
import stat
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

from scalargraph.errors import InputError, file_name

try:
    import fcntl
except ImportError:  # Windows has no such locks, so temporary files are not removed there
    fcntl = None

BEGINNING = (1980, 1, 1, 0, 0, 0)
"""The date of all files in archives, so that equal files give equal archives."""
SEAL = 32
"""Length [bytes] of a SHA-256."""


def write_atomically(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> Path:
    """Write a file atomically: into a temporary file beside it, which is then renamed.

    A writer that is killed leaves its temporary file, and the next writer to the same path removes it.
    """
    path = Path(path)
    with _write_temporary(path, write) as fresh:
        os.replace(fresh, path)
    _sync_folder(path.parent)
    return path


def utf8(text: str) -> bytes:
    """Encode a text that may contain file names; a byte of a name that is not UTF-8 is written as its escape."""
    return text.encode("utf-8", "backslashreplace")


def write_together(files: Mapping[Path, bytes]) -> None:
    """Write all new files to the disk first, then replace the old ones; each replacement is atomic."""
    with contextlib.ExitStack() as stack:
        fresh = {
            path: stack.enter_context(_write_temporary(path, lambda file, content=content: file.write(content)))
            for path, content in files.items()
        }
        for path, written in fresh.items():
            os.replace(written, path)
    for folder in {path.parent for path in files}:
        _sync_folder(folder)


@contextlib.contextmanager
def _write_temporary(path: Path, write: Callable[[BinaryIO], object]) -> Iterator[Path]:
    """Write a temporary file for `path` to the disk, and remove it at the end of the context."""
    # `open` and not `tempfile`, so that the file gets the permissions of any other new file.
    with temporary(path, lambda fresh: fresh.open("xb").close()) as fresh:
        with fresh.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        yield fresh


def _sync_folder(folder: Path) -> None:
    """Write a folder's entries to the disk, so that a replaced file stays replaced after a crash."""
    with contextlib.suppress(OSError):  # Windows cannot open a folder, and some file systems cannot sync one
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_sealed(path: Path, content: bytes) -> None:
    """Write a file that begins with the SHA-256 of its name and content."""
    write_atomically(path, lambda file: file.write(_seal(path, content) + content))


def read_sealed(path: Path) -> bytes | None:
    """Read a file that `write_sealed` wrote under this name; None if it does not exist or was changed."""
    try:
        sealed = path.read_bytes() if path.is_file() else b""  # reading a pipe might never end
    except OSError:
        return None
    seal, content = sealed[:SEAL], sealed[SEAL:]
    return content if seal == _seal(path, content) else None


def _seal(path: Path, content: bytes) -> bytes:
    # The hash includes the name, so that a renamed entry is not mistaken for another one.
    return hashlib.sha256(path.name.encode() + b"\n" + content).digest()


def zipped(files: Mapping[str, bytes]) -> bytes:
    """A zip archive of files, the same bytes for the same files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, BEGINNING)
            # Permissions that let anyone read the file: without them, some programs unpack unreadable files.
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


@contextlib.contextmanager
def temporary(path: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """Context of a new file or folder beside `path`, to be renamed to `path`; it is removed at the end.

    The writer holds a lock on it, which the system releases when the writer dies. So other processes can tell whether
    the writer still runs, and remove the file only if it does not.
    """
    sweep(path)
    with _name_errors(path):
        fresh, lock = _create_locked_file(path, make)
    try:
        with _name_errors(path):
            yield fresh
    finally:
        _remove(fresh)
        if lock is not None:
            os.close(lock)


def sweep(path: Path) -> None:
    """Remove temporary files of `path` whose writers were killed; files of running writers stay."""
    ours = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{32}}\.tmp")
    with contextlib.suppress(OSError):
        # The folder is listed by name only, as it may have very many files.
        names = [name for name in os.listdir(path.parent) if name.startswith(".") and ours.fullmatch(name)]
        for left in map(path.with_name, names):
            with _lock_descriptor(left) as lock:
                if _take(lock, "EX", wait=False):
                    _remove(left)


@contextlib.contextmanager
def attended(folder: Path, tidy: Callable[[], object]) -> Iterator[None]:
    """Context with a shared lock on a folder into which several processes may write."""
    with _lock_descriptor(folder) as lock:
        if _take(lock, "EX", wait=False):
            tidy()
        # The lock is shared from here on: others may write too, and nobody tidies while this process writes.
        _take(lock, "SH", wait=True)
        yield


def _create_locked_file(path: Path, make: Callable[[Path], object]) -> tuple[Path, int | None]:
    """Create a new file or folder, and its lock if the system has locks."""
    while True:
        fresh = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
        make(fresh)
        lock = _open(fresh)
        _take(lock, "EX", wait=True)
        if fcntl is None or (lock is not None and fresh.exists()):
            return fresh, lock
        if lock is not None:  # another process removed the file after its creation and before it was locked
            os.close(lock)


@contextlib.contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    """Context that makes errors about the temporary file of `path`, and errors without a file name, name `path`."""
    try:
        yield
    except OSError as error:
        # A full disk gives an error without a file name. A failed opening names the temporary file, which the user
        # does not know.
        ours = error.filename is None or f".{path.name}." in str(error.filename)
        if error.errno is None or not ours:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def _open(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return None if fcntl is None else os.open(path, os.O_RDONLY)
    return None


@contextlib.contextmanager
def _lock_descriptor(path: Path) -> Iterator[int | None]:
    lock = _open(path)
    try:
        yield lock
    finally:
        if lock is not None:
            os.close(lock)


def _take(lock: int | None, kind: Literal["EX", "SH"], wait: bool) -> bool:
    """Take an exclusive or shared lock; False if another process has it or the file system has no locks."""
    if fcntl is None or lock is None:
        return False
    try:
        fcntl.flock(lock, getattr(fcntl, f"LOCK_{kind}") | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


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
    """Content of a user's file; raises `InputError`, one line that names the file, if it cannot be read."""
    with _named(path, kind):
        with check_file(path, kind).open("rb") as file:
            # One byte more than allowed is read, to detect a larger file without reading all of it.
            content = file.read(kind.most_bytes + 1)
        if len(content) > kind.most_bytes:
            raise _too_large(path, kind)
        return content


@contextlib.contextmanager
def bounded(path: str | os.PathLike[str]) -> Iterator[None]:
    """Context for parsing a user's file; an error of too much memory or nesting names the file."""
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


def _too_large(path: str | os.PathLike[str], kind: FileKind) -> InputError:
    limit = f"{kind.most_bytes >> 20} MiB"
    return InputError(f"{file_name(path)}: is larger than {kind.what} may be, {limit}; {kind.advice}")
