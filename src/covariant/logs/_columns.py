"""What a log holds: the names of its columns, what reading it gives, and the error that says why it cannot be used."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.signals import Record


class LogError(ValueError):
    """A log that cannot be used. One line: which file, column and row, what was found there, and what to do."""


class Columns(NamedTuple):
    """The names that the columns of a log have in its file.

    - `t`: time stamp [s].
    - `q`: measured positions, one name a coordinate; an empty cell is a missing measurement.
    - `u`: inputs; none for a machine that moves on its own.
    - `v`: logged velocities, only ever compared with: an observer never sees them.
    - `truth`: true velocities, where the log comes from a simulation.
    """

    t: str = "t"
    q: tuple[str, ...] = ()
    u: tuple[str, ...] = ()
    v: tuple[str, ...] = ()
    truth: tuple[str, ...] = ()


class Log(NamedTuple):
    """A record, with the logged velocities `v` (T, n) and the true ones `truth` (T, n) to compare with, or None."""

    record: Record
    v: Float[np.ndarray, "T n"] | None = None
    truth: Float[np.ndarray, "T n"] | None = None


def kind(path: Path) -> str:
    """The kind of file a log is, ".csv" or ".parquet", told by its ending; raises `LogError` for any other."""
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise LogError(f"{path}: a log must be a .csv or .parquet file; this one ends in {suffix or 'nothing'}")
    return suffix


def pyarrow() -> Any:
    """The guest that reads and writes files; raises `ImportError` with the line that installs it."""
    try:
        import pyarrow
        import pyarrow.csv
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("reading and writing logs needs pyarrow: pip install 'covariant[logs]'") from error
    return pyarrow
