"""What may be written where, checked before anything is computed. Loads nothing heavy."""

import csv
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from covariant import logs
from covariant._door import BINARY_LOG
from covariant._optional import load_optional
from scalargraph.errors import InputError
from scalargraph.files import check_file, utf8, write_atomically

FIGURES = (".png", ".pdf", ".svg")
"""Suffixes of figures."""
TABLES = (".csv", ".txt", ".tsv", ".parquet")
"""Suffixes of tables that are no log."""
FORMULAS = tuple("=+-@＝＋－＠")
"""What a cell begins with that a spreadsheet computes."""


def check_output(
    path: Path | None, *suffixes: str, log: object = None, store: bool = False, overwrite: bool = True
) -> None:
    """Check that an output file has the right suffix and a folder, and does not replace the log.

    Args:
        path: The file to write; None, for no file, passes.
        suffixes: The endings that are allowed.
        log: The log that is read; a path is never overwritten by the output.
        store: Whether `path` is a store, a folder to which a later run adds.
        overwrite: Whether a file that exists may be replaced.

    Raises:
        ValueError: One line that names the path and what is wrong.

    Example:
        >>> from pathlib import Path
        >>> from covariant import verbs
        >>> verbs.check_output(Path("ranking.csv"), ".csv")
        >>> verbs.check_output(Path("ranking.txt"), ".csv")
        Traceback (most recent call last):
            ...
        scalargraph.errors.InputError: ranking.txt: the file to write must end in .csv
    """
    if path is None:
        return
    if path.suffix not in suffixes:
        raise InputError(f"{path}: the file to write must end in {' or '.join(suffixes)}")
    if path.is_dir() and not store:
        raise InputError(f"{path}: there is a folder of this name, and it is not replaced; give another name")
    if store and path.exists() and not (path / "zarr.json").is_file():
        raise InputError(f"{path}: this is no store to go on with, and it is not replaced; give another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    # `samefile` and not equality: a link or another spelling of the path is the log too.
    of_log = logs.part_of(log)[0] if isinstance(log, str | Path) else None
    if of_log is not None and path.exists() and of_log.exists() and path.samefile(of_log):
        raise InputError(f"{path}: this is the log itself; write to another file")
    if path.exists() and not (overwrite or store):
        raise InputError(f"{path}: there is such a file already; write to another file, or say `overwrite=True`")


def has_columns(path: Path, names: Iterable[str]) -> bool:
    """Whether a file is a table of exactly these columns, as an earlier run of the same command wrote it."""
    return (columns := columns_of(path)) is not None and columns == list(names)


def columns_of(path: Path) -> list[str] | None:
    """Names of the columns of a table, read without its rows.

    Messages of ROS are never taken for a table, since those of a robot have the same names.

    Args:
        path: The file.

    Returns:
        The names in order; None where the file is no table, or cannot be read.

    Example:
        >>> from pathlib import Path
        >>> from covariant import verbs
        >>> _ = Path("table.csv").write_text("t,v1\\n0,1\\n")
        >>> verbs.columns_of(Path("table.csv"))
        ['t', 'v1']
    """
    try:
        check_file(path, BINARY_LOG)  # a pipe may never end
        if path.suffix == ".parquet":
            return load_optional("pyarrow.parquet", use="reading Parquet needs", extra="logs").read_schema(path).names
        if path.suffix in (".csv", ".txt", ".tsv"):
            with path.open(encoding="utf-8", newline="") as file:
                return next(csv.reader(file, delimiter="\t" if path.suffix == ".tsv" else ","), [])
    except (OSError, ValueError, csv.Error):
        pass
    return None


def write_table(path: Path, columns: Mapping[str, Any]) -> Path:
    """Write columns as a table of text, whole or not at all; a number that is not known (NaN) is left empty.

    A text that a spreadsheet would compute, such as the name "=1+1.csv", gets an apostrophe, by which it stays a text.
    """

    def cell(value: object) -> Any:
        if isinstance(value, str):
            return f"'{value}" if value.lstrip()[:1] in FORMULAS else value
        return "" if isinstance(value, float) and math.isnan(value) else value

    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(columns)
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        rows.writerow(map(cell, row))
    return write_atomically(path, lambda file: file.write(utf8(text.getvalue())))
