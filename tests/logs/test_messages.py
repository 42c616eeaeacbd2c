"""Logs as messages of ROS: what other programs write is read, they read what is written, and memory stays bounded."""

import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from covariant import logs
from covariant.logs import Columns, LogError

STORE = get_typestore(Stores.ROS2_HUMBLE)
STATE, POSED = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
START = 1_700_000_000_123_456_789
SECONDS = np.array([0.0, 0.25, 0.5, 0.75])
MOTION = np.array([[0.1, 1.0], [0.2, 1.1], [0.3, 1.2], [0.4, 1.3]])
JOINTS = Columns(q=("shoulder", "elbow"))


def joint_state(stamp_ns: int, **numbers):
    """A JointState as the fields of a dictionary: names, position, velocity, effort."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    full = {"name": ["shoulder", "elbow"], "position": [], "velocity": [], "effort": []} | numbers
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}} | full


def bag(path: Path, *series, storage=StoragePlugin.SQLITE3) -> Path:
    """A rosbag2 of series (topic, [(received_ns, message)]) of joint states, or (topic, [...], kind) of others."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, messages, *others in series:
            (kind,) = others or (STATE,)
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for received, message in messages:
                made = made_joint_state(**message) if kind == STATE else message
                writer.write(connection, received, STORE.serialize_cdr(made, kind))
    return path


def made_header(stamp):
    return STORE.types["std_msgs/msg/Header"](STORE.types["builtin_interfaces/msg/Time"](**stamp), "")


def made_joint_state(header, name, **numbers):
    return STORE.types[STATE](made_header(header["stamp"]), name, *(np.array(each, float) for each in numbers.values()))


