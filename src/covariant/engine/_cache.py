"""Generated C is kept in the cache folder from one process to the next, keyed by what the observer computes.

The key is a hash of the traced observer (`lowering.fingerprint`), which takes a part of the time that its C takes to
write: it holds every operation and every constant, so it is the same for equal observers of library models, of model
files and of a user's own functions, and another one as soon as any of them computes something else.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from covariant._files import write_atomically
from covariant._programs import cache_folder, evict_unused
from covariant.codegen import TracedProgram
from covariant.lowering import LoweringError, fingerprint

PACKAGES = ("jax", "jaxlib", "numpy")
"""They compute the constants of a text."""
_ROOT = Path(__file__).parents[1]
_WRITERS = sorted([*_ROOT.glob("lowering/*.py"), *_ROOT.glob("codegen/_program.py"), *_ROOT.glob("engine/*.py")])
WRITTEN_BY = hashlib.sha256(b"\n".join(path.read_bytes() for path in _WRITERS)).hexdigest()
"""A hash of the files that write the C: a finer version of this library, for those who work on it."""


def cache_key(traced: TracedProgram, lanes: int) -> str | None:
    """What the text of a traced observer is kept under; None where there is no cache, or it has no fingerprint."""
    if cache_folder() is None:
        return None
    functions = (traced.init.jaxpr, traced.step.jaxpr, traced.estimate.jaxpr)
    names = tuple(leaf.name for leaves in (traced.given, traced.state, traced.info, traced.x) for leaf in leaves)
    versions = (WRITTEN_BY, *map(version, PACKAGES))
    return fingerprint(*functions, names, traced.y, traced.u, traced.real, lanes, result_index(traced), versions)


def result_index(traced: TracedProgram) -> int:
    """Where the result code is among the numbers of an info."""
    return [leaf.name for leaf in traced.info for _ in range(leaf.size)].index("result")


def cached_text(key: str | None, write: Callable[[], str]) -> str:
    """The text that `write` wrote under a key before, in this process or an earlier one, or what it writes now.

    A `LoweringError`, which takes as long to find, is kept as well, and raised again.
    """
    folder = cache_folder()
    if folder is None or key is None:
        return write()
    place = folder / f"{key[:32]}.json"
    entry = _read(place)
    if entry is None:
        entry = _written_or_refused(write)
        with contextlib.suppress(OSError):  # such as a full disk
            write_atomically(place, lambda file: file.write(json.dumps(entry).encode()))
            evict_unused(folder)
    if "refused" in entry:
        raise LoweringError(entry["refused"])
    return entry["c"]


def _read(place: Path) -> dict[str, str] | None:
    """An entry; None where there is none, or the file was cut short."""
    try:
        entry = json.loads(place.read_bytes())
    except (OSError, ValueError):
        return None
    valid = isinstance(entry, dict) and len(entry) == 1 and isinstance(entry.get("c", entry.get("refused")), str)
    return entry if valid else None


def _written_or_refused(write: Callable[[], str]) -> dict[str, str]:
    try:
        return {"c": write()}
    except LoweringError as error:
        return {"refused": str(error)}
