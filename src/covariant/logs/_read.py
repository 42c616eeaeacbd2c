"""Reads logs of every kind into records in SI units."""

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._bag import bag_columns, read_bag
from covariant.logs._cells import numbers
from covariant.logs._clock import displaced_rows
from covariant.logs._columns import (
    ATTITUDES,
    ClockError,
    Columns,
    Log,
    LogError,
    check_log,
    kind,
    numeric_columns,
    pyarrow,
)
from covariant.logs._configuration import bodies, from_cells
from covariant.logs._entries import by_entries, is_list
from covariant.logs._episodes import episodes_fault, part_of
from covariant.logs._parquet import episode_column, of_episode, open_parquet, read_parquet
from covariant.logs._register import Register
from covariant.logs._stamps import stamps, timed
from covariant.logs._tables import (
    LogSource,
    find,
    source_name,
    stated_units,
    table_source,
    unite,
)
from covariant.logs._text import read_text, sheet, with_points
from covariant.logs._unit_in_name import MEANT, is_unit_of, unit_in_name, unknown_unit, unknown_unit_fault
from covariant.logs._units import check_unit, unit_factor
from covariant.scoring import unwrap
from covariant.signals import Record, StampError
from scalargraph.errors import InputError, MissingPackageError
from scalargraph.files import bounded

OPTIONAL = ("v", "truth")
"""Fields of `Columns` that are used only for comparison."""
MEASURED = ("q", "position", *ATTITUDES, "angle")
"""Fields of the measured configuration, in the order of `Columns.measured`."""

_FIELDS = ", ".join(field for field in Columns._fields if field != "units")


def read(
    log: str | PathLike[str] | Record | Any,
    columns: Columns,
    every: int = 1,
    until: float | None = None,
    start: float | None = None,
    optional: Collection[str] = OPTIONAL,
    sensors: Sequence[tuple[Columns, str]] = (),
    periods: Sequence[float] = (),
    missing_inputs: bool = False,
    absent: Collection[str] = (),
) -> Log:
    """Read a log; an empty cell or `nan` is a missing measurement; in t and u it is an error.

    Rows are counted from 1, without header, comments and empty lines. Attitudes become rotation matrices: a quaternion
    or matrix that is off by less than 5 % is replaced by the nearest rotation. Dates, and times since 1970, count from
    the first of them, `Log.origin_ns`.

    Use it to get a `Record` with correct units, attitudes and missing values. The verbs call it with the columns of the
    model file; `covariant.logs.record` is a short form for a few named columns.

    Args:
        log: One of

            - a path: a `.csv`, `.txt` or `.tsv` file, whose delimiter and decimal mark are detected, and whose
              comments, lines that begin with `#` or `%`, are left out; a `.parquet` file; a `.mcap` file or the folder
              of a rosbag2;
            - a data frame of any library that narwhals knows (pandas, polars, a table of pyarrow and others), or a
              dataset of xarray, whose variables along one dimension are the columns;
            - a `Record`, which is already in SI units: only its numbers of positions and inputs are compared with
              `columns`, and its true state stays in `Log.record.x`.
        columns: Names and units of the columns.
        every: Read only each k-th row.
        until: Time [s] since the first row at which reading ends.
        start: Time [s] since the first row at which reading begins. The whole log must be valid nevertheless.
        optional: Fields of `columns` that are ignored if the log has none of their columns.
        sensors: Further sensors, for `Log.readings`: the columns of each, `q` or a position and an attitude, and the SI
            unit of its numbers, "" if it is not known. In a log of messages their stamps also become rows, without
            positions; in a table they are rows already.
        periods: Period (n,) after which each position reads the same again, in its SI unit; 0 for none. Jumps by a
            period are removed from the whole log, before rows are left out.
        missing_inputs: Whether an empty cell of u is accepted as a missing input, NaN, for estimators that can handle
            it; False by default.
        absent: Columns of positions that may be missing in the log, or have no number, such as those of joints without
            an encoder; they become NaN. At least one position must be present.

    Returns:
        The rows that were asked for, in SI units and radians.

    Raises:
        LogError: There is a fault; the message names file (or "table", "dataset", "record"), column and row of the
            first one.
        FileNotFoundError: There is no such file.
        ImportError: A package is missing: pyarrow, narwhals for data frames, or rosbags for ROS messages.

    Example:
        >>> import numpy as np
        >>> import pandas
        >>> from covariant import logs
        >>> frame = pandas.DataFrame({"time": [0, 10, 20], "arm": [0.0, 9.0, 18.0]})
        >>> columns = logs.Columns(t="time", q=("arm",), units={"t": ("ms",), "q": ("deg",)})
        >>> np.round(logs.read(frame, columns).record.y, 3)
        array([[0.   ],
               [0.157],
               [0.314]])
    """
    name = source_name(log)
    if not columns.measured:
        raise LogError(f"{name}: no position column was named; say which columns hold q")
    try:
        bodies(columns)
    except LogError as error:
        raise LogError(f"{name}: {error}") from error
    for field, texts in columns.units.items():
        if field not in Columns._fields or field == "units":
            raise LogError(f"{name}: units are given for {field!r}, which is no field; the fields are {_FIELDS}")
        count = 1 if field == "t" else len(getattr(columns, field))
        if len(texts) not in (1, count):
            raise LogError(f"{name}: {len(texts)} units are given for {field}, which has {count} columns")
    for text in columns.units.get("t", ()):
        try:
            check_unit(text, "s")
        except InputError as error:
            raise LogError(f"{name}: units of t: {error}") from error
    if every < 1:
        raise LogError(f"{name}: every must be 1 or more rows; got {every}")
    asked = _Asked(name, log, columns, optional, sensors, missing_inputs, absent)
    if isinstance(log, Record):
        whole = _of_record(asked)._replace(readings=(None,) * len(sensors))
    else:
        whole = _of_columns(asked)
    if any(periods):
        y = unwrap(np.asarray(whole.record.y), (), periods)
        whole = whole._replace(record=whole.record._replace(y=y))
    return _select_rows(name, whole, every, until, start, _unmeasured(whole.record, columns, absent))


