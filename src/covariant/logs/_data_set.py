"""The logs of a folder, the episodes of a data set among them, and what a data set says of its robot."""

import contextlib
import json
from collections import Counter
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._door import STORE
from covariant.logs._cells import numbers
from covariant.logs._columns import LogError, pyarrow
from covariant.logs._episodes import INFO, episodes, part_of
from covariant.logs._read import legible, open_source
from covariant.logs._register import Register
from covariant.logs._stamps import stamps, timed
from covariant.logs._tables import no_header, source_name, unite
from covariant.logs._text import with_points
from covariant.logs._unit_in_name import words_of
from scalargraph.files import bounded, read_bytes

_CALIBRATIONS = ("calibration.json", "meta/calibration.json")
"""Files with the calibration of the arm, from the folder of its data set."""
TRIED, LEAST_MOTION = 20, 0.01
"""Most episodes among which the one that moves most is looked for, and the motion, in parts of the largest, that counts
as none."""
GRIPPERS = {"gripper", "jaw", "finger", "hand", "claw"}
TICKS, SAME_TICK = 4096, 1e-3
"""Ticks per turn of the encoders of a calibration, and the relative difference up to which ticks are equal."""


class LogSurvey(NamedTuple):
    """All numeric columns of a log.

    Attributes:
        columns: Arrays (T,) by name, in the order of the log and in its units; empty cells are NaN.
        units: Units that the log states apart from names, by column: attributes of a dataset, metadata of Parquet.
        remarks: Sentences on anything unusual about the names, for example that there are none.
        labels: Names that the log gives to the entries of lists, by column: `{"action[0]": "shoulder_pan.pos"}`.
        log: The log that these are the columns of: of a folder, one in it.
        robot: Kind of the robot of a data set, `so101` for `so101_follower`; "" if it is not known.

    Example:
        >>> import pandas
        >>> from covariant import logs
        >>> logs.survey(pandas.DataFrame({"t": [0.0, 0.1]})).remarks
        ()
    """

    columns: dict[str, Float[np.ndarray, "T"]]
    units: Mapping[str, str]
    remarks: tuple[str, ...]
    labels: Mapping[str, str] = MappingProxyType({})
    log: Any = None
    robot: str = ""


def survey(log: str | PathLike[str] | Any) -> LogSurvey:
    """Read all numeric columns of a log, by name.

    Other columns are left out, except that dates become seconds since the first of them. If several columns have the
    same name, the first one is used if they are equal, and none otherwise. Of several episodes, in a folder or a file,
    it is the one in which most columns move. A gripper in a data set is left out, since it is logged in per cent.

    Args:
        log: A path, data frame or dataset, as for `read`, or a folder of logs.

    Returns:
        The columns, the units that the log states, and remarks about its names.

    Raises:
        LogError: The file is not a log; as for `read`.

    Example:
        >>> import pandas
        >>> from covariant import logs
        >>> list(logs.survey(pandas.DataFrame({"t": [0.0, 0.1], "q1": [0.0, 0.3], "remark": ["on", "off"]})).columns)
        ['t', 'q1']
    """
    if (each := episodes(log))[0] is log:
        return survey_log(log)
    tried: list[LogSurvey] = []
    for k in np.unique(np.linspace(0, len(each) - 1, TRIED).round().astype(int)):
        with contextlib.suppress(LogError):
            tried.append(survey_log(each[k]))
    tried = tried or [survey_log(each[0])]  # which says what is wrong
    # One that has other columns than most was recorded otherwise, or is no log.
    names = Counter(tuple(found.columns) for found in tried).most_common(1)[0][0]
    tried = [found for found in tried if tuple(found.columns) == names]
    moved = np.array([[np.ma.masked_invalid(x).std() or 0.0 for x in found.columns.values()] for found in tried])
    most = moved.max(axis=0)
    scores = np.log(moved[:, most > 0] / most[most > 0] + LEAST_MOTION).sum(axis=1)
    return _of_data_set(tried[int(np.argmax(scores))])


def survey_log(log: Any) -> LogSurvey:
    name = source_name(log)
    with legible(name, log):
        source = open_source(name, log)
        named = list(dict.fromkeys(column for column in source.shown if column))
        table, remarks = unite(name, source.load(named, (), ()), refuse=False)
        table = with_points(pyarrow(), name, table, source.decimal_commas)
    columns: dict[str, np.ndarray] = {}
    # A log of messages also loads its clock.
    for column_name in [each for each in named if each in table.column_names]:
        column = table.column(column_name)
        with contextlib.suppress(LogError):
            is_time = timed(column)
            columns[column_name] = stamps(name, column, None).t if is_time else numbers(name, column, needed=False)
    if source.first_line:
        remarks.append(no_header(source))
    return LogSurvey(columns, source.units, tuple(remarks), source.labels, log)


def _of_data_set(found: LogSurvey) -> LogSurvey:
    """The survey with what a LeRobot data set says of its robot, if the log is in one: its kind, `so101` for
    `so101_follower`, no columns of a gripper, and the units of positions that the calibration of the arm shows."""
    # Its files are in `data/chunk-000/`; what lies farther above a log is not about it.
    folder = next((each for each in Path(part_of(found.log)[0]).parents[:3] if (each / INFO).is_file()), None)
    if folder is None or not (info := _json(folder / INFO)):
        return found
    calibration: dict[str, Any] = next(filter(None, (_json(folder / name) for name in _CALIBRATIONS)), {})
    ranges: dict[str, float] = {}  # of the positions of each joint, in ticks
    for joint, known in calibration.items():
        with contextlib.suppress(TypeError, KeyError, ValueError):
            ranges[joint] = float(known["range_max"]) - float(known["range_min"])
    joints = {name: text.removesuffix(".pos") for name, text in found.labels.items()}
    grippers = [name for name, text in joints.items() if words_of(text) & GRIPPERS]
    columns = {name: each for name, each in found.columns.items() if name not in grippers}
    # Positions from -100 to 100 have a tick of 200 over the ticks of the range.
    scales = {name: ranges.get(joints[name], 0.0) / 200 for name in columns if name in joints}
    per_cent = {
        name: f"{scale * 360 / TICKS:.9g} deg"
        for name, scale in scales.items()
        if scale > 0 and abs(Register.of(columns[name].astype(np.float32)).tick * scale - 1) < SAME_TICK
    }
    left = f"{', '.join(grippers)} left out: per cent of the range of a gripper, and no angle"
    return found._replace(
        columns=columns,
        units={**found.units, **per_cent},
        remarks=(*found.remarks, *[left] * bool(grippers)),
        robot=str(info.get("robot_type") or "").removesuffix("_follower"),
    )


def _json(path: Path) -> dict[str, Any]:
    """Content of a file of JSON; empty if there is none, or another content."""
    with contextlib.suppress(ValueError, OSError), bounded(path.name):
        content = json.loads(read_bytes(path, STORE)) if path.is_file() else {}
        return content if isinstance(content, dict) else {}
    return {}
