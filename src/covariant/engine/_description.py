"""Computes a cache key of a compiled observer from its classes, functions and numbers, without tracing it.

An observer of this library is data: a tree of classes and functions of this library, named by their modules, and of
settings and numbers. The key is a hash of this tree, of the library's files, and of the versions of packages, flags and
compiler. An observer that contains anything else, such as a function of a user's script, has no such key; only its
traced operations show what it computes (`_cache.cache_key`).

The key assumes that this library's functions are those of its files. Scripts that replace one set
`COVARIANT_CACHE=off`.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from covariant import _programs
from covariant.engine._numbers import Places
from covariant.engine._sources import LIBRARY, ROOT, source_files
from covariant.observers import AbstractObserver
from scalargraph.cache import cache_folder

PACKAGES = ("jax", "jaxlib", "equinox", "numpy", "scipy")
"""Packages that trace an observer and compute its constants."""


class _UnknownError(Exception):
    """Raised for a part of an observer that the library's files do not determine."""


def description_key(observer: AbstractObserver, places: Places, *form: object) -> str | None:
    """Cache key of a compiled observer, computed from its parts."""
    if cache_folder() is None or _source_may_differ():
        return None
    leaves = jax.tree.leaves(eqx.filter(observer, eqx.is_inexact_array))
    opened: dict[int, tuple[int, ...] | None] = {}
    for leaf, at in zip(leaves, places or (None,) * len(leaves), strict=True):
        if opened.setdefault(id(leaf), at) != at:  # one array occurs twice, but is open in one place only
            return None
    digest = hashlib.sha256(_environment().encode())
    try:
        for part in (*_parts((places, form), {}), *_parts(observer, opened)):
            digest.update(b"%d:" % len(part) + part)  # the length separates the parts of a list unambiguously
    except _UnknownError:
        return None
    return digest.hexdigest()


def _parts(x: Any, opened: dict[int, tuple[int, ...] | None]) -> Iterator[bytes]:
    """The parts of a value, each preceded by its type; the entries of open arrays are left out."""
    kind = type(x)
    if x is None or kind in (bool, int, str, bytes, complex):
        yield f"{kind.__name__} {x!r}".encode()
    elif kind is float:
        yield f"float {x.hex()}".encode()  # hexadecimal, so that different numbers that print alike differ
    elif isinstance(x, enum.Enum):
        yield f"{_name(kind)} {x.name}".encode()
    elif isinstance(x, np.dtype):
        yield f"dtype {x.str}".encode()
    elif kind is np.ndarray or isinstance(x, (np.generic, jax.Array)):  # a subclass could compute anything
        yield from _array(x, opened.get(id(x)))
    elif isinstance(x, tuple) and (kind is tuple or hasattr(x, "_fields")):
        yield f"{'tuple' if kind is tuple else _name(kind)} {len(x)}".encode()
        for each in x:
            yield from _parts(each, opened)
    elif kind is list:
        yield f"list {len(x)}".encode()
        for each in x:
            yield from _parts(each, opened)
    elif isinstance(x, dict) and kind is dict:
        yield f"dict {len(x)}".encode()
        for item in x.items():
            yield from _parts(item, opened)
    elif isinstance(x, functools.partial) and kind is functools.partial:
        yield b"partial"
        yield from _parts((x.func, x.args, x.keywords), opened)
    elif dataclasses.is_dataclass(x) and not isinstance(x, type):
        yield from _record(x, opened)
    else:
        yield f"name {_name(x)}".encode()


def _record(x: Any, opened: dict[int, tuple[int, ...] | None]) -> Iterator[bytes]:
    fields = dataclasses.fields(x)
    if vars(x).keys() != {field.name for field in fields}:  # it has an attribute that its class does not declare
        raise _UnknownError
    yield f"{_name(type(x))} {len(fields)}".encode()
    for field in fields:
        yield field.name.encode()
        # An array in a static field is not a leaf, although the same array may be a leaf elsewhere.
        yield from _parts(vars(x)[field.name], {} if field.metadata.get("static") else opened)


def _array(x: np.ndarray | np.generic | jax.Array, at: tuple[int, ...] | None) -> Iterator[bytes]:
    kind = "jax" if isinstance(x, jax.Array) else type(x).__name__
    try:
        values = np.asarray(x)
    except TypeError as error:  # such as a key of random numbers
        raise _UnknownError from error
    if values.dtype.hasobject:
        raise _UnknownError
    yield f"array {kind} {values.dtype.str} {values.shape} {getattr(x, 'weak_type', False)} {at}".encode()
    yield (values if at is None else values.ravel()[np.array(at, int) < 0]).tobytes()


def _name(x: object) -> str:
    """The name under which the library's modules define a class or a function."""
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module.partition(".")[0] not in LIBRARY:
        raise _UnknownError
    held: Any = sys.modules.get(module)
    for part in name.split("."):  # a function defined inside another one cannot be reached by such a path
        held = getattr(held, part, None)
    if held is not x:
        raise _UnknownError
    return f"{module}:{name}"


@functools.cache
def _files() -> list[Path]:
    return source_files(*LIBRARY)


def _source_may_differ() -> bool:
    """Whether a file may have changed since it was imported; then its content does not show what is traced."""
    try:
        return max(path.stat().st_mtime for path in _files()) > _programs.IMPORTED
    except OSError:  # it is gone
        return True


@functools.cache
def _library() -> str:
    """A hash of the library's files, and of the versions of the packages with which it computes."""
    digest = hashlib.sha256("\n".join([sys.version, *map(version, PACKAGES)]).encode())
    for path in _files():
        digest.update(f"\n{path.relative_to(ROOT).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _environment() -> str:
    """The library, and JAX's present flags, some of which change types and constants of what is traced."""
    flags = {name: getattr(jax.config, name, value) for name, value in jax.config.values.items()}
    return "\n".join([_library(), *(f"{name} {flags[name]!r}" for name in sorted(flags))])
