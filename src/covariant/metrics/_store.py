"""Stores a map on disk: a Zarr group with coordinates, variables, and a flag `done` for each block, which is set last.

Each block of the grid is one chunk of every variable and one of `done`, so no two writers share a file. This protects
against killed processes, but not against a power failure, since files are not forced to the disk one by one. Chunks
that contain only the fill value are written too, so a missing chunk always means that the block is damaged.
"""

import contextlib
import importlib.metadata
import json
import math
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from covariant._cases import content_hash, optional
from covariant._door import STORE
from covariant.metrics._grid import Blocks, Grid
from scalargraph.errors import InputError
from scalargraph.files import attended, bounded, check_file, sweep, temporary

if TYPE_CHECKING:
    import xarray

FORMAT = "covariant grid 1"
DONE = "done"
FUNCTION = "function"
"""Name of the attribute that holds the content hash of the function."""


class Variable(NamedTuple):
    """Description of one output of a function on a grid.

    Attributes:
        dims: names of the variable's axes that follow those of the grid; `()` for a number.
        units: its unit.
        description: a text that explains it.

    Example:
        >>> from covariant.metrics import Variable
        >>> Variable(dims=("row", "column"), units="kg m^2", description="inertia matrix").dims
        ('row', 'column')
    """

    dims: tuple[str, ...]
    units: str
    description: str


