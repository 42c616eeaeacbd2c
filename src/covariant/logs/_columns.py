"""The content of a log: names of its columns, the result of reading it, and the error for an unusable log."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.signals import Record


class LogError(ValueError):
    """A log that cannot be used. The message is one line: the file, column and row, what was found, and what to do."""


ATTITUDES = {"quaternion_wxyz": 4, "quaternion_xyzw": 4, "matrix": 9}
"""The representations of an attitude, by their field of `Columns`, and the number of columns each needs."""


class Columns(NamedTuple):
    """The names of the columns of a log in its file; an empty cell is a missing measurement.

    - `t`: time stamp [s].
    - `q`: measured positions, one name for each coordinate.
    - `u`: inputs; none for a system without inputs.
    - `v`: logged velocities, used only for comparison: no observer uses them.
    - `truth`: true velocities, where the log comes from a simulation.

    On a group the fields below give the measured configuration, in place of `q`, or before it where there are joints as
    well. One empty cell makes all of it missing in that row.

    - `position`: position of the body in the world [m]: three names, or two in the plane.
    - `quaternion_wxyz`, `quaternion_xyzw`: its attitude, R_world_body, as a unit quaternion, scalar first or last.
    - `matrix`: its attitude as the nine entries of R_world_body, row by row.
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
        """All columns of the measured configuration, in the order in which they are written."""
        return self.q + self.position + self.quaternion_wxyz + self.quaternion_xyzw + self.matrix + self.angle


class Log(NamedTuple):
    """A record, with the logged velocities `v` (T, n) and the true ones `truth` (T, n) for comparison, or None."""

    record: Record
    v: Float[np.ndarray, "T n"] | None = None
    truth: Float[np.ndarray, "T n"] | None = None


def kind(path: Path) -> str:
    """The type of a log file by its suffix, ".csv" or ".parquet"; raises `LogError` for any other."""
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise LogError(f"{path}: a log must be a .csv or .parquet file; this one ends in {suffix or 'nothing'}")
    return suffix


def pyarrow() -> Any:
    """The package pyarrow, which reads and writes files; raises `ImportError` with the command that installs it."""
    try:
        import pyarrow
        import pyarrow.compute
        import pyarrow.csv
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("reading and writing logs needs pyarrow: pip install 'covariant[logs]'") from error
    return pyarrow
