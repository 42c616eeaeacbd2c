"""Writes ROS messages, as an MCAP file or as the folder of a rosbag2."""

import contextlib
import errno
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from covariant._optional import load_optional
from covariant.logs._bag import FIELDS, POSITION, QUATERNION
from covariant.logs._columns import LogError
from covariant.logs._mcap import write_checksums
from scalargraph.files import temporary

VERSION = 8
"""Version of the layout of a rosbag2; ROS reads it since 2023."""
JOINTS, POSE, VALUES = "/joint_states", "/pose", "/values"
"""Topics of joints, of a pose, and of all other columns, which are written as positions of joints with their names."""


def write_bag(path: Path, columns: Mapping[str, np.ndarray], origin_ns: int | None) -> None:
    """Write columns as ROS messages, to an MCAP file or the folder of a rosbag2."""
    (_, stamps), *others = columns.items()
    # Python integers, because nanoseconds since 1970 need more than the 53 bits of a float.
    ns = np.array([round(t * 1e9) for t in stamps.tolist()], dtype=object) + (origin_ns or 0)
    # builtin_interfaces/Time stores seconds as a signed 32-bit integer.
    if not 0 <= ns.min() <= ns.max() < 2**31 * 10**9:
        raise LogError(f"{path}: ROS counts seconds from 0 to 2147483647; these go from {ns.min()} to {ns.max()} ns")
    rosbag2 = load_optional("rosbags.rosbag2", use="writing messages of ROS needs", extra="ros")
    types = load_optional("rosbags.typesys", use="writing messages of ROS needs", extra="ros")
    known = types.get_typestore(types.Stores.ROS2_HUMBLE)
    storage = rosbag2.StoragePlugin.MCAP if path.suffix.lower() == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    with temporary(path, Path.mkdir) as temporary_folder:
        bag = temporary_folder / path.stem
        with _report_database_errors(), rosbag2.Writer(bag, version=VERSION, storage_plugin=storage) as writer:
            topics = [
                (writer.add_connection(topic, kind, typestore=known), messages)
                for topic, kind, messages in _topics(known.types, dict(others))
            ]
            for k, now in enumerate(ns):
                stamp = known.types["builtin_interfaces/msg/Time"](*divmod(now, 10**9))
                header = known.types["std_msgs/msg/Header"](stamp, "")
                for connection, message in topics:
                    writer.write(connection, now, known.serialize_cdr(message(header, k), connection.msgtype))
        if path.suffix.lower() == ".mcap":
            # The writer makes a folder for MCAP too, with metadata and one .mcap file; only this file is needed.
            bag /= f"{bag.name}.mcap"
            write_checksums(bag)
        os.replace(bag, path)


@contextlib.contextmanager
def _report_database_errors() -> Iterator[None]:
    """Raise errors of the database, such as a full disk, as `OSError`."""
    import sqlite3

    try:
        yield
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error)) from error


def _topics(types: Mapping[str, Any], columns: dict[str, np.ndarray]) -> Iterator[tuple[str, str, Any]]:
    """Yield topic, message type and function `message(header, row)` of each topic for which there are columns."""
    fields = {name: name.rpartition("/")[::2] for name in columns}
    joints = dict.fromkeys(joint for joint, field in fields.values() if joint and field in FIELDS)
    joint_columns = {
        (joint, field): columns[name]
        for joint in joints
        for field in FIELDS
        for name in (f"{joint}/{field}", *([joint] if field == "position" else ()))
        if name in columns
    }
    state, pose = "sensor_msgs/msg/JointState", (*POSITION, *QUATERNION)
    if joint_columns:
        yield JOINTS, state, _joint_states(types[state], list(joints), joint_columns)
    pose_columns = pose if set(pose) <= columns.keys() else ()
    if pose_columns:
        kind = "geometry_msgs/msg/PoseStamped"
        yield POSE, kind, _poses(types, types[kind], [columns[name] for name in pose])
    used = {name for name in columns if name in joints or fields[name] in joint_columns} | set(pose_columns)
    rest = [name for name in columns if name not in used]
    if rest:
        yield VALUES, state, _joint_states(types[state], rest, {(name, "position"): columns[name] for name in rest})


def _joint_states(make: Callable, names: list[str], joint_columns: Mapping[tuple[str, str], np.ndarray]) -> Any:
    empty = np.full(len(next(iter(joint_columns.values()))), np.nan)
    used = {field for _, field in joint_columns}
    rows = [
        np.column_stack([joint_columns.get((name, field), empty) for name in names]) if field in used else None
        for field in FIELDS
    ]
    return lambda header, k: make(header, names, *(np.zeros(0) if cells is None else cells[k] for cells in rows))


def _poses(types: Mapping[str, Any], make: Callable, cells: list[np.ndarray]) -> Any:
    whole, point, turn = (types[f"geometry_msgs/msg/{name}"] for name in ("Pose", "Point", "Quaternion"))

    def message(header: Any, k: int) -> Any:
        x, y, z, *wxyz = (float(column[k]) for column in cells)
        return make(header, whole(point(x, y, z), turn(*wxyz[1:], wxyz[0])))

    return message
