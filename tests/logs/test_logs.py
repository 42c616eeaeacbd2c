"""Reading and writing logs: what is written is read back, and everything wrong is named in one line."""

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, strategies as st

from covariant import logs
from covariant.logs import Columns, LogError

ONE = Columns(q=("q",))
FULL = Columns("t", ("q1", "q2"), ("tau",), ("w1", "w2"), ("v1", "v2"))


def csv(folder: Path, text: str) -> Path:
    path = folder / "log.csv"
    path.write_text(text, encoding="utf-8")
    return path


def fault(path: Path, columns: Columns = ONE, **options) -> str:
    """The message of the one error that reading raises: one line that begins with the file."""
    with pytest.raises(LogError) as caught:
        logs.read(path, columns, **options)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message.removeprefix(str(path))


def test_reads_what_the_columns_name(tmp_path):
    header = "note,q2,q1,t,tau,w1,w2,v1,v2\n"
    log = logs.read(csv(tmp_path, header + "a,2,1,0,3,4,5,6,7\nb,nan,,0.5,-3,,5,6,7\n"), FULL)
    np.testing.assert_array_equal(log.record.t, [0, 0.5])
    np.testing.assert_array_equal(log.record.y, [[1, 2], [np.nan, np.nan]])
    np.testing.assert_array_equal(log.record.u, [[3], [-3]])
    np.testing.assert_array_equal(log.v, [[4, 5], [np.nan, 5]])
    np.testing.assert_array_equal(log.truth, [[6, 7], [6, 7]])
    assert log.record.x is None


def test_a_log_may_lack_inputs_and_velocities(tmp_path):
    log = logs.read(csv(tmp_path, "t,q\n0,1\n1,2\n"), ONE)
    assert log.record.u.shape == (2, 0)
    assert log.v is None
    assert log.truth is None


def test_reads_integers_text_and_nulls_from_parquet(tmp_path):
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({"t": [0, 1, 2], "q": [1.5, None, 2.5], "u.1": ["1", " 2", "3e0"]}), path)
    log = logs.read(path, Columns(q=("q",), u=("u.1",)))
    np.testing.assert_array_equal(log.record.t, [0, 1, 2])
    np.testing.assert_array_equal(log.record.y[:, 0], [1.5, np.nan, 2.5])
    np.testing.assert_array_equal(log.record.u[:, 0], [1, 2, 3])


def test_every_and_until_keep_some_rows(tmp_path):
    rows = "".join(f"{k / 8},{k},{-k}\n" for k in range(9))
    log = logs.read(csv(tmp_path, "t,q,v\n" + rows), Columns(q=("q",), v=("v",)), every=3, until=0.75)
    np.testing.assert_array_equal(log.record.y[:, 0], [0, 3, 6])
    np.testing.assert_array_equal(log.v, [[0], [-3], [-6]])
    assert "every=1, until=0.1 keep 1 of 9 rows" in fault(tmp_path / "log.csv", until=0.1)
    assert "every must be 1 or more rows; got 0" in fault(tmp_path / "log.csv", every=0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,q\n", "a header and no rows"),
        ("t,q", "a header and no rows"),
        ("t,q\n0,1\n", "needs at least two rows; this one has 1"),
        ("t,angle\n0,1\n", "no column 'q'. There are: t, angle"),
        ("t,q_\n0,1\n", "no column 'q'. Did you mean 'q_'? There are: t, q_"),
        ("t,q,q\n0,1,2\n", "2 columns are named 'q' and differ, first in row 1: '1' and '2'; rename all but one"),
        ("t,q\n0,1\n1,fast\n", "column 'q', row 2: found 'fast', needs a finite number; leave it empty"),
        ("t,q\n0,1\nnoon,1\n", "column 't', row 2: found 'noon', needs a finite number; only positions may be missing"),
        ("t,q\n0,1\n1,2\n,3\n", "column 't', row 3: found an empty cell"),
        ("t,q\n0,1\n , 3\n", "column 't', row 2: found an empty cell"),
        ("t,q\n0,1\nnan,3\n", "column 't', row 2: found 'nan'"),
        ("t,q\n0,1\n1,inf\n", "column 'q', row 2: found 'inf', needs a finite number"),
        ("t,q\n0,1\n1,1_0\n", "column 'q', row 2: found '1_0', needs a finite number"),
        ("t,q\n0,1\n1, 0x10\n", "column 'q', row 2: found ' 0x10', needs a finite number"),
        ("t,q\n0,1\n1,١٢\n", "column 'q', row 2: found '١٢', needs a finite number"),
        ("t,q\n0,1\n１２,1\n", "column 't', row 2: found '１２', needs a finite number"),
        ("t,q\n 0, 1\n 1, +1e2\n 2, 1e\n", "column 'q', row 3: found ' 1e', needs a finite number"),
        ("t,q\n0,1\n1, +inf\n", "column 'q', row 2: found ' +inf', needs a finite number"),
        ("t,q\n0,1\n1,2\n2\n", "row 3 has 1 cells where the header has 2: '2'"),
        ("t,q\n0,1\n1,2,3\n", "row 2 has 3 cells where the header has 2: '1,2,3'"),
        ("t,q\n0,1\n2,1\n1,1\n", "row 3: time goes back from 2 s to 1 s"),
        ("t,q\n0,1\n1,1\n1,1\n", "rows 2 and 3 have the same stamp 1 s"),
        ("t,q\n0,\n1,1\n", "row 1 lacks a measurement"),
    ],
)
def test_names_what_is_wrong(tmp_path, text, words):
    assert words in fault(csv(tmp_path, text))


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=5))
def test_every_way_to_write_a_number_reads_as_python_does(tmp_path_factory, values):
    forms = [form for v in values for form in (repr(v), f" {v:e} ", f"{v:+.3f}", f"{v:E}")]
    text = "t,q\n" + "".join(f"{k},{form}\n" for k, form in enumerate(forms))
    y = logs.read(csv(tmp_path_factory.mktemp("forms"), text), ONE).record.y[:, 0]
    np.testing.assert_array_equal(y, [float(form) for form in forms])


