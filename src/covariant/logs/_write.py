"""Writing of columns of numbers: first into a file beside the target, so that the target is complete or unchanged."""

import csv
import io
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from covariant._files import write_atomically
from covariant.logs._columns import LogError, kind, pyarrow


def write(path: str | PathLike[str], columns: Mapping[str, np.ndarray]) -> None:
    """Write columns (T,) by name to a `.csv` or `.parquet` file; floats are read back exactly, NaN included.

    The file appears at once and complete, replacing one of the same name; after a failure the old one is unchanged.
    Raises `LogError` when the columns are not 1-D numbers of one length or the file cannot be written; `ImportError`
    without pyarrow.
    """
    path = Path(path)
    save = {".csv": _write_csv, ".parquet": _write_parquet}[kind(path)]
    if not path.parent.is_dir():
        raise LogError(f"{path}: there is no folder {path.parent}; make it first")
    pa = pyarrow()
    table = pa.table(_checked(path, columns))
    try:
        write_atomically(path, lambda file: save(pa, table, file))
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error


def _checked(path: Path, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    if not arrays:
        raise LogError(f"{path}: there are no columns to write")
    for name, array in arrays.items():
        if array.ndim != 1 or array.dtype.kind not in "fiu":
            raise LogError(
                f"{path}: column {name!r} must be one row of numbers (T,); got {array.dtype} of shape {array.shape}"
            )
    first = next(iter(arrays))
    for name, array in arrays.items():
        if len(array) != len(arrays[first]):
            raise LogError(
                f"{path}: column {name!r} has {len(array)} rows where {first!r} has {len(arrays[first])}; cut or pad it"
            )
    return arrays


def _write_parquet(pa: Any, table: Any, file: BinaryIO) -> None:
    pa.parquet.write_table(table, file)


def _write_csv(pa: Any, table: Any, file: BinaryIO) -> None:
    """Arrow writes the shortest digits that read back exactly; the header is written here, since Arrow quotes it."""
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(table.column_names)
    file.write(header.getvalue().encode())
    pa.csv.write_csv(table, file, pa.csv.WriteOptions(include_header=False))
