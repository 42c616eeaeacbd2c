"""Reads logs in memory, data frames of any library that narwhals knows and datasets of xarray, as tables of Arrow."""

import contextlib
import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from covariant._names import did_you_mean
from covariant._optional import load_optional
from covariant.logs._columns import LogError, pyarrow
from covariant.signals import Record
from scalargraph.errors import file_name

_UNIT_KEY = re.compile(r"(?:.*[_ .:])?units?(?:_of_measure(?:ment)?)?", re.IGNORECASE)
"""Metadata keys for the unit of a column, and for the units of all columns in the metadata of a table."""


class LogSource(NamedTuple):
    """The columns of a log, loaded on demand.

    Attributes:
        names: All names under which columns can be loaded.
        shown: One name for each column; a log of messages also accepts longer ones.
        load: `load(wanted, held, beside)`: the wanted columns as a table of Arrow. Columns that are `held` repeat their
            last value in rows in which they were not logged. In a log of messages the columns `beside` add rows at
            their own stamps.
        units: Units that the log itself states, by column.
        first_line: The first line of a text that has no header; its columns are called 1, 2, 3.
        decimal_commas: Whether a comma within a cell is certainly a decimal mark, as between semicolons.
        lists: Columns whose cells may be lists.
        labels: Names that the log gives to the entries of lists, by column.
    """

    names: Sequence[str]
    shown: Sequence[str]
    load: Callable[[Sequence[str], Sequence[str], Sequence[str]], Any]
    units: Mapping[str, str] = MappingProxyType({})
    first_line: str = ""
    decimal_commas: bool = False
    lists: Sequence[str] = ()
    labels: Mapping[str, str] = MappingProxyType({})