def record(
    log: str | PathLike[str] | Any,
    t: str = "t",
    q: str | Sequence[str] = (),
    u: str | Sequence[str] = (),
    units: Mapping[str, str | Sequence[str]] | None = None,
) -> Record:
    """Read a `Record` from a file, a data frame or a dataset, without a model file.

    Args:
        log: A path, data frame or dataset, as for `read`.
        t: Name of the column of stamps [s], or dates.
        q: Name or names of the columns of positions [rad or m].
        u: Name or names of the columns of inputs [SI units]; none by default.
        units: Units of the columns of t, q or u that are not SI units, as `{"t": "ms", "q": ["deg", "mm"]}`.

    Returns:
        Stamps (T,), inputs (T, m) and positions (T, n) in SI units and radians.

    Raises:
        LogError: There is a fault; the message names the first one, as in `read`.

    Example:
        >>> import pandas
        >>> from covariant import logs
        >>> logs.record(pandas.DataFrame({"t": [0.0, 0.1, 0.2], "q1": [0.0, 0.3, 0.4]}), q="q1")
        <Record: 3 rows over 0.2 s, 1 position, no input>
    """
    named = {field: _names(texts) for field, texts in (units or {}).items()}
    for text in named.get("q", ()):
        if not is_unit_of(text, MEANT["q"]):
            raise LogError(f"{source_name(log)}: units of q: unit {text!r} is no unit of an angle or a length")
    return read(log, Columns(t=t, q=_names(q), u=_names(u), units=named)).record


