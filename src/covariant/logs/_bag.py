"""Reads logs of ROS messages: rosbag2 folders with SQLite or MCAP storage, single files of these, and rosbag1 files.

Messages are read one after another, and only the numbers of the wanted columns are stored.
"""

import contextlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant._optional import load_optional
from covariant.logs._columns import LogError, pyarrow
from covariant.logs._mcap import check_checksums
from scalargraph.errors import InputError

RECOVERY = {
    ".mcap": "; if the recording was cut off, `mcap recover {0} -o {1}` writes all messages that are whole",
    ".db3": "; if the recording was cut off, `sqlite3 {0} .recover | sqlite3 {1}` writes all messages that are whole",
    ".bag": "; if the recording was cut off, `rosbag reindex {0}` makes all messages that are whole readable",
}
"""What to do with a damaged file, by its suffix."""
HEADER, RECEIVED = "t", "received"
"""Columns of stamps: the time in the header, when the content was true, and the time when it was recorded."""
LOOKED_AT = 500
"""Number of messages of each topic in which names are searched, as several senders with other joints may share one."""
FIELDS = ("position", "velocity", "effort")
"""Fields of a JointState; each is a list with one number for each joint, or empty."""
POSITION, QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")
IMU = ("wx", "wy", "wz", "ax", "ay", "az")
"""Angular velocity [rad/s] and specific force [m/s²] of an Imu message."""
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


def joints(message: Any) -> dict[str, float]:
    """The numbers of a JointState message, by name."""
    numbers = {}
    for field in FIELDS:
        values = getattr(message, field)
        if len(values) not in (0, len(message.name)):
            raise InputError(f"names {len(message.name)} joints and has {len(values)} numbers of {field}")
        numbers |= {f"{name}/{field}": value for name, value in zip(message.name, values, strict=False)}
    return numbers


def _pose(pose: Any) -> dict[str, float]:
    place = {name: getattr(pose.position, name[1]) for name in POSITION}
    return place | {name: getattr(pose.orientation, name[1]) for name in QUATERNION}


def _odometry(message: Any) -> dict[str, float]:
    twist = message.twist.twist
    parts = (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y, twist.angular.z)
    return _pose(message.pose.pose) | dict(zip(TWIST, parts, strict=True))


def _imu(message: Any) -> dict[str, float]:
    # The attitude is left out, as many of these sensors do not measure it.
    spin, push = message.angular_velocity, message.linear_acceleration
    return dict(zip(IMU, (spin.x, spin.y, spin.z, push.x, push.y, push.z), strict=True))


KINDS: dict[str, Callable[[Any], dict[str, float]]] = {
    "sensor_msgs/msg/JointState": joints,
    "geometry_msgs/msg/PoseStamped": lambda message: _pose(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose(message.pose.pose),
    "nav_msgs/msg/Odometry": _odometry,
    "sensor_msgs/msg/Imu": _imu,
}
"""For each type of message that can be read, a function that returns its numbers by name."""


class _Place(NamedTuple):
    """Source of a column: the topic, and the name of the number in messages of that topic."""

    topic: str
    name: str


def bag_columns(path: Path) -> dict[str, bool]:
    """Names of the columns of a log of messages."""
    with _messages(path) as (topics, messages):
        places = _places(_find_places(path, topics, messages()))
    first = {place: name for name, place in reversed(places.items())}
    return {name: first[place] == name != RECEIVED for name, place in places.items()}


def read_bag(path: Path, wanted: Sequence[str], held: Sequence[str], beside: Sequence[str] = ()) -> dict[str, Any]:
    """Read columns of a log of messages; each stamp of a topic that contains one of them gives a row.

    The rows before every column has a number are left out.
    """
    with _messages(path) as (topics, messages):
        places = _places(_find_places(path, topics, messages()))
        further = {name: places[name] for name in beside}
        places = {name: places[name] for name in wanted if name not in (HEADER, RECEIVED)}
        topics = {place.topic for place in (*places.values(), *further.values())}
        if not topics:
            return dict.fromkeys((HEADER, RECEIVED), pyarrow().array([], pyarrow().duration("ns")))
        series = _gather(path, messages(topics), topics, places | further, RECEIVED in wanted)
    leading = {place.topic for name, place in (places | further).items() if name not in held}
    stamps = np.unique(np.concatenate([series[topic][0] for topic in leading]))
    columns = {name: _at(stamps, series[topic], name, name in held) for name, (topic, _) in places.items()}
    latest = {name: _latest(values) for name, values in columns.items()}
    # −1 marks rows before the first number of a column; the log begins where no column is marked any more.
    begin = max((int((at < 0).sum()) for at in latest.values()), default=0)
    if begin == len(stamps):
        empty = [name for name, at in latest.items() if at[-1] < 0]
        raise LogError(f"{path}: no row has all columns; {', '.join(empty)} come after the last message of the others")
    for name, values in columns.items():
        values[begin] = values[latest[name][begin]]
    columns |= {name: _at(stamps, series[topic], name, False) for name, (topic, _) in further.items()}
    clock = pyarrow().array(stamps[begin:], pyarrow().duration("ns"))
    return dict.fromkeys((HEADER, RECEIVED), clock) | {name: values[begin:] for name, values in columns.items()}


def _at(stamps: np.ndarray, series: tuple[np.ndarray, dict[str, np.ndarray]], name: str, latest: bool) -> np.ndarray:
    """A column at the stamps of its topic and NaN at the others, or with `latest` its latest number at every stamp."""
    clock, values = series[0], series[1][name]
    column = np.full(len(stamps), np.nan)
    if not latest:
        column[np.searchsorted(stamps, clock)] = values
        return column
    clock, values = clock[~np.isnan(values)], values[~np.isnan(values)]
    # `right` and −1: a number logged at the stamp itself counts as the latest one.
    at = np.searchsorted(clock, stamps, side="right") - 1
    column[at >= 0] = values[at[at >= 0]]
    return column


def _latest(values: np.ndarray) -> np.ndarray:
    """For each row, the row of the latest number so far; −1 before the first one."""
    return np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))


