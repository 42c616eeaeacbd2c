"""Defines the content of a log: names of its columns, the result of reading it, and the error for an unusable log."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._door import BINARY_LOG, MOST_ROWS, STORE, TEXT_LOG
from covariant.logs._units import unit_factor
from covariant.signals import Record
from scalargraph.errors import InputError, MissingPackageError
from scalargraph.files import check_file


class LogError(InputError):
    """A log that cannot be used. The message is one line: the file, column and row, the fault, and the remedy.

    It is a `ValueError`. Values that are wrong but readable, such as degrees for radians, do not raise it: `check`
    finds them.

    Example:
        >>> import numpy as np
        >>> from covariant import logs, signals
        >>> log = signals.Record(np.array([0.0, 0.1]), y=np.zeros((2, 1)))
        >>> try:
        ...     logs.read(log, logs.Columns(q=("a", "b")))
        ... except logs.LogError as error:
        ...     print(error)
        record: it has positions of shape (1,), needs 2 of them
    """


class ClockError(LogError):
    """Error for stamps that repeat or decrease. The message names the first such stamp.

    Attributes:
        record: The log as it is, in SI units and radians.

    Example:
        >>> from covariant import Record, logs
        >>> log = Record([0.0, 0.1, 0.1], y=[[0.0], [0.1], [0.2]])
        >>> try:
        ...     logs.read(log, logs.Columns(q=("q1",)))
        ... except logs.ClockError as error:
        ...     print(len(error.record.t))
        3
    """

    record: Record

    def __init__(self, message: str, record: Record):
        super().__init__(message)
        self.record = record


ATTITUDES = {"quaternion_wxyz": 4, "quaternion_xyzw": 4, "matrix": 9}
"""Representations of an attitude, named as the fields of `Columns`, and the number of columns that each needs."""


class Columns(NamedTuple):
    """Names of the columns of a log in its file; an empty cell is a missing measurement.

    On a group, `position`, one attitude or `angle` describe the measured configuration, in place of `q`; if there are
    joints as well, they come before `q`. One empty cell makes all of the configuration of a body missing in that row.
    Further attitudes, such as the last four of eight names in `quaternion_wxyz`, belong to ball joints; each can be
    missing on its own.

    Attributes:
        t: Time stamp [s], or dates.
        q: Measured positions, one name for each coordinate.
        u: Inputs; none for a system without inputs.
        v: Logged velocities, used only for comparison: no observer uses them.
        truth: True velocities, if the log comes from a simulation; for a state-space model, the true state.
        position: Position of the body in the world [m]: three names, or two in the plane.
        quaternion_wxyz, quaternion_xyzw: Its attitude, R_world_body, as a unit quaternion, scalar first or last.
        matrix: Its attitude as the nine entries of R_world_body, row by row.
        angle: Angles [rad]: the heading of a body in the plane, and of each wheel.
        units: Unit of the columns of a field, such as "q", or a tuple with one unit for each column: `("deg",)`,
            `("deg", "mm")`. Other columns are in SI units and radians. See `unit_factor`.

    Example:
        >>> from covariant import logs
        >>> columns = logs.Columns(t="time", q=("arm", "slide"), units={"t": ("ms",), "q": ("deg", "mm")})
        >>> columns.measured, columns.unit_of("q", 1)
        (('arm', 'slide'), 'mm')
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
        """Unit of a column.

        Args:
            field: Name of a field, as "q".
            place: Index of the column in the field, from 0.

        Returns:
            Its unit; None if it is logged in SI units.
        """
        names = self.units.get(field, ())
        return names[place if len(names) > 1 else 0] if names else None

    def units_of(self, names: Iterable[str]) -> dict[str, str]:
        """Units of quantities that are called as columns of the log are, as those of `as_logged`.

        Args:
            names: Names of the quantities, some with the suffixes `_std` and `_filtered`.

        Returns:
            The unit in which the log has the column, by name; other quantities are left out.
        """
        usual = {"position": "m", "angle": "rad"}
        fields = ((field, getattr(self, field)) for field in {**usual, **self.units} if field != "t")
        known = {
            name: self.unit_of(field, place) or usual[field] for field, own in fields for place, name in enumerate(own)
        }
        plain = {name: re.sub(r"(_filtered)?(_std)?$", "", name) for name in names}
        return {name: known[each] for name, each in plain.items() if each in known}

    def as_logged(self, table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Convert estimates to the units of the log, if they are called as its columns are.

        Args:
            table: Arrays (T,) by name, in SI units and radians.

        Returns:
            The same arrays, those of `units_of` in these units.

        Example:
            >>> import numpy as np
            >>> from covariant import logs
            >>> columns = logs.Columns(angle=("heading",), units={"angle": ("deg",)})
            >>> columns.as_logged({"heading": np.array([np.pi]), "yaw_rate": np.ones(1)})["heading"].tolist()
            [180.0]
        """
        units = self.units_of(table)
        return {name: array / unit_factor(units[name]) if name in units else array for name, array in table.items()}

    @property
    def measured(self) -> tuple[str, ...]:
        """All columns of the measured configuration, in the order in which they are written."""
        return self.q + self.position + self.quaternion_wxyz + self.quaternion_xyzw + self.matrix + self.angle


class Log(NamedTuple):
    """The content of a log, in SI units and radians.

    Attributes:
        record: Stamps, inputs and measured configurations.
        v: Logged velocities (T, n), or None.
        truth: True velocities (T, n), or None.
        origin_ns: Time [ns since 1970] at which the stamps are zero, if the log has dates or times since 1970;
            otherwise None, and the stamps are as in the file.
        first_row: Number of the file's row, counted from 1, that is the first of the record.
        every: Distance in rows of the file between rows of the record.
        whole: All rows of the log, if `record` has only some of them; otherwise None. Inputs before and between the
            rows of `record` act in them, see `signals.acting_inputs`.
        readings: For each sensor in `sensors`, its readings in these rows, NaN if there is none: numbers (T, k) of `q`
            or, for a pose, the position (3,) and the rotation (3, 3), row by row, (T, 12). None if the log has no
            column of the sensor, as in a `Record`.

    Example:
        >>> import numpy as np
        >>> from covariant import logs, signals
        >>> logs.Log(signals.Record(np.array([0.0, 0.1]), y=np.zeros((2, 1))), v=np.zeros((2, 1)))
        <Log: 2 rows over 0.1 s, 1 position, no input, with velocities>
    """

    record: Record
    v: Float[np.ndarray, "T n"] | None = None
    truth: Float[np.ndarray, "T n"] | None = None
    origin_ns: int | None = None
    first_row: int = 1
    every: int = 1
    readings: tuple[Float[np.ndarray, "T k"] | None, ...] = ()
    whole: Record | None = None

    @property
    def all_rows(self) -> Record:
        """All rows of the log."""
        return self.record if self.whole is None else self.whole

    def __repr__(self) -> str:
        beside = ["velocities"] * (self.v is not None) + ["true velocities"] * (self.truth is not None)
        since = "" if self.origin_ns is None else f" since {np.datetime64(self.origin_ns, 'ns')}Z"
        return f"<Log: {repr(self.record)[9:-1]}{since}{', with ' + ' and '.join(beside) if beside else ''}>"


TEXTS = (".csv", ".txt", ".tsv")
"""Suffixes of logs as text."""
BAGS = (".mcap", ".db3", ".bag")
"""Suffixes of logs of ROS messages."""


def kind(path: Path) -> str:
    """Type of a log, from the suffix of its name."""
    suffix = path.suffix.lower()
    if suffix in BAGS or (path / "metadata.yaml").is_file():
        return "bag"
    if suffix not in (*TEXTS, ".parquet"):
        raise LogError(
            f"{path}: a log must be a .csv, .txt, .tsv, .parquet or .mcap file, or the folder of a rosbag2; this one "
            f"ends in {suffix or 'nothing'}"
        )
    return suffix


def check_log(path: Path, rows: int = 0) -> None:
    """Refuse a log with too many rows, or a file that is not regular, such as a pipe, which might never end."""
    for part in path.iterdir() if path.is_dir() else [path]:
        if not part.is_dir():
            check_file(part, STORE if part.suffix == ".yaml" else TEXT_LOG if part.suffix in TEXTS else BINARY_LOG)
    if rows > MOST_ROWS:
        raise LogError(f"{path}: it has {rows} rows, more than {MOST_ROWS}; cut it into several logs")


def pyarrow() -> Any:
    """The package pyarrow, imported with the modules that read and write files."""
    try:
        import pyarrow
        import pyarrow.compute
        import pyarrow.csv
        import pyarrow.parquet
    except ImportError as error:
        raise MissingPackageError("reading and writing logs needs pyarrow: pip install 'covariant[logs]'") from error
    return pyarrow


def numeric_columns(schema: Any) -> list[str]:
    """Names of the columns of whole or floating numbers."""
    types = pyarrow().types
    return [each.name for each in schema if types.is_integer(each.type) or types.is_floating(each.type)]
