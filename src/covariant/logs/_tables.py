"""Logs in memory: data frames of any library that narwhals knows, and datasets of xarray, as tables of Arrow."""

import sys
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from covariant._optional import load_optional
from covariant.logs._columns import LogError, pyarrow
from covariant.signals import Record

UNIT_KEYS = ("unit", "units")
"""Keys of the metadata of a column under which its unit stands, in small letters."""


class LogSource(NamedTuple):
    """The columns of a log, loaded on demand.

    Attributes:
        names: All names under which columns can be loaded.
        shown: One name for each column; a log of messages knows longer ones as well.
        load: `load(wanted, held, beside)`: the wanted columns as a table of Arrow. Columns that are `held` repeat the
            last value where they are not logged with the others. Of a log of messages, those `beside` them make rows of
            their own as well.
        units: Units that the log itself states, by column.
        first_line: The first line of a text that has no header, whose columns are called 1, 2, 3.
        typed: Whether the log states the types of its columns, as no text does.
    """

    names: Sequence[str]
    shown: Sequence[str]
    load: Callable[[Sequence[str], Sequence[str], Sequence[str]], Any]
    units: Mapping[str, str] = MappingProxyType({})
    first_line: str = ""
    typed: bool = True


def source_name(log: Any) -> str:
    """Name of a log in messages: its path, or "table", "dataset" or "record" for one in memory.

    Args:
        log: A path, data frame, dataset or `Record`.

    Returns:
        The name.

    Example:
        >>> from covariant import logs
        >>> logs.source_name("run7.csv")
        'run7.csv'
    """
    if isinstance(log, (str, PathLike)):
        return str(Path(log))
    if isinstance(log, Record):
        return "record"
    return "dataset" if _is_dataset(log) else "table"


def table_source(name: str, log: Any) -> LogSource:
    """Columns of a data frame or dataset."""
    if _is_dataset(log):
        return _dataset_source(name, log)
    narwhals = load_optional("narwhals", use="reading data frames needs", extra="logs")
    try:
        frame = narwhals.from_native(_with_index(log))
    except TypeError:
        raise LogError(
            f"{name}: a log is a path, a data frame, a dataset of xarray or a Record; got {type(log).__name__}"
        ) from None
    except narwhals.exceptions.NarwhalsError as error:
        raise LogError(f"{name}: {' '.join(str(error).split())}") from error
    if isinstance(frame, narwhals.LazyFrame):
        frame = frame.collect()
    native = frame.to_native()
    units = stated_units(native.schema) if isinstance(native, pyarrow().Table) else {}
    names = [str(column) for column in frame.columns]
    places = dict(zip(names, frame.columns, strict=True))

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        return pyarrow().table(
            {column: _arrow(name, column, frame[places[column]].to_arrow) for column in (*wanted, *beside)}
        )

    return LogSource(names, names, load, units)


def stated_units(schema: Any) -> dict[str, str]:
    """Units in the metadata of the fields of a schema of Arrow."""
    units = {}
    for field in schema:
        for key, text in (field.metadata or {}).items():
            if key.decode(errors="replace").lower() in UNIT_KEYS and text.strip():
                units[field.name] = text.decode(errors="replace").strip()
    return units


def _is_dataset(log: Any) -> bool:
    """Whether a log is a dataset of xarray, which is looked for only where xarray is imported."""
    xarray = sys.modules.get("xarray")
    return xarray is not None and isinstance(log, xarray.Dataset)


def _with_index(log: Any) -> Any:
    """A data frame of pandas with its index as a column where the index has a name, as a clock often has."""
    pandas = sys.modules.get("pandas")
    if pandas is None or not isinstance(log, pandas.DataFrame):
        return log
    indices = {index: log.index.get_level_values(k).dtype for k, index in enumerate(log.index.names)}
    for column, kind in [*log.dtypes.items(), *indices.items()]:
        if str(kind).startswith("period"):
            raise LogError(f"table: column {column!r} holds periods of time; convert it by to_timestamp()")
    named = [index for index in log.index.names if index is not None and index not in log.columns]
    return log.reset_index(level=named) if named else log


def _dataset_source(name: str, log: Any) -> LogSource:
    """The one-dimensional variables and coordinates along the dimension that most of them share."""
    lines = {str(key): variable for key, variable in log.variables.items() if len(variable.dims) == 1}
    along = [variable.dims[0] for variable in lines.values()]
    if not along:
        raise LogError(f"{name}: it has no variable along one dimension, such as time")
    # Of equal counts `max` takes the first, in the order of the dataset.
    time = max(dict.fromkeys(along), key=along.count)
    columns = {key: variable for key, variable in lines.items() if variable.dims[0] == time}
    units = {
        key: str(text).strip()
        for key, variable in columns.items()
        for name_of_attribute, text in variable.attrs.items()
        if str(name_of_attribute).lower() in UNIT_KEYS
    }

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        return pyarrow().table(
            {
                key: _arrow(name, key, lambda v=columns[key]: pyarrow().array(np.asarray(v.values)))
                for key in (*wanted, *beside)
            }
        )

    return LogSource(list(columns), list(columns), load, units)


def _arrow(name: str, column: str, convert: Callable[[], Any]) -> Any:
    """A column as Arrow has it; raises `LogError` for cells of several kinds."""
    pa = pyarrow()
    try:
        cells = convert()
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise LogError(f"{name}: column {column!r} is no column of numbers: {str(error).splitlines()[0]}") from error
    cells = cells if isinstance(cells, pa.ChunkedArray) else pa.chunked_array([cells])
    if pa.types.is_dictionary(cells.type) or pa.types.is_large_string(cells.type):
        cells = cells.cast(pa.string())
    return cells
