"""Shared libraries of C, compiled once and kept in the user's cache folder."""

import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from covariant._programs import cache_folder

FLAGS = ("-std=c99", "-O2", "-fno-math-errno", "-fPIC", "-shared")


@functools.cache
def compiler() -> str | None:
    """The compiler named by the environment variable CC, or `cc`; None where it is not there."""
    return shutil.which(os.environ.get("CC") or "cc")


@functools.cache
def missing() -> str | None:
    """A line that says what C needs and does not find, or None where it is all there."""
    if compiler() is None:
        return "there is no C compiler `cc`, so JAX does the work"
    try:
        import cffi  # noqa: F401
    except ImportError:
        return "cffi is not installed (pip install 'covariant[engine]'), so JAX does the work"
    return None


def library(source: str, declarations: str) -> tuple[Any, Any]:
    """A source compiled: the `cffi.FFI` and the library.

    It is kept by the hash of the source, the flags and the compiler. With `COVARIANT_CACHE=off` it is compiled anew.
    Raises `OSError` where it cannot be compiled.
    """
    import cffi

    ffi = cffi.FFI()
    ffi.cdef(declarations)
    key = hashlib.sha256("\n".join([source, *FLAGS, _version()]).encode()).hexdigest()[:32]
    folder = cache_folder()
    if folder is None:
        # The file may go once it is loaded.
        with tempfile.TemporaryDirectory() as place:
            return ffi, ffi.dlopen(str(_compiled(source, Path(place) / f"{key}.so")))
    path = folder / f"{key}.so"
    return ffi, ffi.dlopen(str(path if path.exists() else _compiled(source, path)))


def _compiled(source: str, path: Path) -> Path:
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        text, made = Path(place) / "source.c", Path(place) / "made.so"
        text.write_text(source, encoding="utf-8")
        command = [str(compiler()), *FLAGS, str(text), "-o", str(made), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{compiler()} does not compile the observer: {done.stderr.strip()[:200]}")
        os.replace(made, path)  # whole or not at all, whoever else makes it at the same time
    return path


@functools.cache
def _version() -> str:
    done = subprocess.run([str(compiler()), "--version"], capture_output=True, text=True, check=False)
    return f"{compiler()}\n{done.stdout}"
