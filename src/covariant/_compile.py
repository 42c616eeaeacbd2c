"""Shared libraries of C, compiled once by the system's compiler and cached in the user's cache folder."""

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

from covariant._programs import cache_folder

Library = TypeVar("Library")

EXACT = (
    "-std=c99",
    "-O3",
    "-march=native",
    "-ffp-contract=off",
    "-fno-fast-math",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fwrapv",
    "-fPIC",
    "-shared",
)
"""Flags for C whose results are those of IEEE 754, operation by operation: none permits the compiler to change one.

Products and sums are not contracted; the flags for errno, traps and integers that wrap change no value of a double.
"""


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
"""Flags for C of this very processor whose results may differ by roundings: a product and a sum may be one operation.

The warning that is disabled concerns vectors as arguments of functions that other libraries call; there are none.
"""


NO_COMPILER = "there is no C compiler; set CC, install cc, or pip install ziglang"
"""What is said where `compiler_command` is None."""


@functools.cache
def compiler() -> str | None:
    """Path of the compiler that the environment variable CC names, or of `cc`; None where there is none."""
    return shutil.which(os.environ.get("CC") or "cc")


def compiler_command() -> list[str] | None:
    """Command of `compiler` or, where there is none, of the package ziglang; None where there is neither."""
    path = compiler()
    return [path] if path else zig()


def zig() -> list[str] | None:
    """Command of the C compiler in the package ziglang; None where it is not installed."""
    return [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else None


def built(command: Sequence[str], flags: Sequence[str], files: Mapping[str, str | bytes], what: str) -> bytes:
    """Compile the C sources among some files into one library, and return its content."""
    with tempfile.TemporaryDirectory() as place:
        for path, content in files.items():
            (Path(place) / path).parent.mkdir(exist_ok=True)
            (Path(place) / path).write_bytes(content.encode() if isinstance(content, str) else content)
        words = [*command, *flags, *(path for path in files if path.endswith(".c")), "-lm", "-o", "made"]
        done = subprocess.run(words, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{' '.join(command)} does not compile {what}: {done.stderr.strip()[:200]}")
        return (Path(place) / "made").read_bytes()


def compiled(source: str, flags: Sequence[str], load: Callable[[str], Library]) -> Library:
    """Load a C source as a shared library, compiled first where it is not cached.

    The cache key is a hash of the source, the flags, the compiler and, for code of this very processor, the processor.
    With `COVARIANT_CACHE=off` the source is compiled anew.

    Args:
        source: Text of the C file.
        flags: Flags of the compiler, as `EXACT` or `FAST`.
        load: Loads a shared library from its path.

    Returns:
        The result of `load`.

    Raises:
        OSError: The compiler does not accept the source.
    """
    path = _cached_path(source, flags)
    if path is None:
        # The file may be removed once it is loaded.
        with tempfile.TemporaryDirectory() as place:
            return load(str(_compile(source, flags, Path(place) / "made.so")))
    return load(str(path if path.exists() else _compile(source, flags, path)))


def is_kept(source: str, flags: Sequence[str]) -> bool:
    """Whether a source is compiled and cached, so that it is only loaded."""
    path = _cached_path(source, flags)
    return path is not None and path.exists()


def _cached_path(source: str, flags: Sequence[str]) -> Path | None:
    machine = _processor() if "-march=native" in flags else ""
    # With the compiler's version: another one may make other code of the same source.
    key = hashlib.sha256("\n".join([source, *flags, _version(), machine]).encode()).hexdigest()[:32]
    folder = cache_folder()
    return None if folder is None else folder / f"{key}.so"


def _compile(source: str, flags: Sequence[str], path: Path) -> Path:
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        text, library = Path(place) / "source.c", Path(place) / "made.so"
        text.write_text(source, encoding="utf-8")
        command = [str(compiler()), *flags, str(text), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{compiler()} does not compile a source of C: {done.stderr.strip()[:200]}")
        os.replace(library, path)  # atomic, since other processes may write the same file at the same time
    return path


@functools.cache
def _processor() -> str:
    """Features of the processor, part of the cache key since a home may be shared by machines that differ."""
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
