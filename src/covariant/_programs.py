"""Compiled programs are kept from one process to the next, in the user's cache folder.

JAX compiles a program in seconds and loads a kept one in milliseconds. `COVARIANT_CACHE=off` keeps none, and
`COVARIANT_CACHE=FOLDER` keeps them there; where `JAX_COMPILATION_CACHE_DIR` is set, that is left alone.
"""

import hashlib
import os
import platform
import sys
from pathlib import Path

FATAL = "3"
"""The least of the compiler's messages that are shown; what goes wrong in it is an exception as well."""
WORTH_KEEPING = "0.1"
"""Shortest time of compilation [s] of a program that is kept."""


def keep_programs() -> None:
    """Tell JAX, which reads its variables when it is imported, where to keep its programs.

    Nothing where it has been imported before this: then it is late to silence what its compiler notes about each
    program that it loads. Who imports JAX first sets its own variables.
    """
    folder = None if "jax" in sys.modules else _folder()
    if folder is None:
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    # As an error: which of the compiler's own wishes the processor cannot fulfil. 1 is what JAX itself sets.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = FATAL


def _folder() -> Path | None:
    """One for each kind of processor, since a program of one may not run on another; None where none can be written."""
    chosen = os.environ.get("COVARIANT_CACHE", "")
    if chosen.lower() in ("off", "0", "no") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return None
    try:
        folder = (Path(chosen).expanduser() if chosen else _users_caches() / "covariant") / _processor()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except (OSError, RuntimeError):  # no home, or not ours to write in
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def _users_caches() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _processor() -> str:
    """A name for the instructions that this machine knows."""
    known = [platform.machine()]
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]
