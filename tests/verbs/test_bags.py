"""Drafts of recorded messages: what belongs to which joint is told by names, and nothing is crossed."""

import re

import numpy as np
import pandas
import pytest

import covariant
from covariant import models

pytest.importorskip("rosbags.rosbag2")
JOINTS = ("shoulder", "elbow", "wrist")


def record(path, seed):
    """A bag of JointState messages, whose senders differ in what a seed says."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, random = get_typestore(Stores.ROS2_HUMBLE), np.random.default_rng(seed)
    kind, types = "sensor_msgs/msg/JointState", store.types
    joints = list(random.permutation(JOINTS[: 2 + seed % 2]))
    topics = ("/joint_states",) if seed % 5 else ("/left", "/right")
    efforts, velocities = seed % 3 != 1, seed % 4 != 2
    storage = list(StoragePlugin)[seed % 2]
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = [writer.add_connection(topic, kind, typestore=store) for topic in topics]
        for k in range(300):
            t, names = 0.01 * k, list(random.permutation(joints)) if seed % 3 == 2 else joints
            phase = np.array([JOINTS.index(name) for name in names])
            stamp = types["builtin_interfaces/msg/Time"](1 + k // 100, 10_000_000 * (k % 100))
            position, velocity = 0.5 * np.sin((2 + phase) * t), 0.5 * (2 + phase) * np.cos((2 + phase) * t)
            message = types[kind](
                types["std_msgs/msg/Header"](stamp, ""),
                list(map(str, names)),
                position,
                velocity if velocities else np.zeros(0),
                np.cos((5 + phase) * t) if efforts else np.zeros(0),
            )
            for connection in connections:
                writer.write(connection, 10**9 + 10**7 * k, store.serialize_cdr(message, kind))
    return path, efforts, velocities


def joint(name):
    return name.split("/")[-2] if "/" in name else name


@pytest.mark.parametrize("seed", range(20))
def test_a_bag_is_drafted_right_or_leads_to_a_question(seed, tmp_path):
    path, efforts, velocities = record(tmp_path / "bag", seed)
    if not seed % 7:  # cut off
        file = next(each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        with pytest.raises(ValueError, match=r"cannot be read as a rosbag: .*(mcap recover|sqlite3) .*_whole") as error:
            covariant.verbs.init(path)
        assert "\n" not in str(error.value)
        return
    if not seed % 5:
        with pytest.raises(ValueError, match=r"several topics have .*name the positions of one by"):
            covariant.verbs.init(path)
        return
    if not efforts and not velocities:  # names alone do not say what they are
        with pytest.raises(ValueError, match="no column is named like a position"):
            covariant.verbs.init(path)
        return
    random = np.random.default_rng(seed)
    order = list(random.permutation(JOINTS[: 2 + seed % 2]))
    for columns in (None, {"q": order}):
        draft = covariant.verbs.init(path, columns=columns).draft
        assert sorted(map(joint, draft.q)) == sorted(order)
        if columns is not None:
            assert list(draft.q) == order
        assert list(map(joint, draft.u)) == list(map(joint, draft.q)) * efforts
        assert list(map(joint, draft.v)) == list(map(joint, draft.q)) * velocities


@pytest.mark.parametrize(
    ("q", "u", "driven"),
    [
        (("shoulder", "elbow"), ("elbow/effort",), [1]),
        (("q1", "q2", "q3"), ("tau_3", "tau_1"), [0, 2]),
        (("q1", "q2"), ("motor",), []),
        (("arm_angle", "slide_pos"), ("arm_torque",), [1]),
    ],
)
def test_inputs_drive_the_joints_that_they_name(q, u, driven, tmp_path):
    t = np.arange(300) * 0.01
    columns = {"t": t} | {name: 0.3 * np.sin((2 + k) * t) for k, name in enumerate(q)}
    columns |= {name: np.cos((5 + k) * t) for k, name in enumerate(u)}
    named = {"q": list(q)} | ({} if len(driven) == len(u) else {"u": list(u)})
    drafted = covariant.verbs.init(pandas.DataFrame(columns), columns=named)
    assert drafted.draft.driven == driven
    if not any(drafted.draft.lengths):
        file = drafted.save(tmp_path / "m.toml")
        actuated = re.search(r"actuated = \[(.*)\]", file.read_text())
        assert actuated is None or [int(each) for each in actuated[1].split(",")] == (driven or [0])
        assert models.load(str(file)).columns.u == drafted.draft.u
