"""Splits columns of lists, as in data sets of robots, into a column for each entry, such as `observation.state[0]`."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from covariant._door import STORE
from covariant.logs._columns import pyarrow
from covariant.logs._tables import LogSource
from scalargraph.files import bounded, read_bytes

MOST_ENTRIES = 256
"""Largest length of a list whose entries become columns; longer lists are pictures and scans."""
_INFO = ("../meta/info.json", "../../meta/info.json")
"""Paths, from the folder of a file, at which a LeRobot data set describes its columns."""


def is_list(cell: Any) -> bool:
    """Whether a type of Arrow is one of lists."""
    types = pyarrow().types
    return types.is_list(cell) or types.is_fixed_size_list(cell) or types.is_large_list(cell)


def _list_length(column: Any) -> int:
    """Length of the lists in a column of lists of numbers; 0 for other columns, and if lengths differ."""
    types, cell = pyarrow().types, column.type
    if not is_list(cell):
        return 0
    number = cell.value_type
    if not (types.is_floating(number) or types.is_integer(number) or types.is_decimal(number)):
        return 0
    if types.is_fixed_size_list(cell):
        return cell.list_size if cell.list_size <= MOST_ENTRIES else 0
    lengths = pyarrow().compute.unique(pyarrow().compute.list_value_length(column).drop_null()).to_pylist()
    return lengths[0] if len(lengths) == 1 and lengths[0] <= MOST_ENTRIES else 0


def by_entries(source: LogSource, path: Path | None = None) -> LogSource:
    """A source in which each column of lists is replaced by one column for each entry; `path` is the file's path."""
    if not source.lists:
        return source
    lengths = {name: _list_length(source.load([name], (), ()).column(name)) for name in source.lists}
    entries = {f"{name}[{k}]": (name, k) for name, length in lengths.items() for k in range(length)}
    # An existing column with exactly this name takes precedence.
    entries = {name: place for name, place in entries.items() if name not in source.names}
    written = {name: [entry for entry, (column, _) in entries.items() if column == name] for name in lengths}

    def expand(names: Sequence[str]) -> list[str]:
        return [entry for name in names for entry in (written[name] if lengths.get(name) else [name])]

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        asked = [*wanted, *beside]
        of_file = [list(dict.fromkeys(entries[n][0] if n in entries else n for n in part)) for part in (wanted, beside)]
        table = source.load(of_file[0], held, [name for name in of_file[1] if name not in of_file[0]])
        columns, names = [], []
        for name, column in zip(table.column_names, table.columns, strict=True):
            for entry in [each for each in dict.fromkeys(asked) if entries.get(each, (each, 0))[0] == name]:
                listed = entry in entries
                columns.append(pyarrow().compute.list_element(column, entries[entry][1]) if listed else column)
                names.append(entry)
        return pyarrow().table(columns, names=names)

    units = {name: text for name, text in source.units.items() if name not in entries}
    units |= {entry: source.units[column] for entry, (column, _) in entries.items() if column in source.units}
    labels = {} if path is None else _labels(path, lengths)
    names, shown = expand(source.names), expand(source.shown)
    return source._replace(names=names, shown=shown, load=load, units=units, labels=labels)


def _labels(path: Path, lengths: Mapping[str, int]) -> dict[str, str]:
    """Names that a data set gives to the entries of its columns, by `observation.state[0]`; empty if it gives none."""
    for place in _INFO:
        # If the file beside the log is something else, or broken, the log is still valid.
        with contextlib.suppress(ValueError, AttributeError, KeyError, TypeError), bounded(place):
            features = json.loads(read_bytes(path.parent / place, STORE))["features"]
            return {
                f"{name}[{k}]": text
                for name, length in lengths.items()
                for k, text in enumerate(_flat(features.get(name, {}).get("names"), length))
            }
    return {}


def _flat(names: Sequence | None, length: int) -> list[str]:
    """Names of the entries, from a list or a table that contains one; none if their number differs from `length`."""
    if isinstance(names, Mapping) and len(names) == 1:
        (names,) = names.values()
    return [str(name) for name in names] if isinstance(names, list) and len(names) == length else []