def source_name(log: object) -> str:
    """Name of a log in messages and tables: its path in printable form, or "table", "dataset" or "record" in memory.

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
        return file_name(Path(log))
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
    units = stated_units(native.schema) if isinstance(native, pyarrow().Table) else _units_of(getattr(log, "attrs", {}))
    names = [str(column) for column in frame.columns]
    places = dict(zip(names, frame.columns, strict=True))

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        asked = (*wanted, *beside)
        return pyarrow().table({column: _arrow(name, column, frame[places[column]].to_arrow) for column in asked})

    lists = [str(column) for column in frame.columns if _may_hold_lists(frame[column])]
    return LogSource(names, names, load, units, lists=lists)


def _may_hold_lists(cells: Any) -> bool:
    """Whether a series of narwhals may contain lists; pandas stores lists, arrays and texts alike as objects."""
    narwhals = load_optional("narwhals", use="reading data frames needs", extra="logs")
    if cells.dtype != narwhals.Object:
        return isinstance(cells.dtype, (narwhals.List, narwhals.Array))
    return any(isinstance(cell, (list, tuple, np.ndarray)) for cell in cells.drop_nulls().head(1).to_list())


def stated_units(schema: Any) -> dict[str, str]:
    """Units in the metadata of an Arrow schema and of its fields; pandas writes its own metadata as JSON."""
    units = {}
    for key, text in _decoded(schema.metadata).items():
        with contextlib.suppress(ValueError):
            units |= _units_of(json.loads(text) if key == "PANDAS_ATTRS" else {key: json.loads(text)})
    for field in schema:
        units |= _units_of({key: {field.name: text} for key, text in _decoded(field.metadata).items()})
    return units


def _decoded(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {key.decode(errors="replace"): text.decode(errors="replace") for key, text in (metadata or {}).items()}


def _units_of(attributes: Mapping[Any, Any]) -> dict[str, str]:
    """The units of columns in the attributes of a table, by column."""
    named = [each for key, each in attributes.items() if _UNIT_KEY.fullmatch(str(key)) and isinstance(each, Mapping)]
    return {str(name): str(text).strip() for each in named for name, text in each.items() if str(text).strip()}


def _is_dataset(log: object) -> bool:
    """Whether a log is a dataset of xarray; this is tested only if xarray is imported already."""
    xarray = sys.modules.get("xarray")
    return xarray is not None and isinstance(log, xarray.Dataset)


def _with_index(log: Any) -> Any:
    """A data frame of pandas with its index as a column, if the index has a name, as a clock often does."""
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
    """The one-dimensional variables and coordinates along the dimension that most of them have."""
    lines = {str(key): variable for key, variable in log.variables.items() if len(variable.dims) == 1}
    along = [variable.dims[0] for variable in lines.values()]
    if not along:
        raise LogError(f"{name}: it has no variable along one dimension, such as time")
    # If counts are equal, `max` takes the first one in the order of the dataset.
    time = max(dict.fromkeys(along), key=along.count)
    columns = {key: variable for key, variable in lines.items() if variable.dims[0] == time}
    units = {
        name: text
        for key, variable in columns.items()
        for name, text in _units_of({attribute: {key: text} for attribute, text in variable.attrs.items()}).items()
    }

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        def arrow(key: str) -> Any:
            return _arrow(name, key, lambda: pyarrow().array(np.asarray(columns[key].values)))

        return pyarrow().table({key: arrow(key) for key in (*wanted, *beside)})

    return LogSource(list(columns), list(columns), load, units)


def _arrow(name: str, column: str, convert: Callable[[], Any]) -> Any:
    """A column converted to Arrow; raises `LogError` if its cells have different types."""
    pa = pyarrow()
    try:
        cells = convert()
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise LogError(f"{name}: column {column!r} is no column of numbers: {str(error).splitlines()[0]}") from error
    return plain_text(cells if isinstance(cells, pa.ChunkedArray) else pa.chunked_array([cells]))


def plain_text(cells: Any) -> Any:
    """A column of Arrow in which every type of text is converted to the plain one."""
    types = pyarrow().types
    if any(each(cells.type) for each in (types.is_dictionary, types.is_large_string, types.is_string_view)):
        return cells.cast(pyarrow().string())
    return cells


def find(log: str, wanted: Sequence[str], source: LogSource) -> None:
    """Check that each wanted column exists."""
    for name in wanted:
        if name in source.names:
            continue
        there = no_header(source) if source.first_line else f"There are: {', '.join(source.shown)}"
        raise LogError(f"{log}: no column {name!r}.{did_you_mean(name, source.names)} {there}")


def no_header(source: LogSource) -> str:
    """Remark that a text has no header."""
    return (
        f"Its first line, {source.first_line[:60]!r}, names no columns, so that they are called "
        f"{', '.join(source.names)}; use these names, or put a header above it"
    )


def unite(log: str, table: Any, refuse: bool = True) -> tuple[Any, list[str]]:
    """A table in which each name occurs once, and a remark for each name that occurred more often.

    Of equal columns the first one is kept. Different ones raise `LogError`, or are all left out.
    """
    remarks = []
    for name, count in Counter(table.column_names).items():
        if count == 1:
            continue
        places = [place for place, other in enumerate(table.column_names) if other == name]
        cells = [table.column(place).to_pylist() for place in places]
        row = next((k for k, row in enumerate(zip(*cells, strict=True)) if not _are_equal(row)), None)
        remark = f"{count} columns are named {name!r} and are equal, so that they count as one"
        if row is not None:
            values = " and ".join(repr(column[row]) for column in cells)
            remark = f"{count} columns are named {name!r} and differ, first in row {row + 1}: {values}"
            if refuse:
                raise LogError(f"{log}: {remark}; rename all but one")
            remark += "; they are left out, so rename all but one"
        remarks.append(remark)
        for place in reversed(places[row is None :]):
            table = table.remove_column(place)
    return table, remarks


def _are_equal(cells: Sequence[Any]) -> bool:
    """Whether cells have the same content; 0.5 equals 0.50, and a missing number differs from any other."""
    compared = []
    for cell in cells:
        plain = cell.strip() if isinstance(cell, str) else cell
        with contextlib.suppress(TypeError, ValueError):
            plain = float(plain)
        compared.append(None if plain == "" or plain != plain else plain)
    return all(other == compared[0] for other in compared)
