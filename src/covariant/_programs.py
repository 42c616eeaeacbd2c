"""Compiled programs of JAX are cached between processes, in the user's cache folder.

JAX compiles a program in seconds and loads a cached one in milliseconds. `COVARIANT_CACHE=off` stores none, and
`COVARIANT_CACHE=FOLDER` stores them in that folder. Where `JAX_COMPILATION_CACHE_DIR` is set, it is respected.
`scalargraph.cache` says who may write into the folder.
"""

import contextlib
import hashlib
import os
import sys
import time
import zlib
from pathlib import Path

from scalargraph.cache import cache_folder

FATAL = "3"
"""Lowest severity of the compiler's messages that are printed; errors in compilation raise exceptions as well."""
WORTH_KEEPING = "0"
"""Shortest compilation time [s] of a program that is stored: also many short ones add up to seconds."""
IMPORTED = time.time()
"""Time [s] since 1970 at which this process imported the library; files changed later are not what runs."""


def keep_programs() -> None:
    """Set the environment variables by which JAX, when it is imported, learns where to cache its programs.

    Does nothing where JAX has been imported before: then it is too late to suppress the notes that its compiler writes
    about each program it loads. Whoever imports JAX earlier sets these variables.
    """
    decided = "jax" in sys.modules or "JAX_COMPILATION_CACHE_DIR" in os.environ
    folder = None if decided else cache_folder()
    if folder is None:
        return
    drop_broken_programs(folder)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    # The compiler reports features that the processor lacks as errors. 1 is the level that JAX itself sets.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = FATAL


CHECKED = "checked-programs"
"""File in the cache folder with one line for each program of JAX: SHA-256, time of its last change, size and name."""


def drop_broken_programs(folder: Path) -> None:
    """Remove programs of JAX that are incomplete or were changed.

    JAX names an entry before it is complete, never replaces it, and runs its unpacked content. An entry that is found
    for the first time must unpack without an error. After that its SHA-256 must stay the same; it is computed again
    if size or time of the file changed.
    """
    known = {}
    with contextlib.suppress(OSError, ValueError):
        for line in (folder / CHECKED).read_text(encoding="utf-8").splitlines():
            digest, *unchanged, name = line.split(" ", 3)
            known[name] = digest, *map(int, unchanged)
    checked, dropped = {}, False
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith("-cache"):
                status = entry.stat(follow_symlinks=False)
                unchanged = status.st_ctime_ns, status.st_size
                digest, *before = known.get(entry.name, ("", None))
                if before != [*unchanged]:
                    digest = _check_program(Path(entry.path), digest)
                if digest:
                    checked[entry.name] = digest, *unchanged
                else:
                    dropped = True
    if dropped or checked.keys() != known.keys() or checked != known:
        from scalargraph.files import write_atomically  # not needed at most starts

        lines = "".join(f"{digest} {changed} {size} {name}\n" for name, (digest, changed, size) in checked.items())
        with contextlib.suppress(OSError):
            write_atomically(folder / CHECKED, lambda file: file.write(lines.encode()))


def _check_program(path: Path, digest: str) -> str:
    """Return the SHA-256 of a program of JAX; if it was changed or is incomplete, remove it and return ""."""
    with contextlib.suppress(OSError):
        content = b"" if path.is_symlink() else path.read_bytes()
        current = hashlib.sha256(content).hexdigest()
        if current == digest or (not digest and _is_complete(content)):
            return current
        path.unlink()
    return ""


def _is_complete(content: bytes) -> bool:
    """Whether a program of JAX, packed by Zstandard or else by zlib, can be unpacked."""
    try:
        if content[:4] != b"\x28\xb5\x2f\xfd":
            zlib.decompress(content)
        elif sys.version_info >= (3, 14):
            from compression import zstd

            zstd.decompress(content)
        else:
            import zstandard

            zstandard.ZstdDecompressor().decompress(content)
    except Exception:  # each library has another error; without the library JAX cannot read the entry either
        return False
    return True
