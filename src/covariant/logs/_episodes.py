"""Several recordings in one file, the episodes of a data set: how one is named, and that they are no single log."""

import contextlib
import re
from collections.abc import Callable, Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant._names import natural_key
from covariant.logs._endings import WRITTEN
from scalargraph.errors import InputError

_NAME = re.compile(
    r"(?:.*[_ ./])?(?:episode|trial|traj|trajectory|rollout|demo)(?:[_ ]?(?:index|idx|id|no|nr|number))?"
)
INFO = Path("meta", "info.json")
"""Description of a LeRobot data set, from its folder."""
NOT_TABLES = (".mcap", ".rosbag2", ".db3", ".bag")
"""Suffixes of logs of messages, which have no episodes."""
READ = (*WRITTEN, *NOT_TABLES)
"""Suffixes of logs."""
LONGEST_HEADER = 1 << 20
"""Largest size of a header [bytes] in which the column of an episode is looked for."""
SHOWN = 3
"""Number of episodes whose rows are listed in a message."""


def episode_columns(names: Iterable[str]) -> list[str]:
    """Names of columns that may contain the number of an episode.

    Example:
        >>> from covariant.logs._episodes import episode_columns
        >>> episode_columns(["timestamp", "episode_index", "frame_index"])
        ['episode_index']
    """
    return [name for name in names if _NAME.fullmatch(name.lower())]


def part_of(log: str | PathLike[str]) -> tuple[Path, int | None]:
    """The file of a log, and the number of its episode, 3 of `data.parquet#3`; None for all rows of a file.

    Example:
        >>> from covariant.logs import part_of
        >>> part_of("data.parquet#3")[1], part_of("data.parquet")[1]
        (3, None)
    """
    path = Path(log)
    name, _, number = str(path).rpartition("#")
    return (Path(name), int(number)) if name and number.isdecimal() and not path.exists() else (path, None)


def episodes(log: Any, strict: bool = True) -> tuple[Any, ...]:
    """The logs of a file or a folder, in the order of the numbers in their names.

    A file with several episodes has one for each, `FILE#3` for that of number 3, and every other log is one, also in
    memory. A folder has those of all logs in it; of a LeRobot data set, those of its `data`; without logs, those in the
    folders in it, such as one for each arm.

    Args:
        log: A path, or a log in memory.
        strict: Whether a folder without any log is an error; otherwise it stays one log, which cannot be read.

    Returns:
        Logs, by their paths, for `read` and all that takes a log.

    Raises:
        ValueError: The folder has no log.

    Example:
        >>> import pandas, tempfile
        >>> from pathlib import Path
        >>> from covariant import logs
        >>> folder = Path(tempfile.mkdtemp())
        >>> frame = pandas.DataFrame({"t": [0.0, 0.1, 0.0, 0.1], "q": [1.0, 2.0, 3.0, 4.0], "episode": [0, 0, 1, 1]})
        >>> frame.to_csv(folder / "runs.csv", index=False)
        >>> [Path(each).name for each in logs.episodes(folder)]
        ['runs.csv#0', 'runs.csv#1']
    """
    if not isinstance(log, str | PathLike):
        return (log,)
    path, number = part_of(log)
    if path.is_dir() and not is_log(path):
        if number is not None:
            raise InputError(f"{log}: this is a folder; #{number} belongs after the name of a file, as FILE#{number}")
        files = _files(path) or [file for each in _in_order(path.iterdir()) if each.is_dir() for file in _files(each)]
        if not files and not strict:
            return (log,)
        if not files:
            raise InputError(f"{path}: this folder has no log; give one with .csv or .parquet files, or a data set")
        return tuple(each for file in files for each in episodes(str(file)))
    numbers: list[int] = []
    if number is None and path.is_file() and path.suffix.lower() not in NOT_TABLES:
        with contextlib.suppress(OSError, ValueError):  # whoever reads a broken file says what is wrong with it
            numbers = _numbers(path)
    return tuple(f"{log}#{each}" for each in numbers) if len(numbers) > 1 else (log,)


