"""Writes columns of numbers, first to a file beside the target, so that the target is complete or unchanged."""

import csv
import io
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np

from covariant.logs._bag_write import write_bag
from covariant.logs._columns import LogError, pyarrow
from covariant.logs._endings import MESSAGES, WRITTEN
from scalargraph.files import write_atomically


def write(path: str | PathLike[str], columns: Mapping[str, np.ndarray], origin_ns: int | None = None) -> None:
    """Write columns of numbers to a file or folder; floats are read back exactly, NaN included.

    The file appears at once and complete, and replaces a file of the same name; after a failure the old file is
    unchanged. A folder is never replaced.

    Args:
        path: A `.csv`, `.txt` or `.tsv` file, a `.parquet` file, or ROS messages: an `.mcap` file, or the folder of a
            rosbag2 whose name ends in `.rosbag2`. In messages stamps are whole nanoseconds, `shoulder/position`,
            `shoulder/velocity` and `shoulder/effort` are a joint, and px, py, pz, qw, qx, qy, qz are a pose.
        columns: Arrays (T,) by name, the first of them the stamps [s].
        origin_ns: Time [ns since 1970] from which the stamps count; it is written to messages only.

    Raises:
        LogError: The columns are not 1-D numbers of one length, or the file cannot be written.
        ImportError: pyarrow is missing, or rosbags for messages.

    Example:
        >>> import numpy as np
        >>> from covariant import logs
        >>> logs.write("run.csv", {"t": np.array([0.0, 0.1]), "q1": np.array([0.5, np.nan])})
        >>> logs.record("run.csv", q="q1").y.tolist()
        [[0.5], [nan]]
    """
    path = Path(path)
    if path.suffix.lower() not in WRITTEN:
        ending = path.suffix or "nothing"
        raise LogError(f"{path}: a log to write must end in {', '.join(WRITTEN)}; this one ends in {ending}")
    if not path.parent.is_dir():
        raise LogError(f"{path}: there is no folder {path.parent}; make it first")
    checked = _check_columns(path, columns)
    try:
        if path.suffix.lower() in MESSAGES:
            if path.is_dir():
                raise LogError(f"{path}: there is such a folder already, and it is not replaced; give another name")
            write_bag(path, checked, origin_ns)
            return
        pa = pyarrow()
        table = pa.table({name: _column(pa, array) for name, array in checked.items()})
        save = _write_parquet if path.suffix.lower() == ".parquet" else _write_csv
        write_atomically(path, lambda file: save(pa, table, file, "\t" if path.suffix.lower() == ".tsv" else ","))
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error


def _check_columns(path: Path, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
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


def _column(pa: ModuleType, array: np.ndarray) -> Any:
    """A column of Arrow that shares the memory of an array; Arrow's own conversion would import pandas first."""
    # Arrow expects the byte order of the machine; an array read from a file may have the other.
    numbers = pa.py_buffer(np.ascontiguousarray(array, array.dtype.newbyteorder("=")))
    return pa.Array.from_buffers(pa.from_numpy_dtype(array.dtype), len(array), [None, numbers])


def _write_parquet(pa: ModuleType, table: Any, file: BinaryIO, _: str) -> None:
    pa.parquet.write_table(table, file)


def _write_csv(pa: ModuleType, table: Any, file: BinaryIO, delimiter: str) -> None:
    """Arrow writes the shortest digits that read back exactly; the header is written here, since Arrow quotes it."""
    header = io.StringIO()
    csv.writer(header, lineterminator="\n", delimiter=delimiter).writerow(table.column_names)
    file.write(header.getvalue().encode())
    pa.csv.write_csv(table, file, pa.csv.WriteOptions(include_header=False, delimiter=delimiter))