def moving(late: int = 0, **numbers):
    """Messages of MOTION, received so late [ns]."""
    for t, row in zip(SECONDS, MOTION, strict=True):
        stamp = START + round(t * 1e9)
        yield stamp + late, joint_state(stamp, position=list(row), **numbers)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_reads_a_rosbag(tmp_path, storage):
    path = bag(tmp_path / "bag", ("/joint_states", list(moving(late=7, effort=[3.0, -4.0]))), storage=storage)
    wanted = JOINTS._replace(u=("shoulder/effort", "/joint_states/elbow/effort"))
    (inside,) = (each for each in path.iterdir() if each.suffix != ".yaml")
    for place in (path, inside):
        log = logs.read(place, wanted)
        np.testing.assert_allclose(log.record.t, SECONDS, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(log.record.y, MOTION)
        np.testing.assert_array_equal(log.record.u, np.tile([3.0, -4.0], (4, 1)))
        assert log.origin_ns == START
    assert logs.read(path, JOINTS._replace(t="received")).origin_ns == START + 7
    assert list(logs.survey(path).columns) == ["t", "shoulder", "elbow", "shoulder/effort", "elbow/effort"]


def test_reads_an_mcap_file_that_another_library_wrote(tmp_path):
    definition = STORE.generate_msgdef(STATE, ros_version=2)[0]
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        schema = writer.register_msgdef(STATE, definition)
        for received, message in moving():
            writer.write_message("/arm", schema, message, log_time=received, publish_time=received)
        writer.finish()
    log = logs.read(tmp_path / "log.mcap", JOINTS)
    np.testing.assert_array_equal(log.record.y, MOTION)
    assert log.origin_ns == START


def test_another_library_reads_what_is_written(tmp_path):
    pose = dict(
        zip(["px", "py", "pz", "qw", "qx", "qy", "qz"], np.arange(7.0)[:, None] + np.zeros((7, 4)), strict=True)
    )
    columns = {"t": SECONDS, "arm/position": MOTION[:, 0], "arm/velocity": MOTION[:, 1], "other": SECONDS, **pose}
    logs.write(tmp_path / "log.mcap", columns, START)
    with (tmp_path / "log.mcap").open("rb") as file:
        found = [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    states = [decoded for topic, _, decoded in found if topic == "/joint_states"]
    assert [list(s.position) + list(s.velocity) for s in states] == MOTION.tolist()
    assert all(s.name == ["arm"] and not s.effort for s in states)
    assert [ns for topic, ns, _ in found if topic == "/pose"] == [START + round(t * 1e9) for t in SECONDS]
    poses = [decoded.pose for topic, _, decoded in found if topic == "/pose"]
    assert [(p.position.y, p.orientation.w, p.orientation.z) for p in poses] == [(1.0, 3.0, 6.0)] * 4
    assert [list(decoded.position) for topic, _, decoded in found if topic == "/values"] == SECONDS[:, None].tolist()
    logs.write(tmp_path / "log.rosbag2", columns)
    with Reader(tmp_path / "log.rosbag2") as reader:
        assert sorted(reader.topics) == ["/joint_states", "/pose", "/values"]
        assert reader.message_count == 12
    for name in ("log.mcap", "log.rosbag2"):
        back = logs.read(tmp_path / name, Columns(q=("arm",), v=("arm/velocity",), position=("px", "py", "pz")[:0]))
        np.testing.assert_array_equal(back.v[:, 0], MOTION[:, 1])
        np.testing.assert_allclose(back.record.t, SECONDS, rtol=0, atol=1e-12)


def test_several_topics_are_one_log(tmp_path):
    """The rows are those of the positions; inputs hold between messages, and what is read more seldom is missing."""
    early, late = (START + round(s * 1e9) for s in (-0.1, 0.6))
    commands = [(ns, joint_state(ns, name=["drive"], effort=[u])) for ns, u in ((early, 5.0), (late, 6.0))]
    slow = [(ns, m | {"name": ["slow"], "position": [9.0 + k]}) for k, (ns, m) in enumerate(list(moving())[::2])]
    path = bag(tmp_path / "bag", ("/fast", list(moving())), ("/slow", slow), ("/commands", commands))
    record = logs.read(path, Columns(q=("shoulder", "slow"), u=("drive/effort",))).record
    np.testing.assert_array_equal(record.y[:, 0], MOTION[:, 0])
    np.testing.assert_array_equal(record.y[:, 1], [9.0, np.nan, 10.0, np.nan])
    np.testing.assert_array_equal(record.u[:, 0], [5.0, 5.0, 5.0, 6.0])


@pytest.mark.parametrize(
    ("series", "columns", "words"),
    [
        ([("/a", [(1, joint_state(1, position=[1.0]))])], JOINTS, "names 2 joints and has 1 numbers of position"),
        ([("/a", [(1, joint_state(1))])], JOINTS, "its messages hold no joint and no pose"),
        (
            [("/a", [(k, joint_state(0, position=[1, 2])) for k in (1, 2)])],
            JOINTS,
            "stamp 0; name the column 'received'",
        ),
        (
            [("/a", [(k, joint_state(5, position=[1, 2])) for k in (1, 2)])],
            JOINTS,
            "messages 1 and 2 of /a have the same",
        ),
        ([("/a", list(moving())), ("/b", list(moving()))], JOINTS, "There are: t, /a/shoulder/position, /a/elbow"),
        ([("/a", list(moving()))], Columns(q=("wrist",)), "There are: t, shoulder, elbow"),
        ([("/a", list(moving()))], JOINTS._replace(units={"t": ("ms",)}), "holds duration[ns], which need no unit"),
    ],
)
def test_what_is_wrong_with_messages_is_said(tmp_path, series, columns, words):
    with pytest.raises(LogError) as caught:
        logs.read(bag(tmp_path / "bag", *series), columns)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_and_foreign_files_get_one_line(tmp_path):
    whole = bag(tmp_path / "bag", ("/a", list(moving())), storage=StoragePlugin.MCAP) / "bag.mcap"
    for name, content in (("cut.mcap", whole.read_bytes()[:400]), ("other.mcap", b"t,q\n0,1\n"), ("empty.db3", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match="cannot be read as a rosbag: ") as caught:
            logs.read(tmp_path / name, JOINTS)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match="no such file"):
        logs.read(tmp_path / "absent.mcap", JOINTS)


def test_nothing_is_replaced_or_left_where_writing_fails(tmp_path, monkeypatch):
    def full(*_):
        raise sqlite3.OperationalError("database or disk is full")

    logs.write(tmp_path / "log.mcap", {"t": SECONDS, "q": SECONDS})
    before = (tmp_path / "log.mcap").read_bytes()
    with pytest.raises(LogError, match="ROS counts seconds from 0"):
        logs.write(tmp_path / "log.mcap", {"t": SECONDS - 1, "q": SECONDS})
    logs.write(tmp_path / "log.rosbag2", {"t": SECONDS, "q": SECONDS})
    with pytest.raises(LogError, match="there is such a folder already"):
        logs.write(tmp_path / "log.rosbag2", {"t": SECONDS, "q": SECONDS})
    monkeypatch.setattr(Writer, "write", full)
    with pytest.raises(LogError, match=r"b\.rosbag2: cannot be written: database or disk is full"):
        logs.write(tmp_path / "b.rosbag2", {"t": SECONDS, "q": SECONDS})
    assert (tmp_path / "log.mcap").read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["log.mcap", "log.rosbag2"]


def test_says_how_to_install_rosbags(tmp_path, monkeypatch):
    logs.write(tmp_path / "log.mcap", {"t": SECONDS, "q": SECONDS})
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    for use in (
        lambda: logs.read(tmp_path / "log.mcap", JOINTS),
        lambda: logs.write(tmp_path / "x.mcap", {"t": SECONDS}),
    ):
        with pytest.raises(ImportError, match=r"pip install 'covariant\[ros\]'"):
            use()


def with_imu(path: Path, t: np.ndarray, q: np.ndarray, t_imu: np.ndarray, spin: np.ndarray) -> Path:
    """A rosbag2 of a joint and of an Imu whose stamps are others."""
    types, imu = STORE.types, "sensor_msgs/msg/Imu"
    vector = types["geometry_msgs/msg/Vector3"]
    level, push = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), vector(0.0, 0.0, 9.81)
    unknown = np.zeros(9)
    joints, turns = [], []
    for stamp, angle in zip(t, q, strict=True):
        ns = START + round(stamp * 1e9)
        joints.append((ns, joint_state(ns, name=["arm"], position=[angle], effort=[0.0])))
    for stamp, rate in zip(t_imu, spin, strict=True):
        ns = START + round(stamp * 1e9)
        head = made_header(joint_state(ns)["header"]["stamp"])
        turns.append((ns, types[imu](head, level, unknown, vector(0.0, rate, 0.0), unknown, push, unknown)))
    return bag(path, ("/joint_states", joints), ("/imu", turns, imu), storage=StoragePlugin.MCAP)


def test_stamps_of_a_sensor_beside_the_positions_are_rows_too(tmp_path):
    t, fast = np.array([0.0, 0.1, 0.2, 0.3]), np.array([-0.05, 0.0, 0.04, 0.08, 0.12, 0.2, 0.25])
    path = with_imu(tmp_path / "bag", t, 2.0 * t, fast, 3.0 + fast)
    columns, rate = Columns(q=("arm",)), Columns(q=("/imu/wy",))
    log = logs.read(path, columns, sensors=[(rate, "rad/s"), (Columns(q=("/gyro/wy",)), "rad/s")])
    rows = np.array([0.0, 0.04, 0.08, 0.1, 0.12, 0.2, 0.25, 0.3])
    np.testing.assert_allclose(log.record.t, rows, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.record.y[:, 0], [0.0, np.nan, np.nan, 0.2, np.nan, 0.4, np.nan, 2.0 * t[3]])
    read, none = log.readings
    np.testing.assert_allclose(read[:, 0], [3.0, 3.04, 3.08, np.nan, 3.12, 3.2, 3.25, np.nan], rtol=1e-15)
    part = logs.read(path, columns, start=0.09, until=0.22, sensors=[(rate, "rad/s")])
    np.testing.assert_allclose(part.readings[0][:, 0], [np.nan, 3.12, 3.2], rtol=1e-15)
    assert len(logs.read(path, columns).record.t) == 4, "without sensors they are no rows"
    assert none is None
    assert {"wx", "wy", "wz", "ax", "ay", "az"} < set(logs.survey(path).columns)


def test_flipped_bits_are_found(tmp_path):
    """Of a file of this library, and of one that another one wrote with its checksums of data."""
    path = tmp_path / "log.mcap"
    logs.write(path, {"t": SECONDS, "arm/position": np.sin(SECONDS)}, START)
    columns = Columns(q=("arm",))
    whole, before = path.read_bytes(), logs.read(path, columns).record
    for bit in np.random.default_rng(0).integers(0, 8 * len(whole), 60):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(content)
        try:
            after = logs.read(path, columns).record
        except logs.LogError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            np.testing.assert_array_equal(after.y, before.y)
            np.testing.assert_array_equal(after.t, before.t)
    middle = bytearray(whole)
    middle[len(whole) // 3] ^= 4
    path.write_bytes(middle)
    with pytest.raises(logs.LogError, match=r"log.mcap: .*does not fit its checksum: the file is damaged"):
        logs.read(path, columns)
    with path.open("wb") as file:
        file.write(whole)
    with path.open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == len(SECONDS)
