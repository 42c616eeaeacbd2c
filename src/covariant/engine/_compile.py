"""What a compiled observer needs: a compiler, and cffi, which calls it."""

import functools
from typing import Any

from scalargraph.compiler import FAST, compiled, compiler


@functools.cache
def missing() -> str | None:
    """What compiled C lacks on this machine, in one line for messages; None where compiler and `cffi` are present."""
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