def _names(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


class _Asked(NamedTuple):
    """What is asked of a log, with its name: the arguments of `read`."""

    name: str
    log: Any
    columns: Columns
    optional: Collection[str]
    sensors: Sequence[tuple[Columns, str]]
    missing_inputs: bool
    absent: Collection[str]

    def check(self, record: Record, columns: Columns) -> Record:
        """The record after `Record.check`, before rows are dropped, so that messages count rows of the log."""
        try:
            start = np.flatnonzero(~_unmeasured(record, columns, self.absent)) if self.absent else None
            return record.check(start, missing_inputs=self.missing_inputs)
        except StampError as error:
            raise ClockError(f"{self.name}: {error}", record) from error
        except InputError as error:
            raise LogError(f"{self.name}: {error}") from error


def _of_columns(asked: _Asked) -> Log:
    """All rows of a log that consists of columns."""
    name, absent, sensors = asked.name, asked.absent, asked.sensors
    columns, present, table, source = _columns_and_table(asked)
    units = source.units
    for field in ("t", *MEASURED, "u", *OPTIONAL):
        # The type of dates and durations already determines their unit.
        if field != "t" or not timed(table.column(columns.t)):
            _need_units(name, columns, field, units)

    def stack(columns: Columns, *fields: str, needed: bool = False, empty: bool = True) -> np.ndarray:
        cells = []
        for field in fields:
            for place, column in enumerate(getattr(columns, field)):
                unit = columns.unit_of(field, place)
                if column in absent and column not in table.column_names:
                    cells.append(np.full(len(table), np.nan))
                    continue
                values = numbers(_where(name, column, unit), table.column(column), needed)
                # A column without any number is a wrong column, and not a sensor with gaps.
                if not empty and column not in absent and len(values) and np.isnan(values).all():
                    raise LogError(f"{_where(name, column, unit)} holds no number in any row; name another column")
                register = Register(0.0) if (values < 0).any() else Register.of(values)
                coded = register.fault(column)
                # Positions in two's complement begin anew there, as those of an encoder on a circle do.
                if coded is not None and not (register.span and field in MEASURED):
                    raise LogError(f"{name}: {coded}")
                cells.append(values if unit is None else values * unit_factor(unit))
        return np.column_stack(cells) if cells else np.empty((len(table), 0))

    def readings(columns: Columns, si: str) -> np.ndarray:
        for field in ("q", "position"):
            _need_units(name, columns, field, units, si)
        y = from_cells(name, columns, stack(columns, *MEASURED))
        return np.concatenate([y[:, :3, 3], y[:, :3, :3].reshape(len(y), 9)], axis=1) if bodies(columns) else y

    unit = columns.unit_of("t", 0)
    t, origin = stamps(_where(name, columns.t, unit), table.column(columns.t), unit)
    u = stack(columns, "u", needed=not asked.missing_inputs)
    y = from_cells(name, columns, stack(columns, *MEASURED, empty=False))
    v, truth = (stack(columns, field) if getattr(columns, field) else None for field in OPTIONAL)
    read = tuple(readings(each, si) if each in present else None for each, si in sensors)
    try:
        record = asked.check(Record(t, u, y), columns)
    except ClockError as error:
        fault = episodes_fault(t, source.shown, lambda each: _whole_column(name, source, each))
        if (displaced := displaced_rows(t)) is not None and fault is None:
            first, count = displaced.rows[0] + 1, len(displaced.rows)
            fault = f"is {displaced.how} in single rows, {count} in all, the first is row {first}; {displaced.remedy}"
        if fault is None:
            raise
        raise ClockError(f"{name}: column {columns.t!r} {fault}", error.record) from error
    return Log(record, v, truth, origin, readings=read)


def _whole_column(name: str, source: LogSource, column: str) -> Float[np.ndarray, "T"]:
    """A column of numbers (T,) of a log; NaN for all other cells."""
    cells = source.load([column], (), ()).column(column)
    try:
        return numbers(name, cells, needed=False)
    except LogError:
        return np.full(len(cells), np.nan)


def _need_units(log: str, columns: Columns, field: str, units: Mapping[str, str], si: str | None = None) -> None:
    """Raise `LogError` for a column whose name or log states another unit than the one in which it would be read, or a
    unit that is not known. `units` are those that the log states, and `si` is the unit of a sensor.
    """
    names = getattr(columns, field)
    names = (names,) if isinstance(names, str) else names
    meant: Sequence[str] = MEANT.get(field, ()) if si is None else [si] * bool(si)
    key, table = (field, "under [units] of the model file") if si is None else ("units", "in the table of the sensor")
    # Units stated by the log are written like units in names, so that one parser reads both.
    labels = [f"{name} [{units[name]}]" if name in units else name for name in names]
    in_names = [unit_in_name(label, meant) for label in labels]
    for place, (name, text) in enumerate(zip(names, in_names, strict=True)):
        unknown = unknown_unit(labels[place], meant, labels)
        if unknown is not None and columns.unit_of(field, place) is None:
            fault = unknown_unit_fault(name, field, unknown, name in units, sensor=si)
            raise LogError(f"{log}: {fault}")
        if text is not None and unit_factor(text) != 1 and columns.unit_of(field, place) is None:
            texts = [f'"{each or meant[0]}"' for each in in_names]
            line = f"{key} = {texts[0] if len(set(texts)) == 1 else '[' + ', '.join(texts) + ']'}"
            raise LogError(
                f"{log}: column {name!r} has a unit in its {'attributes' if name in units else 'name'}, and no unit is "
                f"given for {field if si is None else 'it'}; write {line} {table}, or the unit that it is in"
            )


def _of_record(asked: _Asked) -> Log:
    """A log from a record; its numbers of positions and inputs must be those of the columns."""
    columns, log = asked.columns, asked.check(asked.log, asked.columns)
    log = log._replace(t=np.asarray(log.t), u=np.asarray(log.u), y=np.asarray(log.y))
    if not bodies(columns) and log.y.shape[1:] != (len(columns.q),):
        raise LogError(f"record: it has positions of shape {log.y.shape[1:]}, needs {len(columns.q)} of them")
    if log.u.shape[1] != len(columns.u):
        raise LogError(f"record: it has {log.u.shape[1]} inputs, needs {len(columns.u)}")
    return Log(log)


def _select_rows(
    name: str, log: Log, every: int, until: float | None, start: float | None, unmeasured: np.ndarray
) -> Log:
    """Every k-th row of a log between two times since its first row; `unmeasured` are positions without a sensor."""
    t = log.record.t
    since = t - t[0]
    # Both ends are included, hence "left" at the start and "right" at the end.
    low = 0 if start is None else int(np.searchsorted(since, start, side="left"))
    rows = slice(low, len(t) if until is None else int(np.searchsorted(since, until, side="right")), every)
    if len(t[rows]) < 2:
        asked = (("every", every), ("from", start), ("until", until))
        given = ", ".join(f"{word}={value:g}" for word, value in asked if value is not None)
        raise LogError(f"{name}: {given} keep {len(t[rows])} of {len(t)} rows, and two are needed")
    # An observer starts from the first measurement, which therefore has to be complete.
    if (np.isnan(log.record.y[rows][0]).ravel() & ~unmeasured).any():
        row = low + 1
        raise LogError(f"{name}: row {row}, the first one kept, lacks a measurement; begin a little later or earlier")
    record, v, truth, readings = (_rows(part, rows) for part in (log.record, log.v, log.truth, log.readings))
    whole = None if len(record.t) == len(t) else log.record
    return Log(record, v, truth, log.origin_ns, low + 1, every, readings, whole)


def _rows(part: Any, rows: slice) -> Any:
    """Some rows of an array, or of all arrays in a named tuple, such as a record or the motion of a group."""
    if part is None:
        return None
    if isinstance(part, tuple):
        each = (_rows(each, rows) for each in part)
        return tuple(each) if type(part) is tuple else type(part)(*each)
    return part[rows]


def _where(name: str, column: str, unit: str | None) -> str:
    return f"{name}: column {column!r}" + (f" [{unit}]" if unit else "")


def _unmeasured(record: Record, columns: Columns, absent: Collection[str]) -> np.ndarray:
    """Mask of the entries of a measurement that have no number in any row and are allowed to be absent."""
    y = np.asarray(record.y, float).reshape(len(record.t), -1)
    may, empty = np.zeros(y.shape[1], bool), np.isnan(y).all(0)
    may[y.shape[1] - len(columns.q) :] = np.isin(columns.q, list(absent))  # the joints come last
    return empty & may & ~empty.all()


def _columns_and_table(asked: _Asked) -> tuple[Columns, list[Columns], Any, LogSource]:
    """The columns without optional ones that the log lacks, the columns of its sensors, a table of all of them, and
    their source.
    """
    name, columns = asked.name, asked.columns
    with legible(name, asked.log):
        source = open_source(name, asked.log)
        names = source.names
        # A field counts as absent only if all its columns are missing; otherwise a missing one is an error below.
        absent = [field for field in asked.optional if not set(getattr(columns, field)) & set(names)]
        columns = columns._replace(**dict.fromkeys(absent, ()))
        wanted = list(dict.fromkeys((columns.t, *columns.measured, *columns.u, *columns.v, *columns.truth)))
        if set(columns.measured) & set(names):
            wanted = [column for column in wanted if column in names or column not in asked.absent]
        # A sensor also counts as absent only if all its columns are missing.
        present = [each for each, _ in asked.sensors if set(each.measured) & set(names)]
        beside = [name for each in present for name in each.measured if name not in wanted]
        find(name, wanted + beside, source)
        table, _ = unite(name, source.load(wanted, columns.u, beside))
        return columns, present, with_points(pyarrow(), name, table, source.decimal_commas), source


@contextlib.contextmanager
def legible(name: str, log: object) -> Iterator[None]:
    pa = pyarrow()
    try:
        with bounded(name):
            yield
    except MissingPackageError:
        raise
    except InputError as error:
        raise LogError(str(error)) from error
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        path = part_of(log)[0] if isinstance(log, (str, PathLike)) else None
        if path is not None and not path.exists():
            raise FileNotFoundError(f"{name}: no such file") from None
        what = "a table" if path is None else kind(path).replace("bag", "a rosbag")
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise LogError(f"{name}: cannot be read as {what}: {reason}") from error


def open_source(name: str, log: Any) -> LogSource:
    if not isinstance(log, (str, PathLike)):
        return by_entries(table_source(name, log))
    path, episode = part_of(log)
    ending = kind(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    check_log(path)
    if ending == "bag":
        if episode is not None:
            raise LogError(f"{name}: a log of messages has no episodes; leave #{episode} out")
        names = bag_columns(path)
        shown = [name for name, shortest in names.items() if shortest]
        return LogSource(list(names), shown, lambda *asked: pyarrow().table(read_bag(path, *asked)))
    if ending == ".parquet":
        with open_parquet(path) as file:
            schema = file.schema_arrow
            check_log(path, file.metadata.num_rows)
        names, lists = list(schema.names), [field.name for field in schema if is_list(field.type)]
        part = None if episode is None else (episode_column(path, numeric_columns(schema)), episode)

        def load(wanted: Sequence[str], held: Sequence[str], beside: Sequence[str]) -> Any:
            return read_parquet(path, [*wanted, *beside], part)

        return by_entries(LogSource(names, names, load, stated_units(schema), lists=lists), path)
    text = sheet(path)
    source = LogSource(
        text.header,
        text.header,
        lambda wanted, held, beside: read_text(pyarrow(), path, text, [*wanted, *beside]),
        first_line=text.first_line,
        decimal_commas=text.delimiter == ";",
    )
    return source if episode is None else of_episode(path, source, episode)
