"""Reading of logs of every kind into records in SI units."""

import contextlib
import difflib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._bag import bag_columns, read_bag
from covariant.logs._cells import numbers
from covariant.logs._columns import ATTITUDES, Columns, Log, LogError, kind, pyarrow
from covariant.logs._configuration import bodies, from_cells
from covariant.logs._stamps import stamps, timed
from covariant.logs._text import is_number, read_text, sheet, with_points
from covariant.logs._units import unit_factor
from covariant.signals import Record

OPTIONAL = ("v", "truth")
"""Fields of `Columns` that are only compared with."""
MEASURED = ("q", "position", *ATTITUDES, "angle")
"""Fields of the measured configuration, in the order of `Columns.measured`."""


def read(
    path: str | PathLike[str],
    columns: Columns,
    every: int = 1,
    until: float | None = None,
    start: float | None = None,
    optional: Collection[str] = OPTIONAL,
) -> Log:
    """Read a log; an empty cell or `nan` is a missing measurement, and an error in t and u.

    - `path`: a `.csv`, `.txt` or `.tsv` file, whose delimiter and decimal mark are found, and whose comments, lines
      that begin with `#` or `%`, are left out; a `.parquet` file; a `.mcap` file or the folder of a rosbag2.
    - `columns`: names and units of the columns.
    - `every`: keeps each k-th row; `start`, `until` [s]: keep the rows from and to so long after the first one. The
      whole log must be valid even so.
    - `optional`: fields of `columns` that count as not named where the log has none of their columns.

    Rows are counted from 1, without header, comments and empty lines. Attitudes become rotation matrices: a quaternion
    or matrix that is off by less than 5 % is replaced by the nearest rotation. Dates, and times since 1970, count from
    the first of them, `Log.origin_ns`.

    Raises `LogError` naming the file, column and row of the first thing wrong; `FileNotFoundError` where there is no
    file; `ImportError` without pyarrow, or without rosbags for ROS messages.
    """
    path = Path(path)
    if not columns.measured:
        raise LogError(f"{path}: no position column was named; say which columns hold q")
    try:
        bodies(columns)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    if every < 1:
        raise LogError(f"{path}: every must be 1 or more rows; got {every}")
    columns, table = _table(path, columns, optional)

    def stack(*fields: str, needed: bool = False) -> np.ndarray:
        found = []
        for field in fields:
            for place, name in enumerate(getattr(columns, field)):
                given = columns.unit_of(field, place)
                values = numbers(_where(path, name, given), table.column(name), needed)
                found.append(values if given is None else values * unit_factor(given))
        return np.column_stack(found) if found else np.empty((len(table), 0))

    given = columns.unit_of("t", 0)
    t, origin = stamps(_where(path, columns.t, given), table.column(columns.t), given)
    u, y = stack("u", needed=True), from_cells(path, columns, stack(*MEASURED))
    v, truth = (stack(field) if getattr(columns, field) else None for field in OPTIONAL)
    _sound(path, t, u, y)
    since = t - t[0]
    low = 0 if start is None else int(np.searchsorted(since, start, side="left"))
    kept = slice(low, len(t) if until is None else int(np.searchsorted(since, until, side="right")), every)
    if len(t[kept]) < 2:
        asked = (("every", every), ("from", start), ("until", until))
        given = ", ".join(f"{name}={value:g}" for name, value in asked if value is not None)
        raise LogError(f"{path}: {given} keep {len(t[kept])} of {len(t)} rows, and two are needed")
    if np.isnan(y[kept][0]).any():
        row = low + 1
        raise LogError(f"{path}: row {row}, the first one kept, lacks a measurement; begin a little later or earlier")
    return Log(
        Record(t[kept], u[kept], y[kept]),
        None if v is None else v[kept],
        None if truth is None else truth[kept],
        origin,
    )


