"""Reads columns of Parquet files, of all rows or of one episode of a data set."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from covariant.logs._columns import LogError, pyarrow
from covariant.logs._episodes import episode_columns
from covariant.logs._tables import LogSource, plain_text


def read_parquet(path: Path, wanted: Sequence[str], episode: tuple[str, int] | None = None) -> Any:
    """Columns of a file, or those rows of them in which a column has the number of an episode."""
    if episode is None:
        with open_parquet(path) as file:
            table = file.read(columns=wanted)
    else:
        column, number = episode
        changed = path.stat().st_mtime_ns
        least, most = _row_groups(path, changed, column)
        groups = tuple(np.flatnonzero((least <= number) & (number <= most)).tolist())
        table = pyarrow().table({name: _of_groups(path, changed, groups, name) for name in (*wanted, column)})
        table = _rows_of(path, table, column, number).select(wanted)
    return pyarrow().table([plain_text(column) for column in table.columns], names=table.column_names)


def open_parquet(path: Path) -> Any:
    """Open a file; its footer is read once, since one with a group of rows for each episode is long."""
    return pyarrow().parquet.ParquetFile(path, metadata=_footer(path, path.stat().st_mtime_ns))


@functools.lru_cache(maxsize=2)
def _footer(path: Path, changed: int) -> Any:
    return pyarrow().parquet.read_metadata(path)


def of_episode(path: Path, source: LogSource, number: int) -> LogSource:
    """The source of one episode of a text."""
    column = episode_column(path, source.names)

    def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
        names = list(dict.fromkeys((*wanted, *beside)))
        table = source.load(list(dict.fromkeys((*names, column))), held, ())
        numbers = pyarrow().compute.cast(table.column(column), pyarrow().float64())
        return _rows_of(path, table.append_column("", numbers), "", number).select(names)

    return source._replace(load=load)


def episode_column(path: Path, names: Sequence[str]) -> str:
    """The column with the number of the episode."""
    columns = episode_columns(names)
    if not columns:
        raise LogError(
            f"{path}: no column has the number of an episode, as episode_index; there are {', '.join(names)}"
        )
    return columns[0]


def _rows_of(path: Path, table: Any, column: str, number: int) -> Any:
    rows = np.flatnonzero(np.asarray(pyarrow().compute.equal(table.column(column), number)))
    if not len(rows):
        raise LogError(f"{path}: there is no episode {number}")
    # A slice copies nothing, however many other episodes lie in the same group.
    return table.slice(rows[0], len(rows)) if len(rows) == rows[-1] - rows[0] + 1 else table.take(rows)


@functools.lru_cache(maxsize=2)
def _row_groups(path: Path, changed: int, column: str) -> tuple[np.ndarray, np.ndarray]:
    """The least and largest number of an episode in each group of the rows of a file."""
    metadata = _footer(path, changed)
    paths = [metadata.schema.column(k).path for k in range(len(metadata.schema))]
    ends = [metadata.row_group(k).column(paths.index(column)).statistics for k in range(metadata.num_row_groups)]
    # A group without statistics may have any episode.
    known = [(each.min, each.max) if each is not None and each.has_min_max else (-np.inf, np.inf) for each in ends]
    least, most = np.array(known, float).reshape(-1, 2).T
    return least, most


@functools.lru_cache(maxsize=16)
def _of_groups(path: Path, changed: int, groups: tuple[int, ...], name: str) -> Any:
    """A column in some groups of rows; kept, since the next episode often lies in the same group."""
    with open_parquet(path) as file:
        return file.read_row_groups(groups, columns=[name]).column(name)
