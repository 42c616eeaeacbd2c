"""Files that are either the old one or the new one, never half of each; what a killed writer leaves is swept."""

import contextlib
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Literal

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there, and so nothing is swept
    fcntl = None


def write_atomically(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> Path:
    """Let `write` fill a file beside `path`, then put it in its place; where `write` raises, `path` stays as it was.

    A writer that was killed leaves its file beside `path`, and the next one to the same path removes it. Raises
    `FileNotFoundError` where the folder does not exist, and whatever `write` raises.
    """
    path = Path(path)
    # A plain `open`, not `tempfile`, so that the file gets the permissions any other new file would.
    with temporary(path, lambda fresh: fresh.open("xb").close()) as fresh:
        with fresh.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path)
    return path


@contextlib.contextmanager
def temporary(path: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """A new file or folder beside `path`, made by `make`, to be moved to `path`; at the end it is gone in any case.

    Its writer holds a lock on it, which the system lets go when the writer dies: so nobody sweeps a living one's.
    """
    sweep(path)
    fresh, lock = _locked(path, make)
    try:
        yield fresh
    finally:
        _remove(fresh)
        if lock is not None:
            os.close(lock)


def sweep(path: Path) -> None:
    """Remove what killed writers of `path` have left beside it; what a living one is writing stays."""
    ours = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{32}}\.tmp")
    with contextlib.suppress(OSError):
        for left in [other for other in path.parent.iterdir() if ours.fullmatch(other.name)]:
            with _opened(left) as lock:
                if _take(lock, "EX", wait=False):
                    _remove(left)


@contextlib.contextmanager
def attended(folder: Path, tidy: Callable[[], object]) -> Iterator[None]:
    """While several may write in a folder: `tidy` is called first where nobody else attends it, and not by others
    until the end."""
    with _opened(folder) as lock:
        if _take(lock, "EX", wait=False):
            tidy()
        _take(lock, "SH", wait=True)
        yield


def _locked(path: Path, make: Callable[[Path], object]) -> tuple[Path, int | None]:
    """A new file or folder, and its lock where there are locks."""
    while True:
        fresh = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
        make(fresh)
        lock = _open(fresh)
        _take(lock, "EX", wait=True)
        if fcntl is None or (lock is not None and fresh.exists()):
            return fresh, lock
        if lock is not None:  # a sweeper took it between its making and its locking
            os.close(lock)


def _open(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return None if fcntl is None else os.open(path, os.O_RDONLY)
    return None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int | None]:
    lock = _open(path)
    try:
        yield lock
    finally:
        if lock is not None:
            os.close(lock)


def _take(lock: int | None, kind: Literal["EX", "SH"], wait: bool) -> bool:
    """Take the lock, exclusive or shared; False where another has it, or where the file system has none."""
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
