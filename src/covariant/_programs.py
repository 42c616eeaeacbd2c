"""Compiled programs are cached between processes, in the user's cache folder.

JAX compiles a program in seconds and loads a cached one in milliseconds. `COVARIANT_CACHE=off` stores none, and
`COVARIANT_CACHE=FOLDER` stores them in that folder. Where `JAX_COMPILATION_CACHE_DIR` is set, it is respected.
"""

import contextlib
import hashlib
import os
import platform
import sys
import time
from pathlib import Path

from platformdirs import user_cache_path

OFF = ("off", "0", "no")
"""Values of `COVARIANT_CACHE` with which nothing is stored."""
FATAL = "3"
"""Lowest severity of the compiler's messages that are printed; errors in compilation raise exceptions as well."""
WORTH_KEEPING = "0"
"""Shortest compilation time [s] of a program that is stored: also many short ones add up to seconds."""
UNUSED = 180 * 24 * 3600.0
"""Time [s] without use after which a program is evicted: each version of a library leaves some behind."""
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
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    # The compiler reports features that the processor lacks as errors. 1 is the level that JAX itself sets.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = FATAL


def cache_folder() -> Path | None:
    """Cache folder for this kind of processor, created where it is missing.

    It is one per instruction set, since a program may not run on another processor.
    """
    chosen = os.environ.get("COVARIANT_CACHE", "")
    if chosen.lower() in OFF:
        return None
    try:
        folder = (Path(chosen).expanduser() if chosen else user_cache_path("covariant", appauthor=False)) / _processor()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except (OSError, RuntimeError):  # there is no home folder, or it cannot be written to
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def evict_unused(folder: Path) -> None:
    """Remove cached programs, of JAX and of this library, that were neither written nor read for `UNUSED` seconds."""
    for file in folder.glob("*"):
        if file.name.endswith((".so", ".json", ".made", "-cache")):  # .made: of versions before this one
            with contextlib.suppress(OSError):  # another process was faster, or may
                times = file.stat()
                # Many file systems do not record reads: then the time of writing counts.
                if max(times.st_atime, times.st_mtime) < time.time() - UNUSED:
                    file.unlink()


def _processor() -> str:
    """A name for the instruction set of this processor."""
    known = [platform.machine()]
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]