def test_an_input_may_not_be_missing(tmp_path):
    path = csv(tmp_path, "t,q,tau\n0,1,1\n1,1,\n")
    assert "column 'tau', row 2: found an empty cell" in fault(path, Columns(q=("q",), u=("tau",)))


def test_rows_are_counted_as_in_the_file_whatever_is_kept(tmp_path):
    rows = "".join(f"{k},0\n" for k in (0, 1, 2, 3, 4, 5, 5))
    assert "rows 6 and 7 have the same stamp" in fault(csv(tmp_path, "t,q\n" + rows), every=5)


def test_names_what_is_wrong_in_parquet(tmp_path):
    path = tmp_path / "log.parquet"
    stamps = pa.array([0, 1], pa.timestamp("ms"))
    pq.write_table(pa.table({"t": [0.0, 1.0], "q": ["1", "x"], "when": stamps, "u": [0.0, None]}), path)
    assert "column 'q', row 2: found 'x'" in fault(path)
    assert "no column 'p'. There are: t, q, when, u" in fault(path, Columns(q=("p",)))
    assert "column 'when' holds timestamp[ms]; convert it" in fault(path, Columns(q=("when",)))
    assert "column 'u', row 2: found an empty cell" in fault(path, Columns(q=("t",), u=("u",)))
    path.write_text("t,q\n0,1\n")
    assert "cannot be read as .parquet" in fault(path)


def test_refuses_what_is_not_a_log(tmp_path):
    assert ".mcap file, or the folder of a rosbag2; this one ends in .mat" in fault(tmp_path / "log.mat")
    assert "this one ends in nothing" in fault(tmp_path / "log")
    assert "no position column was named" in fault(tmp_path / "log.csv", Columns())
    with pytest.raises(FileNotFoundError, match=r"log\.csv: no such file"):
        logs.read(tmp_path / "log.csv", ONE)
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder; give the path of a log" in fault(tmp_path / "folder.csv")


def test_says_how_to_install_pyarrow(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[logs\]'"):
        logs.read(csv(tmp_path, "t,q\n0,1\n1,2\n"), ONE)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[logs\]'"):
        logs.write(tmp_path / "out.csv", {"t": np.zeros(2)})


def test_writes_plain_csv(tmp_path):
    logs.write(
        tmp_path / "out.csv", {"t": np.array([0.0, 0.1]), "code": np.array([0, 3]), "v": np.array([np.nan, 1 / 3])}
    )
    assert (tmp_path / "out.csv").read_text() == "t,code,v\n0,0,nan\n0.1,3,0.3333333333333333\n"


@pytest.mark.parametrize(
    ("name", "columns", "words"),
    [
        (
            "out.mat",
            {"t": np.zeros(2)},
            "must end in .csv, .txt, .tsv, .parquet, .mcap, .rosbag2; this one ends in .mat",
        ),
        ("nowhere/out.csv", {"t": np.zeros(2)}, "nowhere; make it first"),
        ("out.csv", {}, "there are no columns to write"),
        ("out.csv", {"q": np.zeros((2, 1))}, "column 'q' must be one row of numbers (T,); got float64 of shape (2, 1)"),
        ("out.csv", {"q": np.array(["a"])}, "column 'q' must be one row of numbers"),
        ("out.csv", {"t": np.zeros(2), "q": np.zeros(3)}, "column 'q' has 3 rows where 't' has 2"),
        ("folder.csv", {"t": np.zeros(2)}, "cannot be written"),
    ],
)
def test_writes_nothing_that_cannot_be_read(tmp_path, name, columns, words):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(LogError) as caught:
        logs.write(tmp_path / name, columns)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert [path.name for path in tmp_path.iterdir()] == ["folder.csv"]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, ending):
    path = tmp_path / f"out.{ending}"
    logs.write(path, {"t": np.arange(3)})
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(LogError, match=rf"out\.{ending}: cannot be written: No space left on device"):
        logs.write(path, {"t": np.arange(5)})
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_what_was_read_may_be_changed(tmp_path):
    (tmp_path / "log.csv").write_text("t,q1\n0,1\n1,2\n2,3\n")
    record = logs.read(tmp_path / "log.csv", logs.Columns(q=("q1",))).record
    for array in record[:3]:
        array += 1
    assert np.asarray(record.t).tolist() == [1, 2, 3]
