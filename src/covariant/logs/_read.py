"""Reading of logs. Cells are read as text first, so that an invalid one can be quoted with its column and row."""

import contextlib
import csv
import difflib
from collections import Counter
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant._numbers import NUMBER
from covariant.logs._columns import Columns, Log, LogError, kind, pyarrow
from covariant.logs._configuration import bodies, from_cells
from covariant.signals import Record


def read(path: str | PathLike[str], columns: Columns, every: int = 1, until: float | None = None) -> Log:
    """Read a `.csv` or `.parquet` log; an empty cell or `nan` is a missing measurement, and an error in t and u.

    - `columns`: names of the columns.
    - `every`: keeps each k-th row; `until` [s]: keeps the rows with t ≤ until. The whole log must be valid even so.

    Rows are counted from 1, without the header and blank lines. Attitudes become rotation matrices: a quaternion or
    matrix that is off by less than 5 % is replaced by the nearest rotation.

    Raises `LogError` naming the file, column and row of the first thing wrong; `FileNotFoundError` where there is no
    file; `ImportError` without pyarrow.
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
    table = _table(path, list(dict.fromkeys((columns.t, *columns.measured, *columns.u, *columns.v, *columns.truth))))

    def stack(names: Sequence[str], needed: bool = False) -> np.ndarray:
        arrays = [_numbers(f"{path}: column {name!r}", table.column(name), needed) for name in names]
        return np.column_stack(arrays) if arrays else np.empty((len(table), 0))

    t = stack([columns.t], needed=True)[:, 0]
    u, y = stack(columns.u, needed=True), from_cells(path, columns, stack(columns.measured))
    v, truth = (stack(names) if names else None for names in (columns.v, columns.truth))
    _sound(path, t, u, y)
    kept = slice(0, len(t) if until is None else int(np.searchsorted(t, until, side="right")), every)
    if len(t[kept]) < 2:
        raise LogError(
            f"{path}: every={every} and until={until} keep {len(t[kept])} of {len(t)} rows, and two are needed"
        )
    return Log(
        Record(t[kept], u[kept], y[kept]),
        None if v is None else v[kept],
        None if truth is None else truth[kept],
    )


def survey(path: str | PathLike[str]) -> dict[str, Float[np.ndarray, "T"]]:
    """All columns of numbers of a `.csv` or `.parquet` log by their names, in its order; NaN where a cell is empty.

    Columns that hold anything else are left out. Raises as `read` does for a file that is no log.
    """
    path = Path(path)
    kind(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    table = _table(path, _header(path))
    found: dict[str, np.ndarray] = {}
    for name in table.column_names:
        with contextlib.suppress(LogError):
            found[name] = _numbers(name, table.column(name), needed=False)
    return found


def _header(path: Path) -> list[str]:
    """The names of all columns of a file."""
    if kind(path) == ".csv":
        with path.open(newline="", encoding="utf-8-sig") as file:
            return [name.strip() for name in next(csv.reader(file), [])]
    pa = pyarrow()
    try:
        with pa.parquet.ParquetFile(path) as file:
            return list(file.schema_arrow.names)
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path}: cannot be read as .parquet: {str(error).splitlines()[0]}") from error


def _sound(path: Path, t: np.ndarray, u: np.ndarray, y: np.ndarray) -> None:
    """Apply `Record.check` before rows are dropped, so that rows are counted as in the file."""
    try:
        Record(t, u, y).check()
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error


def _table(path: Path, wanted: list[str]) -> Any:
    reader = {".csv": _read_csv, ".parquet": _read_parquet}[kind(path)]
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    pa = pyarrow()
    try:
        return reader(pa, path, wanted)
    except LogError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as {kind(path)}: {str(error).splitlines()[0]}") from error


def _read_parquet(pa: Any, path: Path, wanted: list[str]) -> Any:
    with pa.parquet.ParquetFile(path) as file:
        _find(path, wanted, file.schema_arrow.names)
        return file.read(columns=wanted)


def _read_csv(pa: Any, path: Path, wanted: list[str]) -> Any:
    with path.open(newline="", encoding="utf-8-sig") as file:
        header = [name.strip() for name in next(csv.reader(file), [])]
        rows = any(line.strip() for line in file)
    if not any(header):
        raise LogError(f"{path}: the file is empty; its first line must name the columns")
    _find(path, wanted, header)
    if not rows:
        raise LogError(f"{path}: the file has a header and no rows")

    ragged = []
    table = pa.csv.read_csv(
        path,
        read_options=pa.csv.ReadOptions(use_threads=False, column_names=header, skip_rows=1),
        parse_options=pa.csv.ParseOptions(invalid_row_handler=lambda row: ragged.append(row) or "skip"),
        convert_options=pa.csv.ConvertOptions(
            include_columns=wanted,
            column_types=dict.fromkeys(wanted, pa.string()),
            null_values=[""],
            strings_can_be_null=True,
        ),
    )
    if ragged:
        row = ragged[0]  # its number includes the header
        raise LogError(
            f"{path}: row {row.number - 1} has {row.actual_columns} cells where the header has {row.expected_columns}: "
            f"{row.text[:60]!r}; a missing measurement is an empty cell between its commas"
        )
    return table


def _find(path: Path, wanted: Sequence[str], found: Sequence[str]) -> None:
    """Check that each wanted column exists exactly once."""
    count = Counter(found)
    for name in wanted:
        if count[name] > 1:
            raise LogError(f"{path}: {count[name]} columns are named {name!r}; rename all but one")
        if not count[name]:
            near = difflib.get_close_matches(name, found, 1)
            meant = f" Did you mean {near[0]!r}?" if near else ""
            raise LogError(f"{path}: no column {name!r}.{meant} There are: {', '.join(found)}")


def _numbers(where: str, column: Any, needed: bool) -> Float[np.ndarray, "T"]:
    """A column as float64, NaN where a cell is empty; `needed` makes an empty cell an error."""
    pa = pyarrow()
    try:
        values = column.cast(pa.float64(), safe=False).to_numpy()
    except pa.ArrowInvalid:
        values = _texts(where, column, needed)
    except pa.ArrowNotImplementedError as error:
        raise LogError(f"{where} holds {column.type}; convert it to plain numbers (time in seconds)") from error
    bad = ~np.isfinite(values) if needed else np.isinf(values)
    if bad.any():
        raise _fault(where, int(bad.argmax()), column[int(bad.argmax())].as_py(), needed)
    return values


def _texts(where: str, column: Any, needed: bool) -> np.ndarray:
    """Slower conversion, for a column with a cell that may have a plus sign or spaces, or is no number."""
    pa = pyarrow()
    compute = pa.compute
    cells = compute.utf8_trim_whitespace(compute.fill_null(column.cast(pa.string()), ""))
    written = compute.match_substring_regex(cells, rf"^({NUMBER})?\z").to_numpy()
    if not written.all():
        row = int((~written).argmax())
        raise _fault(where, row, column[row].as_py(), needed)
    plain = compute.replace_substring_regex(cells, r"^\+", "")
    filled = compute.if_else(compute.equal(plain, ""), "nan", plain)
    return filled.cast(pa.float64()).to_numpy()


def _fault(where: str, row: int, cell: str | float | None, needed: bool) -> LogError:
    found = "an empty cell" if cell is None or not str(cell).strip() else repr(cell)
    remedy = "only positions may be missing; fill it or cut the row" if needed else "leave it empty if it is missing"
    return LogError(f"{where}, row {row + 1}: found {found}, needs a finite number; {remedy}")
