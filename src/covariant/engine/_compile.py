"""Checks that the tools for compiled observers are present (a compiler and cffi), and compiles C sources with them."""

import functools
from typing import Any

from scalargraph.compiler import FAST, compiled, compiler


@functools.cache
def missing() -> str | None:
    """The tool that compiled C lacks on this machine, in one line for messages; None if compiler and `cffi` exist."""
    if compiler() is None:
        return "there is no C compiler `cc`, so JAX does the work"
    try:
        import cffi  # noqa: F401
    except ImportError:
        return "cffi is not installed (pip install 'covariant[engine]'), so JAX does the work"
    return None


def library(source: str, declarations: str) -> tuple[Any, Any]:
    """Compile a C source and load it."""
    import cffi

    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, compiled(source, FAST, ffi.dlopen)
