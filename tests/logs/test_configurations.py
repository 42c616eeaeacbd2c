"""Attitudes and poses in logs: every way to write one gives the same matrices, and what is none is named."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from covariant import logs
from covariant.logs import Columns, LogError

WXYZ, XYZW = ("qw", "qx", "qy", "qz"), ("qx", "qy", "qz", "qw")
MATRIX = tuple(f"r{i}{j}" for i in "123" for j in "123")
POSITION = ("px", "py", "pz")
T = np.arange(8.0)
TURNS = Rotation.from_quat(np.random.default_rng(3).normal(size=(8, 4)))
PLACES = np.random.default_rng(4).normal(size=(8, 3))
CELLS = dict(zip(XYZW, TURNS.as_quat().T, strict=True)) | dict(zip(POSITION, PLACES.T, strict=True))
CELLS |= dict(zip(MATRIX, TURNS.as_matrix().reshape(-1, 9).T, strict=True)) | {"heading": 2 * T, "wheel": 9 * T}
LAYOUTS = {
    "wxyz": Columns(quaternion_wxyz=WXYZ),
    "xyzw": Columns(quaternion_xyzw=XYZW),
    "matrix": Columns(matrix=MATRIX),
    "pose": Columns(position=POSITION, quaternion_xyzw=XYZW),
    "pose by matrix": Columns(matrix=MATRIX, position=POSITION),
    "plane": Columns(position=("px", "py"), angle=("heading",)),
    "wheels": Columns(quaternion_wxyz=WXYZ, angle=("heading", "wheel")),
}


@pytest.fixture
def read(tmp_path):
    """Read a log of these cells, or the others that replace some."""

    def read(columns: Columns, **others):
        logs.write(tmp_path / "log.csv", {"t": T} | CELLS | others)
        return logs.read(tmp_path / "log.csv", columns).record.y

    return read


@pytest.mark.parametrize("layout", ["wxyz", "xyzw", "matrix"])
def test_every_way_to_write_an_attitude_gives_its_matrix(read, layout):
    np.testing.assert_allclose(read(LAYOUTS[layout]), TURNS.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("layout", ["pose", "pose by matrix"])
def test_a_pose_has_the_attitude_and_the_position(read, layout):
    y = read(LAYOUTS[layout])
    np.testing.assert_allclose(y[:, :3, :3], TURNS.as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(y[:, :3, 3], PLACES)
    np.testing.assert_array_equal(y[:, 3], np.tile([0, 0, 0, 1], (8, 1)))


def test_angles_are_turns_of_the_plane(read):
    y = read(LAYOUTS["plane"])
    np.testing.assert_allclose(y[:, 1, 0], np.sin(2 * T), atol=1e-15)
    np.testing.assert_array_equal(y[:, :2, 2], PLACES[:, :2])
    y = read(LAYOUTS["wheels"])
    assert y.shape == (8, 7, 7)
    np.testing.assert_allclose(y[:, 5:, 5:][:, 1, 0], np.sin(9 * T), atol=1e-14)
    assert not y[:, :3, 3:].any()
    assert not y[:, 3:5, 5:].any()


def test_attitudes_after_the_first_are_matrices_of_their_own(read):
    """A pose, a ball joint and a coordinate: each missing by itself."""
    second = Rotation.from_quat(np.random.default_rng(5).normal(size=(8, 4)))
    names = ("bw", "bx", "by", "bz")
    cells = dict(zip(names[1:] + names[:1], second.as_quat().T, strict=True))
    cells["by"] = np.where(T == 3, np.nan, cells["by"])
    columns = Columns(q=("wheel",), position=POSITION, quaternion_wxyz=WXYZ + names)
    y = read(columns, **cells)
    assert y.shape == (8, 16 + 9 + 1)
    pose, ball = logs.matrices(columns, y)
    np.testing.assert_allclose(pose[:, :3, :3], TURNS.as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(pose[:, :3, 3], PLACES)
    np.testing.assert_allclose(ball, np.where((T == 3)[:, None, None], np.nan, second.as_matrix()), atol=1e-14)
    np.testing.assert_array_equal(logs.coordinates(columns, y)[:, 0], CELLS["wheel"])
    again = logs.to_columns(columns, y)
    assert list(again) == list(columns.measured)
    sign = again["bx"] / cells["bx"]
    np.testing.assert_allclose(again["by"], sign * cells["by"], atol=1e-14)
    with pytest.raises(LogError, match=r"quaternion_wxyz .* make no pose"):
        read(columns._replace(quaternion_wxyz=(*WXYZ, "bw")))


def test_the_sign_and_a_small_error_of_length_of_a_quaternion_do_not_matter(read):
    sign = np.where(T % 2, -1.01, 0.99)
    np.testing.assert_allclose(
        read(LAYOUTS["wxyz"], **{name: CELLS[name] * sign for name in WXYZ}), read(LAYOUTS["wxyz"]), atol=1e-14
    )


def test_a_printed_matrix_becomes_the_nearest_rotation(read):
    y = read(LAYOUTS["matrix"], **{name: np.round(CELLS[name], 2) for name in MATRIX})
    np.testing.assert_allclose(np.einsum("kji,kjl->kil", y, y), np.tile(np.eye(3), (8, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(y, TURNS.as_matrix(), atol=0.01)


@pytest.mark.parametrize("name", ["qw", "py"])
def test_one_missing_cell_makes_the_row_missing(read, name):
    y = read(LAYOUTS["pose"], **{name: np.where(T == 3, np.nan, CELLS[name])})
    assert np.isnan(y[3]).all()
    assert np.isfinite(np.delete(y, 3, axis=0)).all()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_columns_come_back_in_the_same_layout(read, layout):
    columns = LAYOUTS[layout]
    y = read(columns)
    y[2] = np.nan
    written = logs.to_columns(columns, y)
    assert tuple(written) == columns.measured
    assert all(np.isnan(column[2]) for column in written.values())
    np.testing.assert_allclose(np.delete(read(columns, **written), 2, 0), np.delete(y, 2, 0), atol=1e-14)


def test_written_quaternions_and_angles_do_not_jump():
    t = np.linspace(0, 20, 400)
    turns = Rotation.from_rotvec(np.outer(t, [0.6, 0, 0.8])).as_matrix()
    q = np.stack(list(logs.to_columns(LAYOUTS["wxyz"], turns).values()), axis=1)
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    np.testing.assert_allclose(q[:, 0], np.cos(t / 2), atol=1e-14)
    plane = np.moveaxis(np.array(((np.cos(t), -np.sin(t)), (np.sin(t), np.cos(t)))), 2, 0)
    np.testing.assert_allclose(logs.to_columns(Columns(angle=("a",)), plane)["a"], t, atol=1e-12)


@pytest.mark.parametrize(
    ("layout", "change", "words"),
    [
        ("wxyz", lambda name: 1.2, "columns 'qw', 'qx', 'qy', 'qz', row 5: the quaternion has length 1.2, needs 1"),
        ("pose", lambda name: 0.0, "columns 'qx', 'qy', 'qz', 'qw', row 5: the quaternion has length 0, needs 1; norm"),
        ("matrix", lambda name: 1.2, "row 5: the matrix is not orthogonal, it stretches 1.2 times; check the order"),
        ("matrix", lambda name: -1.0, "row 5: the matrix is a reflection, its determinant is -1: swap or negate one"),
    ],
)
def test_names_the_row_of_what_is_no_rotation(tmp_path, read, layout, change, words):
    rotation = set(LAYOUTS[layout].measured) - set(POSITION)
    with pytest.raises(LogError) as caught:
        read(LAYOUTS[layout], **{name: CELLS[name] * np.where(T == 4, change(name), 1.0) for name in rotation})
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'log.csv'}: columns ")
    assert words in message
    assert message.endswith("or leave the row empty if its measurement is missing")


def test_rows_are_counted_as_in_the_file_past_missing_ones(read):
    broken = {name: CELLS[name] * np.where(T == 4, 2.0, 1.0) for name in WXYZ}
    broken["qw"] = np.where(T == 1, np.nan, broken["qw"])
    with pytest.raises(LogError, match="row 5: the quaternion has length 2"):
        read(LAYOUTS["wxyz"], **broken)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (Columns(quaternion_wxyz=WXYZ, matrix=MATRIX), "quaternion_wxyz and matrix both give the attitude; keep one"),
        (Columns(position=POSITION), "position (px, py, pz) and angle (none) make no pose"),
        (Columns(position=("px", "py"), matrix=MATRIX), "make no pose; three names go with a quaternion of 4"),
        (Columns(quaternion_wxyz=WXYZ[:3]), "and quaternion_wxyz (qw, qx, qy) make no pose"),
        (Columns(position=("px",), angle=("heading",)), "make no pose"),
    ],
)
def test_names_columns_that_make_no_configuration(tmp_path, read, columns, words):
    with pytest.raises(LogError) as caught:
        read(columns)
    assert str(caught.value).startswith(f"{tmp_path / 'log.csv'}: ")
    assert words in str(caught.value)