def survey(path: str | PathLike[str]) -> dict[str, Float[np.ndarray, "T"]]:
    """All columns of numbers of a log by their names, in its order; NaN where a cell is empty.

    Columns that hold anything else are left out, but dates are seconds since the first of them. Raises as `read` does
    for a file that is no log.
    """
    path = Path(path)
    with _legible(path):
        _, shown, load = _opened(path)
        alone = [name for name, count in Counter(shown).items() if name and count == 1]
        table = with_points(pyarrow(), path, load(alone, ()))
    found: dict[str, np.ndarray] = {}
    for name in alone:
        column = table.column(name)
        with contextlib.suppress(LogError):
            found[name] = stamps(name, column, None).t if timed(column) else numbers(name, column, needed=False)
    return found


def _where(path: Path, name: str, given: str | None) -> str:
    return f"{path}: column {name!r}" + (f" [{given}]" if given else "")


def _sound(path: Path, t: np.ndarray, u: np.ndarray, y: np.ndarray) -> None:
    """Apply `Record.check` before rows are dropped, so that rows are counted as in the file."""
    try:
        Record(t, u, y).check()
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error


class _Source(NamedTuple):
    """The names of the columns of a file, and `load(wanted, held)`: some of them as a table of Arrow.

    - `shown`: one name for each column; a log of messages knows longer ones as well.

    Of columns that are `held`, cells that are not logged with the others hold what was logged last.
    """

    names: Sequence[str]
    shown: Sequence[str]
    load: Callable[[Sequence[str], Sequence[str]], Any]


def _table(path: Path, columns: Columns, optional: Collection[str]) -> tuple[Columns, Any]:
    """The columns without those optional ones that the file does not have, and a table of them."""
    with _legible(path):
        names, shown, load = _opened(path)
        absent = [field for field in optional if not set(getattr(columns, field)) & set(names)]
        columns = columns._replace(**dict.fromkeys(absent, ()))
        wanted = list(dict.fromkeys((columns.t, *columns.measured, *columns.u, *columns.v, *columns.truth)))
        _find(path, wanted, names, shown)
        return columns, with_points(pyarrow(), path, load(wanted, columns.u))


@contextlib.contextmanager
def _legible(path: Path) -> Iterator[None]:
    pa = pyarrow()
    try:
        yield
    except LogError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file") from None
        what = "a rosbag" if kind(path) == "bag" else kind(path)
        raise LogError(f"{path}: cannot be read as {what}: {str(error).splitlines()[0]}") from error


def _opened(path: Path) -> _Source:
    ending = kind(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if ending == "bag":
        names = bag_columns(path)
        shown = [name for name, shortest in names.items() if shortest]
        return _Source(list(names), shown, lambda wanted, held: pyarrow().table(read_bag(path, wanted, held)))
    if ending == ".parquet":
        with pyarrow().parquet.ParquetFile(path) as file:
            names = list(file.schema_arrow.names)
            return _Source(names, names, lambda wanted, held: _parquet(path, wanted))
    found = sheet(path)
    return _Source(found.header, found.header, lambda wanted, held: read_text(pyarrow(), path, found, wanted))


def _parquet(path: Path, wanted: Sequence[str]) -> Any:
    with pyarrow().parquet.ParquetFile(path) as file:
        return file.read(columns=wanted)


def _find(path: Path, wanted: Sequence[str], found: Sequence[str], shown: Sequence[str]) -> None:
    """Check that each wanted column exists exactly once."""
    count = Counter(found)
    for name in wanted:
        if count[name] > 1:
            raise LogError(f"{path}: {count[name]} columns are named {name!r}; rename all but one")
        if not count[name] and all(map(is_number, found)):
            line = ", ".join(found)[:60]
            raise LogError(f"{path}: its first line, {line!r}, names no columns; put a header above it")
        if not count[name]:
            near = difflib.get_close_matches(name, found, 1)
            meant = f" Did you mean {near[0]!r}?" if near else ""
            raise LogError(f"{path}: no column {name!r}.{meant} There are: {', '.join(shown)}")
