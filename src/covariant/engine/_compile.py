"""What a compiled observer needs: a compiler, and cffi, which calls it."""

import functools
from typing import Any

from covariant._compile import FAST, compiled, compiler


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
    """A source compiled: the `cffi.FFI` and the library. Raises `OSError` where it cannot be compiled."""
    import cffi

    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, compiled(source, FAST, ffi.dlopen)
