"""Readings of sensors beside the measured configuration, in the rows of a log."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant.logs._cells import numbers
from covariant.logs._columns import ATTITUDES, Columns, Log, LogError, kind
from covariant.logs._configuration import bodies, from_cells
from covariant.logs._read import columns_and_table, where
from covariant.logs._tables import source_name
from covariant.logs._unit_in_name import unit_in_name, unknown_unit
from covariant.logs._units import unit_factor
from covariant.signals import Record

NEAR = 1
"""Difference [ns] of stamps that are the same: those of a log are seconds in double precision."""


def readings(
    log: str | PathLike[str] | Record | Any, columns: Columns, of: Log, meant: Sequence[str] = ()
) -> Float[np.ndarray, "T k"] | None:
    """Read what a sensor measured, in the rows of a log that was read before.

    Args:
        log: What `read` took.
        columns: Columns of the sensor: `q`, or a position and an attitude, their units, and the stamps of the log.
        of: What `read` returned, whose rows are taken.
        meant: SI unit of the numbers: a column whose name ends in another unit of that kind is refused, unless `units`
            of the columns state one.

    Returns:
        Readings in SI units and radians, NaN where a cell is empty: the numbers (T, k) of `q`, or of a pose the
        position (3,) and the rotation (3, 3), row by row, (T, 12). None where the log has none of the columns, as a
        `Record` has not.

    Raises:
        LogError: A column is missing, or holds no numbers; as for `read`.

    Example:
        >>> import pandas
        >>> from covariant import logs
        >>> frame = pandas.DataFrame({"t": [0.0, 0.1], "q1": [0.0, 0.3], "rate": [None, 180.0]})
        >>> log = logs.read(frame, logs.Columns(q=("q1",)))
        >>> logs.readings(frame, logs.Columns(q=("rate",), units={"q": ("deg/s",)}), log).round(3).tolist()
        [[nan], [3.142]]
    """
    if isinstance(log, Record):
        return None
    name = source_name(log)
    messages = isinstance(log, (str, PathLike)) and Path(log).exists() and kind(Path(log)) == "bag"
    columns, table, _ = columns_and_table(name, log, columns, ("q", "position", *ATTITUDES))
    if not columns.measured:
        return None
    cells = []
    for place, column in enumerate(columns.measured):
        unit = columns.unit_of("q", place)
        in_name = unit_in_name(column, meant)
        if unit is None and in_name is not None and unit_factor(in_name) != 1:
            raise LogError(
                f"{name}: column {column!r} has a unit in its name, and no unit is given for it; write "
                f'units = "{in_name}" in the table of the sensor, or the unit that it is in'
            )
        unknown = unknown_unit(column, meant, columns.measured)
        if unit is None and unknown is not None:
            raise LogError(
                f"{name}: column {column!r} has {unknown!r} in brackets, which is no unit of what is measured in "
                f'{" or ".join(meant)}; write what one of it is, as units = "0.1 {meant[0]}" in the table of the '
                "sensor, or rename the column"
            )
        values = numbers(where(name, column, unit), table.column(column), False)
        cells.append(values if unit is None else values * unit_factor(unit))
    y = from_cells(name, columns, np.column_stack(cells))
    y = _at_stamps(y, table.column(columns.t), of) if messages else y[of.first_row - 1 :: of.every][: len(of.record.t)]
    return y if not bodies(columns) else np.concatenate([y[:, :3, 3], y[:, :3, :3].reshape(len(y), 9)], axis=1)


def _at_stamps(y: np.ndarray, clock: Any, of: Log) -> np.ndarray:
    """Readings at the stamps of a log, whose rows hold all stamps of the sensor; NaN in the others."""
    stamps = np.asarray(clock.cast("int64"))
    rows = np.rint(np.asarray(of.record.t) * 1e9).astype(np.int64) + (of.origin_ns or 0)
    place = np.minimum(np.searchsorted(rows, stamps - NEAR), len(rows) - 1)
    found = np.abs(rows[place] - stamps) <= NEAR
    filled = np.full((len(rows), *y.shape[1:]), np.nan)
    filled[place[found]] = y[found]
    return filled
