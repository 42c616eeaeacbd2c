"""The content of a log: names of its columns, the result of reading it, and the error for an unusable log."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
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

    - `t`: time stamp [s], or dates.
    - `q`: measured positions, one name for each coordinate.
    - `u`: inputs; none for a system without inputs.
    - `v`: logged velocities, used only for comparison: no observer uses them.
    - `truth`: true velocities, where the log comes from a simulation; of a state-space model, the true state.
    - `units`: for a field, as "q", the unit in which its columns are logged, or one for each of them: `("deg",)`,
      `("deg", "mm")`; otherwise they are logged in SI units and radians. See
      `unit_factor`.

    On a group the fields below give the measured configuration, in place of `q`, or before it where there are joints as
    well. One empty cell makes all of it missing in that row. Attitudes after the first, such as the other four names of
    eight in `quaternion_wxyz`, are those of ball joints; each is missing by itself.

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
    units: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    def unit_of(self, field: str, place: int) -> str | None:
        """The unit of the column at a place in a field; None where it is logged in SI units."""
        given = self.units.get(field, ())
        return given[place if len(given) > 1 else 0] if given else None

    @property
    def measured(self) -> tuple[str, ...]:
        """All columns of the measured configuration, in the order in which they are written."""
        return self.q + self.position + self.quaternion_wxyz + self.quaternion_xyzw + self.matrix + self.angle


class Log(NamedTuple):
    """A record in SI units, with the logged velocities `v` (T, n) and the true ones `truth` (T, n), or None.

    `origin_ns`: the time [ns since 1970] that its stamps count from, where the log has dates or times since 1970;
    otherwise None, and the stamps are as in the file.
    `first_row`, `every`: which rows of the file are kept: that one, counted from 1, and each so-many-th after it.
    """

    record: Record
    v: Float[np.ndarray, "T n"] | None = None
    truth: Float[np.ndarray, "T n"] | None = None
    origin_ns: int | None = None
    first_row: int = 1
    every: int = 1

    def __repr__(self) -> str:
        beside = ["velocities"] * (self.v is not None) + ["true velocities"] * (self.truth is not None)
        since = "" if self.origin_ns is None else f" since {np.datetime64(self.origin_ns, 'ns')}Z"
        return f"<Log: {repr(self.record)[9:-1]}{since}{', with ' + ' and '.join(beside) if beside else ''}>"


TEXTS = (".csv", ".txt", ".tsv")
"""Endings of logs as text."""
BAGS = (".mcap", ".db3", ".bag")
"""Endings of logs of ROS messages."""


def kind(path: Path) -> str:
    """The type of a log by its ending, or "bag" for a folder or a file of ROS messages; raises `LogError` otherwise."""
    suffix = path.suffix.lower()
    if suffix in BAGS or (path / "metadata.yaml").is_file():
        return "bag"
    if suffix not in (*TEXTS, ".parquet"):
        raise LogError(
            f"{path}: a log must be a .csv, .txt, .tsv, .parquet or .mcap file, or the folder of a rosbag2; this one "
            f"ends in {suffix or 'nothing'}"
        )
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
