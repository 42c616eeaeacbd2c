"""Compiles C sources to shared libraries with the system's compiler, and caches them in the user's cache folder."""

import contextlib
import functools
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from scalargraph.cache import cache_folder, need_private
from scalargraph.files import read_sealed, write_sealed

Library = TypeVar("Library")

FAST = (
    "-std=c99",
    "-O2",
    "-march=native",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wno-psabi",
    "-fPIC",
    "-shared",
)
"""Compiler flags for C for this processor. Results may differ by roundings, since a product and a sum may be fused.

`-Wno-psabi` silences a warning about vectors as arguments across libraries; no exported function has such arguments.
"""


SEALED = "sealed"
"""Part of each cache key: files of older releases, which have no SHA-256 at the start, have other keys."""
NO_COMPILER = "there is no C compiler; set CC, install cc, or pip install ziglang"
"""Error message if `compiler_command` returns None."""


@functools.cache
def compiler() -> str | None:
    """Path of the compiler that the environment variable CC names, or of `cc`; None if there is none."""
    path = shutil.which(os.environ.get("CC") or "cc")
    return os.path.abspath(path) if path else None  # the compiler is called in another folder


def compiler_command() -> list[str] | None:
    """Command of `compiler` or, if there is none, of the package ziglang; None if there is neither."""
    path = compiler()
    return [path] if path else zig()


def zig() -> list[str] | None:
    """Command of the C compiler in the package ziglang; None if it is not installed."""
    return [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else None


def built(command: Sequence[str], flags: Sequence[str], files: Mapping[str, str | bytes], what: str) -> bytes:
    """Compile the C sources among the files to one shared library, and return the content of this library."""
    with tempfile.TemporaryDirectory(dir=_temporary_folder()) as place:
        for path, content in files.items():
            (Path(place) / path).parent.mkdir(exist_ok=True)
            (Path(place) / path).write_bytes(content.encode() if isinstance(content, str) else content)
        words = [*command, *flags, *(path for path in files if path.endswith(".c")), "-o", "made", "-lm"]
        done = subprocess.run(words, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{' '.join(command)} does not compile {what}: {done.stderr.strip()[:200]}")
        return (Path(place) / "made").read_bytes()


def _temporary_folder() -> Path:
    """Return a folder for temporary code files; raises `OSError` if another user could replace files in it."""
    folder = Path(tempfile.gettempdir()).resolve()
    need_private(folder, setting="TMPDIR")
    return folder


def compiled(source: str, flags: Sequence[str], load: Callable[[str], Library]) -> Library:
    """Load a C source as a shared library; it is compiled first unless an unchanged one is cached.

    The cache key is a hash of the source, the flags, the compiler and, for code of this very processor, the processor.
    With `COVARIANT_CACHE=off` the source is compiled anew.

    Args:
        source: Text of the C file.
        flags: Flags of the compiler, as `FAST`.
        load: Loads a shared library from its path.

    Returns:
        The result of `load`.

    Raises:
        OSError: The compiler rejects the source.
    """
    path = _cached_path(source, flags)
    library = None if path is None else read_sealed(path)
    if library is None:
        library = built([str(compiler())], flags, {"source.c": source}, "a source of C")
        if path is not None:
            with contextlib.suppress(OSError):  # such as a full disk
                write_sealed(path, library)
    return _load(library, None if path is None else path.parent, load)


def _load(library: bytes, folder: Path | None, load: Callable[[str], Library]) -> Library:
    """Load a shared library from a copy of its content, so that later changes of the cached file have no effect."""
    if folder is not None:
        # The cache folder is tried first: the temporary folder may forbid programs (`noexec`).
        with contextlib.suppress(OSError):  # such as a full disk
            return _load_copy(library, folder, load)
    return _load_copy(library, _temporary_folder(), load)


def _load_copy(library: bytes, folder: Path, load: Callable[[str], Library]) -> Library:
    # Each copy gets a new name, since the system treats two libraries with the same path as one.
    handle, copy = tempfile.mkstemp(".tmp", dir=folder)
    try:
        with open(handle, "wb") as file:
            file.write(library)
        return load(copy)
    finally:
        with contextlib.suppress(OSError):  # Windows does not remove a file that is loaded
            os.unlink(copy)


def _cached_path(source: str, flags: Sequence[str]) -> Path | None:
    machine = _processor() if "-march=native" in flags else ""
    # The compiler's version is included, since another version may generate different code from the same source.
    parts = (SEALED, source, *flags, _version(), machine)
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    folder = cache_folder()
    return None if folder is None else folder / f"{key}.so"


@functools.cache
def _processor() -> str:
    """Features of the processor; they are part of the cache key, since machines with a common home may differ."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(encoding="utf-8").splitlines() if known.exists() else []
    return next((line for line in lines if line.lower().startswith(("flags", "features"))), platform.processor())


@functools.cache
def vector_bytes() -> int:
    """Size [bytes] of the vectors that the processor adds and multiplies at once."""
    features = _processor().split()
    return 64 if "avx512f" in features else 32 if "avx2" in features else 16


@functools.cache
def _version() -> str:
    done = subprocess.run([str(compiler()), "--version"], capture_output=True, text=True, check=False)
    return f"{compiler()}\n{done.stdout}"