def _gather(
    path: Path,
    messages: Iterator[tuple[str, int, Any]],
    topics: Set[str],
    places: Mapping[str, _Place],
    received: bool,
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Stamps [ns] and columns of each topic, ordered by stamp."""
    clocks = {topic: array("q") for topic in topics}
    cells = {topic: {name: array("d") for name, place in places.items() if place.topic == topic} for topic in topics}
    for topic, ns, message in messages:
        numbers = _numbers(path, topic, len(clocks[topic]), message)
        clocks[topic].append(ns if received else _stamp(message))
        for name, column in cells[topic].items():
            column.append(numbers.get(places[name].name, np.nan))
    series = {}
    for topic, clock in clocks.items():
        stamps = np.frombuffer(clock, np.int64) if len(clock) else np.zeros(0, np.int64)
        if len(stamps) > 1 and not stamps.any():
            raise LogError(f"{path}: all headers of {topic} have the stamp 0; name the column {RECEIVED!r} as t")
        # Messages are stored in the order of arrival, which may differ from the order of the stamps in their headers.
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        twice = np.flatnonzero(np.diff(stamps) == 0)
        if len(twice):
            raise LogError(
                f"{path}: messages {order[twice[0]] + 1} and {order[twice[0] + 1] + 1} of {topic} have the same stamp "
                f"{stamps[twice[0]] * 1e-9:.9f} s; record one sender only, or name the column {RECEIVED!r} as t"
            )
        series[topic] = stamps, {name: np.frombuffer(column, float)[order] for name, column in cells[topic].items()}
    return series


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    # Python integers, as a float resolves seconds since 1970 to a quarter of a microsecond only.
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def _numbers(path: Path, topic: str, count: int, message: Any) -> dict[str, float]:
    try:
        return KINDS[message.__msgtype__](message)
    except InputError as error:
        raise LogError(f"{path}: message {count + 1} of {topic} {error}") from error


def _find_places(path: Path, topics: Mapping[str, int], messages: Iterator[tuple[str, int, Any]]) -> list[_Place]:
    """All numbers in the first messages of each topic."""
    left, places = {topic: min(LOOKED_AT, count) for topic, count in topics.items()}, {}
    for topic, _, message in messages:
        if left[topic] > 0:
            places |= dict.fromkeys(_Place(topic, name) for name in _numbers(path, topic, 0, message))
            left[topic] -= 1
        if not any(left.values()):
            break
    if not places:
        raise LogError(f"{path}: its messages hold no joint and no pose; a JointState needs names")
    return list(places)


def _places(places: Sequence[_Place]) -> dict[str, _Place]:
    """Source of each column, by the number's name, by topic and name, and for a position also by the joint's name.

    The columns of stamps come first and have no source.
    """
    named = [(place.name.removesuffix("/position"), place) for place in places]
    named += [(place.name, place) for place in places] + [(f"{place.topic}/{place.name}", place) for place in places]
    named = list(dict.fromkeys(named))
    count = Counter(name for name, _ in named)
    stamps = {name: _Place("", name) for name in (HEADER, RECEIVED)}
    return stamps | {name: place for name, place in named if count[name] == 1 and name not in stamps}


@contextlib.contextmanager
def _messages(path: Path) -> Iterator[tuple[dict[str, int], Callable[..., Iterator[tuple[str, int, Any]]]]]:
    """Readable topics with the number of their messages, and `messages(topics)`, which yields topic, stamp, message."""
    need = "reading messages of ROS needs"
    highlevel = load_optional("rosbags.highlevel", use=need, extra="ros")
    types = load_optional("rosbags.typesys", use=need, extra="ros")
    try:
        for file in [path] if path.is_file() else sorted(path.glob("*.mcap")):
            check_checksums(file)
        # Before ROS Iron, bags in SQLite contain no message definitions; those of Humble are used then.
        with highlevel.AnyReader([path], default_typestore=types.get_typestore(types.Stores.ROS2_HUMBLE)) as reader:
            known = [connection for connection in reader.connections if connection.msgtype in KINDS]
            if not known:
                seen = sorted({connection.msgtype for connection in reader.connections}) or ["none"]
                raise LogError(
                    f"{path}: no topic holds {', '.join(name.split('/')[-1] for name in KINDS)}; there are: "
                    f"{', '.join(seen)}"
                )

            def messages(topics=None):
                chosen = [connection for connection in known if topics is None or connection.topic in topics]
                for connection, ns, raw in reader.messages(chosen):
                    yield connection.topic, ns, reader.deserialize(raw, connection.msgtype)

            counts = Counter()
            for connection in known:
                counts[connection.topic] += connection.msgcount
            yield dict(counts), messages
    except (LogError, ImportError, FileNotFoundError):
        raise
    except Exception as error:  # the reader may raise any exception for a damaged file
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__).rstrip(".")
        files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.suffix in RECOVERY)
        how = "".join(
            RECOVERY.get(file.suffix, "").format(file, file.with_stem(f"{file.stem}_whole")) for file in files
        )
        raise LogError(f"{path}: cannot be read as a rosbag: {reason}{how}") from error