def _files(folder: Path) -> list[Path]:
    """The logs in a folder, or in the `data` of a data set."""
    return _in_order(
        filter(is_log, (folder / "data").rglob("*.parquet") if (folder / INFO).is_file() else folder.iterdir())
    )


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=lambda each: natural_key(str(each)))


def is_log(path: Path) -> bool:
    """Whether a path is that of a log, by its suffix; those of hidden files are none."""
    return (path.suffix.lower() in READ and not path.name.startswith(".")) or (path / "metadata.yaml").is_file()


def _numbers(path: Path) -> list[int]:
    """Numbers of the episodes of a file, in the order of its rows; empty if it does not have any."""
    is_text = path.suffix.lower() != ".parquet"
    if is_text:
        with path.open("rb") as file:  # most texts have no such column, and are not read for it
            header = file.readline(LONGEST_HEADER).decode(errors="replace")
        if not episode_columns(re.split(r"[^\w./]+", header)):
            return []
    # Loads JAX, which comes after everything is checked.
    from covariant.logs._cells import numbers
    from covariant.logs._columns import numeric_columns, pyarrow
    from covariant.logs._text import read_text, sheet

    if is_text:
        text = sheet(path)
        columns = episode_columns(text.header)[:1]
        table = read_text(pyarrow(), path, text, columns)
    else:
        with pyarrow().parquet.ParquetFile(path) as file:
            columns = episode_columns(numeric_columns(file.schema_arrow))[:1]
            table = file.read(columns=columns)
    if not columns:
        return []
    try:
        found = numbers(str(path), table.column(0), needed=False)
    except InputError:  # names in place of numbers
        return []
    # Rows without a number belong to no episode. Numbers that are not whole, or come again, such as those of a desired
    # trajectory, count none.
    known = found[np.isfinite(found) & (found >= 0)]
    begins = known[np.diff(known, prepend=-1.0) != 0]
    return begins.astype(int).tolist() if not (begins % 1).any() and len(begins) == len({*begins}) else []


def episodes_fault(
    t: Float[np.ndarray, "T"],
    names: Iterable[str],
    cells: Callable[[str], Float[np.ndarray, "T"]],
    rising: bool = False,
) -> str | None:
    """Fault of stamps that restart with each episode of a file: the rows of the episodes, and how to extract one.

    Args:
        t: Stamps (T,) as logged.
        names: Names of all columns.
        cells: Function of a name: numbers (T,) of that column.
        rising: Whether several episodes are a fault even if the stamps keep rising.

    Returns:
        The fault and its remedy, as text that follows the name of the column of stamps. None if there is one recording,
        or if stamps decrease elsewhere than at the end of an episode.

    Example:
        >>> import numpy as np
        >>> from covariant.logs import episodes_fault
        >>> numbers = {"episode_index": np.array([0, 0, 1, 1])}
        >>> fault = episodes_fault(np.array([0.0, 0.1, 0.0, 0.1]), numbers, numbers.get)
        >>> fault.partition(";")[0]
        'starts again at row 3: by episode_index, 0 is rows 1 to 2, 1 is rows 3 to 4'
    """
    back = 1 + np.flatnonzero(np.diff(t) <= 0)
    for name in episode_columns(names):
        numbers = cells(name)
        if len(numbers) != len(t) or not np.isfinite(numbers).all():
            continue
        begins = [0, *(1 + np.flatnonzero(np.diff(numbers) != 0)).tolist()]
        if len(begins) == 1 or not set(back.tolist()) <= set(begins) or (not len(back) and not rising):
            continue
        ends = [*begins[1:], len(t)]
        rows = [f"{numbers[a]:g} is rows {a + 1} to {b}" for a, b in zip(begins, ends, strict=True)]
        listed = ", ".join(rows[:SHOWN]) + (f", and {len(rows) - SHOWN} more" if len(rows) > SHOWN else "")
        what = f"starts again at row {back[0] + 1}" if len(back) else "goes on over several recordings"
        longest = numbers[begins[int(np.argmax(np.subtract(ends, begins)))]]
        return (
            f"{what}: by {name}, {listed}; the name of a file with #{longest:g} after it is one of them, and in pandas "
            f"frame[frame[{name!r}] == {longest:g}]"
        )
    return None
