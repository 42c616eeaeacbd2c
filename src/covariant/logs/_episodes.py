"""Several recordings in one file, the episodes of a data set: how one is named, and that they are no single log."""

import re
from collections.abc import Callable, Iterable
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

_NAME = re.compile(
    r"(?:.*[_ ./])?(?:episode|trial|traj|trajectory|rollout|demo)(?:[_ ]?(?:index|idx|id|no|nr|number))?"
)
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
