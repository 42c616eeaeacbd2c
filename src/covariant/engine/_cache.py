"""Caches generated C on disk between processes, keyed by what the observer computes.

The key of a text is a hash of the traced observer (`scalargraph.fingerprint`), which is faster to compute than the C.
It covers every operation and every constant. So it is the same for equal observers, whether of library models, model
files or a user's functions, and it differs as soon as one of them computes something else. If an observer consists of
classes and functions of this library only, key and layout are also cached under its description (`_description`), and
nothing is traced.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from covariant.codegen import Program
from covariant.engine._layout import Layout
from covariant.engine._sources import source_files
from scalargraph import LoweringError, fingerprint
from scalargraph.cache import cache_folder, evict_unused
from scalargraph.files import read_sealed, write_sealed

PACKAGES = ("jax", "jaxlib", "numpy")
"""Packages whose versions are part of the key, since they compute constants of the C."""
_WRITERS = source_files("scalargraph", "covariant/codegen/_program.py", "covariant/engine")
WRITTEN_BY = hashlib.sha256(b"\n".join(path.read_bytes() for path in _WRITERS)).hexdigest()
"""A hash of the files that write the C; a change of any of them invalidates the cache."""


def cache_key(traced: Program, lanes: int) -> str | None:
    """Cache key of the C text of a traced observer."""
    if cache_folder() is None:
        return None
    functions = (traced.init.jaxpr, traced.step.jaxpr, traced.estimate.jaxpr)
    names = tuple(leaf.name for leaves in (traced.given, traced.state, traced.info, traced.x) for leaf in leaves)
    versions = (WRITTEN_BY, *map(version, PACKAGES))
    return fingerprint(*functions, names, traced.y, traced.u, traced.real, lanes, result_index(traced), versions)


def result_index(traced: Program) -> int:
    """Index of the result code in the flattened info of `traced`."""
    return [leaf.name for leaf in traced.info for _ in range(leaf.size)].index("result")


def cached_text(key: str | None, write: Callable[[], str]) -> str:
    """C text under a cache key; it is written first if it is not cached."""
    folder = cache_folder()
    if folder is None or key is None:
        return write()
    # 128 bits of the hash are used: a collision is practically impossible.
    path = folder / f"{key[:32]}.json"
    entry = _read_entry(path)
    if entry is None:
        entry = _write_or_refuse(write)
        with contextlib.suppress(OSError):  # such as a full disk
            write_sealed(path, json.dumps(entry).encode())
            evict_unused(folder)
    if "refused" in entry:
        raise LoweringError(entry["refused"])
    return entry["c"]


def cached_layout(description: str | None) -> tuple[str, Layout] | None:
    """Key of a C text and the layout of its observer, cached under the observer's description; None
    if they are not cached.
    """
    folder = cache_folder()
    if folder is None or description is None:
        return None
    try:
        key, *data = json.loads(read_sealed(folder / f"{description[:32]}.json") or b"{}")["traced"]
        return str(key), Layout.from_data(data)
    except (ValueError, TypeError, KeyError):
        return None


def cache_layout(description: str | None, key: str | None, layout: Layout) -> None:
    """Cache the key of a C text and the layout under an observer's description, if it has a key and a description."""
    folder, data = cache_folder(), layout.data()
    if folder is not None and description is not None and key is not None and data is not None:
        entry = json.dumps({"traced": [key, *data]}).encode()
        with contextlib.suppress(OSError):
            write_sealed(folder / f"{description[:32]}.json", entry)


def _read_entry(path: Path) -> dict[str, str] | None:
    """Read an entry; None if there is none, or it was changed."""
    try:
        entry = json.loads(read_sealed(path) or b"{}")
    except ValueError:
        return None
    # A file with an older layout, or from another program, counts as absent.
    valid = isinstance(entry, dict) and len(entry) == 1 and isinstance(entry.get("c", entry.get("refused")), str)
    return entry if valid else None


def _write_or_refuse(write: Callable[[], str]) -> dict[str, str]:
    try:
        return {"c": write()}
    except LoweringError as error:
        return {"refused": str(error)}