def open_grid(path: str | os.PathLike[str], *, complete: bool = False) -> "xarray.Dataset":
    """Open a map of `map_grid` as a lazy `xarray.Dataset`.

    Args:
        path: path of the store.
        complete: whether missing blocks are an error; False by default.

    Returns:
        Dataset of coordinates and variables with their units, and the provenance as attributes. In an unfinished map,
        points not yet computed are NaN, and integers and flags are therefore read as float64.

    Raises:
        ValueError: one line: there is no map, a map has lost files of blocks that were computed, or `complete` is
            required and blocks are missing.

    Example:
        >>> from covariant.metrics import Grid, Variable, map_grid, open_grid
        >>> grid = Grid(("x",), ("m",), low=(0.0,), high=(3.0,), counts=(4,))
        >>> area = Variable((), "m^2", "area of a square")
        >>> path = map_grid(lambda x: {"area": x[0] ** 2}, grid, "squares.zarr",
        ...                 variables={"area": area}, provenance={"formula": "x^2"})
        >>> float(open_grid(path).area.sel(x=2.0))
        4.0
    """
    path = Path(path)
    attributes = _attributes(path)
    counts = [-(-n // side) for n, side in zip(attributes["grid"]["counts"], attributes["block"], strict=True)]
    # Flags are read first: a block that another process writes meanwhile has all its chunks before its flag.
    flagged = math.prod(counts) if attributes["complete"] else len(_chunks(path / DONE, len(counts)))
    missing = math.prod(counts) - len(written(path, len(counts)))
    if missing > math.prod(counts) - flagged or (complete and not attributes["complete"]):
        empty = next((chunk for chunk in path.glob("*/c/**/*") if chunk.is_file() and not chunk.stat().st_size), None)
        raise InputError(
            f"{path} is not complete: {missing} of {math.prod(counts)} blocks are missing"
            f"{'' if empty is None else f', {empty} is empty'}; run its map_grid again"
        )
    dataset = optional("xarray").open_zarr(path, consolidated=False, chunks="auto", decode_cf=False)
    done, dataset = dataset[DONE], dataset[list(attributes["variables"])]
    if attributes["complete"]:
        return dataset
    # In floating-point variables the fill value NaN marks missing points already.
    return dataset.map(lambda v: v if np.issubdtype(v.dtype, np.inexact) else v.astype(float).where(done), True)


def configuration(
    grid: Grid, blocks: Blocks, variables: Any, provenance: Any, function: str | None = None
) -> dict[str, Any]:
    """Settings that two runs must have in common to work on one store, with a content hash of them.

    `function` is a content hash of what is evaluated; None if it has none.
    """
    low, high = grid.ends
    box = {"names": tuple(grid.names), "units": tuple(grid.units), "low": low, "high": high, "counts": grid.shape}
    whole = {"grid": box, "variables": variables, "provenance": provenance, "block": blocks.sides, FUNCTION: function}
    try:
        text = json.dumps(whole, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"provenance must be made of texts, finite numbers, lists and dicts: {error}") from error
    plain = json.loads(text)
    return plain | {"digest": content_hash(plain)}


def prepare(path: Path, settings: dict[str, Any], blocks: Blocks) -> None:
    """Create the store, or check that an existing one has the same configuration."""
    sweep(path)
    if not os.path.lexists(path):
        return _create(path, settings, blocks)
    attributes = _attributes(path)
    compared, begun = set(settings), bool(written(path, len(blocks.sides)))
    other_version = _versions() not in attributes["versions"]
    # The hash of the function is not compared in an empty store, nor in a finished one of another version, whose hashes
    # mean nothing here.
    if not begun or (attributes["complete"] and other_version):
        compared -= {FUNCTION, "digest"}
    stored, asked = ({name: each.get(name) for name in settings if name in compared} for each in (attributes, settings))
    if stored != asked:
        raise InputError(
            f"{path} holds another map: {_difference(stored, asked)}; give another path, or remove that store"
        )
    if not begun:
        _annotate(path, **{name: settings[name] for name in (FUNCTION, "digest")})
    if other_version and not attributes["complete"]:
        _annotate(path, versions=[*attributes["versions"], _versions()])
    return None


@contextlib.contextmanager
def tidied(path: Path) -> Iterator[None]:
    """Context in which a map is written; on entry, if nobody else is writing, files of killed writers are removed."""

    def tidy():
        for partial in path.rglob("*.partial"):  # Zarr writes each chunk to such a file first
            partial.unlink(missing_ok=True)

    with attended(path, tidy):
        yield


def finish(path: Path) -> None:
    """Mark the map at this path as complete."""
    _annotate(path, complete=True)


def written(path: Path, n: int) -> set[tuple[int, ...]]:
    """List the indices of blocks that are done and have all their chunks."""
    attributes = _attributes(path)
    blocks = _chunks(path / DONE, n)  # a chunk of `done` exists only if the flag is set
    # A chunk may be lost although its flag is set, for example by an incomplete copy.
    for name, variable in attributes["variables"].items():
        # The variable's own axes are never divided: each has a single chunk, number 0.
        blocks &= {index[:n] for index in _chunks(path / name, n + len(variable["shape"]))}
    return blocks


def _chunks(array: Path, n: int) -> set[tuple[int, ...]]:
    """List the indices of the existing chunks of an array of n axes."""
    # Chunks are listed, not read: reading would try every chunk of the grid, of which only a few exist at first.
    chunks = (array / "c").glob("/".join("*" * n))
    # A name that is not a number belongs to a file that is still being written; an empty file is damaged.
    whole = (chunk for chunk in chunks if chunk.name.isdecimal() and chunk.stat().st_size)
    return {tuple(map(int, chunk.parts[-n:])) for chunk in whole}


def write(path: str, region: tuple[slice, ...], values: Mapping[str, np.ndarray]) -> None:
    """Write a block, then its flag: if the writer is killed in between, the block is computed again.

    Args:
        path: path of the store.
        region: slices of the grid that the block covers.
        values: arrays of the block, by the name of the variable.
    """
    store = optional("zarr").open_group(path, mode="r+")
    for name, value in values.items():
        store[name].with_config({"write_empty_chunks": True})[region] = value
    store[DONE][region] = True


def _create(path: Path, settings: dict[str, Any], blocks: Blocks) -> None:
    """Fill a folder beside the path and rename it to the path, so that the store is either complete or absent."""
    with temporary(path, Path.mkdir) as fresh:
        _fill(optional("zarr").open_group(str(fresh), mode="w"), settings, blocks)
        # Renaming a folder is atomic, so other processes never see an incomplete store.
        fresh.rename(path)


def _fill(store: Any, settings: dict[str, Any], blocks: Blocks) -> None:
    created = datetime.now(UTC).isoformat(timespec="seconds")
    head = {"format": FORMAT, "created": created, "versions": [_versions()], "complete": False}
    store.attrs.put(head | settings)
    names, shape = settings["grid"]["names"], tuple(map(len, blocks.axes))
    for name, units, axis in zip(names, settings["grid"]["units"], blocks.axes, strict=True):
        coordinate = store.create_array(
            name, shape=axis.shape, dtype=axis.dtype, chunks=axis.shape, dimension_names=[name], fill_value=np.nan
        )
        coordinate.attrs.put({"units": units})
        coordinate[:] = axis
    flag = {"shape": [], "dtype": "bool", "dims": [], "units": "", "description": "whether the point has been computed"}
    for name, variable in {**settings["variables"], DONE: flag}.items():
        dtype = np.dtype(variable["dtype"])
        store.create_array(
            name,
            shape=(*shape, *variable["shape"]),
            dtype=dtype,
            chunks=(*blocks.sides, *variable["shape"]),
            dimension_names=[*names, *variable["dims"]],
            fill_value=np.nan if np.issubdtype(dtype, np.inexact) else 0,
            attributes={"units": variable["units"], "description": variable["description"]},
        )


def _attributes(path: Path) -> dict[str, Any]:
    attributes: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError), bounded(path):
        for part in (path / "zarr.json", *path.glob("*/zarr.json")):
            check_file(part, STORE)
        attributes = optional("zarr").open_group(str(path), mode="r").attrs.asdict()
    if attributes.get("format") != FORMAT:
        raise InputError(f"{path} is not a map made by map_grid; give another path")
    return attributes


def _annotate(path: Path, **attributes: object) -> None:
    optional("zarr").open_group(str(path), mode="r+").attrs.update(attributes)


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("covariant", "jax", "numpy")}


def _difference(there: object, here: object, name: str = "") -> str:
    """A description of the first difference, with its dotted name."""
    if isinstance(there, dict) and isinstance(here, dict):
        key = next(key for key in [*here, *there] if there.get(key) != here.get(key))
        if not name and key == FUNCTION:
            return "what is evaluated at a point was changed since, as by an edit of the model or by another version"
        return _difference(there.get(key), here.get(key), f"{name}.{key}".lstrip("."))
    return f"{name} is {there!r} there and {here!r} here"
