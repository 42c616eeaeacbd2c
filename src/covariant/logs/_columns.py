"""What a log holds: the names of its columns, what reading it gives, and the error that says why it cannot be used."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.signals import Record


class LogError(ValueError):
    """A log that cannot be used. One line: which file, column and row, what was found there, and what to do."""


ATTITUDES = {"quaternion_wxyz": 4, "quaternion_xyzw": 4, "matrix": 9}
"""The ways to write an attitude, by their field of `Columns`, and how many columns each takes."""


class Columns(NamedTuple):
    """The names that the columns of a log have in its file; an empty cell is a missing measurement.

    - `t`: time stamp [s].
    - `q`: measured positions, one name a coordinate.
    - `u`: inputs; none for a machine that moves on its own.
    - `v`: logged velocities, only ever compared with: an observer never sees them.
    - `truth`: true velocities, where the log comes from a simulation.

    On a group the measured configuration stands in place of `q`, or before it where there are joints besides; one empty
    cell makes all of it missing in that row:

    - `position`: where the body is, in the world [m]: three names, or two in the plane.
    - `quaternion_wxyz`, `quaternion_xyzw`: its attitude, R_world_body, as a unit quaternion, scalar first or last.
    - `matrix`: or as the nine entries of R_world_body, row by row.
    - `angle`: angles [rad]: the heading of a body in the plane, and of each wheel.
    """

    t: str = "t"
    q: tuple[str, ...] = ()
    u: tuple[str, ...] = ()
    v: tuple[str, ...] = ()
    truth: tuple[str, ...] = ()
    position: tuple[str, ...] = ()
    quaternion_wxyz: tuple[str, ...] = ()
    quaternion_xyzw: tuple[str, ...] = ()
    matrix: tuple[str, ...] = ()
    angle: tuple[str, ...] = ()

    @property
    def measured(self) -> tuple[str, ...]:
        """All columns that hold the measured configuration, in the order they are written in."""
        return self.q + self.position + self.quaternion_wxyz + self.quaternion_xyzw + self.matrix + self.angle


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
        import pyarrow.compute
        import pyarrow.csv
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("reading and writing logs needs pyarrow: pip install 'covariant[logs]'") from error
    return pyarrow
