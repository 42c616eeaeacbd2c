"""Columns that hold lists, as data sets of robots are written: a column for each entry; and several episodes."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covariant import logs
from covariant.logs import Columns, LogError

pandas = pytest.importorskip("pandas")

T = np.arange(6) / 30
STATE = np.column_stack([np.sin(T), np.cos(T)])
NAMES = ["shoulder_pan.pos", "gripper.pos"]


def table(kind=None, episodes=None, **more):
    """A table as LeRobot writes it: float32 lists and stamps, whole numbers beside."""
    kind = pa.list_(pa.float32(), 2) if kind is None else kind
    episodes = [0] * len(T) if episodes is None else episodes
    starts = [episodes.index(each) for each in episodes]
    return pa.table(
        {
            "observation.state": pa.array(STATE.tolist(), kind),
            "action": pa.array((STATE + 1).tolist(), kind),
            "timestamp": pa.array([T[k - first] for k, first in enumerate(starts)], pa.float32()),
            "episode_index": episodes,
            "index": list(range(len(T))),
            **more,
        }
    )


def written(path, log):
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(log, path)
    return path


KINDS = {
    "fixed": pa.list_(pa.float32(), 2),
    "of any length": pa.list_(pa.float32()),
    "large": pa.large_list(pa.float64()),
    "whole numbers": pa.list_(pa.int64(), 2),
}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("form", ["file", "arrow", "pandas"])
def test_an_entry_of_a_list_is_a_column(tmp_path, kind, form):
    log = (
        table(kind)
        if not pa.types.is_integer(kind.value_type)
        else table().set_column(0, "observation.state", pa.array([[1, 2]] * len(T), kind))
    )
    log = {"file": lambda: written(tmp_path / "a.parquet", log), "arrow": lambda: log, "pandas": log.to_pandas}[form]()
    whole = pa.types.is_integer(kind.value_type)
    record = logs.record(log, "timestamp", ["observation.state[1]", "observation.state[0]"], "action[1]")
    np.testing.assert_allclose(record.y, [[2, 1]] * len(T) if whole else STATE[:, ::-1], atol=1e-7)
    np.testing.assert_allclose(record.u[:, 0], STATE[:, 1] + 1, atol=1e-6)
    assert list(logs.survey(log).columns)[:2] == ["observation.state[0]", "observation.state[1]"]


def test_polars_has_them_too():
    polars = pytest.importorskip("polars")
    record = logs.record(polars.from_arrow(table()), "timestamp", "action[0]")
    np.testing.assert_allclose(record.y[:, 0], STATE[:, 0] + 1, atol=1e-6)


def test_an_empty_list_or_entry_is_a_missing_measurement():
    cells = [[0.1, 0.2], None, [0.3, None], [0.4, 0.5], [0.6, 0.7], [0.8, 0.9]]
    log = table().set_column(0, "observation.state", pa.array(cells, pa.list_(pa.float32())))
    y = logs.record(log, "timestamp", ["observation.state[0]", "observation.state[1]"]).y
    assert np.isnan(y).tolist() == [[False] * 2, [True] * 2, [False, True], *[[False] * 2] * 3]


def test_lists_of_other_lengths_texts_and_pictures_are_no_columns():
    log = table(
        boxes=pa.array([[1.0], [1.0, 2.0], [], [3.0], [4.0], [5.0]]),
        words=pa.array([["a", "b"]] * len(T)),
        picture=pa.array([[0.0] * 300] * len(T)),
        plain=[0.0] * len(T),
    )
    there = list(logs.survey(log).columns)
    assert "plain" in there
    assert not [name for name in there if name.startswith(("boxes", "words", "picture"))]
    with pytest.raises(LogError, match="'boxes' holds list<"):
        logs.record(log, "timestamp", "boxes")
    with pytest.raises(LogError, match=re.escape("no column 'observation.state'. Did you mean 'observation.state[")):
        logs.record(log, "timestamp", "observation.state")


def test_a_column_that_has_the_name_of_an_entry_counts():
    log = table(**{"action[0]": np.arange(6.0)})
    assert logs.record(log, "timestamp", "action[0]").y[:, 0].tolist() == list(range(6))
    assert logs.record(log, "timestamp", "action[1]").y[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("places", ["data/chunk-000/file-000.parquet", "data/episode.parquet"])
@pytest.mark.parametrize("names", [NAMES, {"motors": NAMES}])
def test_names_of_entries_are_read_beside_the_data(tmp_path, places, names):
    path = written(tmp_path / places, table())
    info = {"features": {"observation.state": {"names": names}, "action": {"names": None}}}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    expected = {f"observation.state[{k}]": name for k, name in enumerate(NAMES)}
    assert dict(logs.survey(path).labels) == expected


@pytest.mark.parametrize("text", ["", "[]", "7", '{"features": []}', '{"features": {"action": 3}}', '{"fps": 30}'])
def test_a_broken_description_beside_the_data_is_no_fault_of_the_log(tmp_path, text):
    path = written(tmp_path / "data" / "a.parquet", table())
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(text)
    assert dict(logs.survey(path).labels) == {}


def test_a_unit_of_a_list_is_that_of_its_entries():
    schema = table().schema
    log = table().cast(schema.set(0, schema.field(0).with_metadata({"unit": "deg"})))
    columns = Columns("timestamp", ("observation.state[0]",))
    with pytest.raises(LogError, match=re.escape('write q = "deg" under [units]')):
        logs.read(log, columns)
    y = logs.read(log, columns._replace(units={"q": ("deg",)})).record.y
    np.testing.assert_allclose(y[:, 0], np.radians(STATE[:, 0]), atol=1e-7)


def test_episodes_of_one_file_are_named_with_their_rows(tmp_path):
    path = written(tmp_path / "a.parquet", table(episodes=[4, 4, 5, 5, 5, 9]))
    with pytest.raises(
        logs.ClockError,
        match=re.escape(
            "column 'timestamp' starts again at row 3: by episode_index, 4 is rows 1 to 2, 5 is rows 3 to 5, 9 is rows "
            "6 to 6; the name of a file with #5 after it is one of them, and in pandas "
            "frame[frame['episode_index'] == 5]"
        ),
    ):
        logs.record(path, "timestamp", "action[0]")
    frame = pandas.read_parquet(path)
    selected = logs.record(frame[frame["episode_index"] == 5], "timestamp", "action[0]")
    assert len(selected.t) == 3
    np.testing.assert_array_equal(logs.record(f"{path}#5", "timestamp", "action[0]").y, selected.y)


def test_stamps_that_go_back_within_an_episode_are_no_new_one():
    log = table(episodes=[0, 0, 0, 1, 1, 1])
    log = log.set_column(2, "timestamp", pa.array([0.0, 0.2, 0.1, 0.0, 0.1, 0.2]))
    with pytest.raises(logs.ClockError, match="row 3: time goes back"):
        logs.record(log, "timestamp", "action[0]")


def sign_magnitude(numbers):
    return np.where(numbers < 0, (1 << 15) - numbers, numbers)


SWING = np.round(300 * np.sin(np.arange(400) / 20))
WORDS = {
    "a swing about zero": sign_magnitude(SWING),
    "a faster one": sign_magnitude(np.round(4000 * np.sin(np.arange(100) / 5))),
    "behind a factor": 0.01 * sign_magnitude(SWING),
    "with gaps": np.where(np.arange(400) % 7 == 3, np.nan, sign_magnitude(SWING)),
}
PLAIN = {
    "a counter": np.arange(32_000.0, 33_500.0, 7),
    "one that begins anew": np.arange(64_000, 70_000, 31) % 65_536.0,
    "signed": SWING,
    "half a step": np.where(np.arange(400) < 200, 3.0, 32_768.5),
    "a large encoder": 40_000 + SWING,
}


@pytest.mark.parametrize("cells", WORDS.values(), ids=WORDS)
@pytest.mark.parametrize("field", ["q", "u"])
def test_a_word_with_a_sign_bit_is_refused_with_its_decoding(cells, field):
    if field == "u":
        cells = cells[np.isfinite(cells)]
    log = pandas.DataFrame({"t": 0.01 * np.arange(len(cells)), "x": cells, "y": 0.0})
    columns = Columns(q=("x",)) if field == "q" else Columns(q=("y",), u=("x",))
    bit = 327.68 if np.nanmax(cells) < 1000 else 32768
    with pytest.raises(LogError, match=re.escape(f"numpy.where(x >= {bit}, {bit} - x, x)")):
        logs.read(log, columns)
    log["x"] = np.where(log["x"] >= bit, bit - log["x"], log["x"])
    logs.read(log, columns)


@pytest.mark.parametrize("cells", PLAIN.values(), ids=PLAIN)
def test_other_whole_numbers_are_no_such_words(cells):
    assert not logs.Register.of(cells).negative
    logs.record(pandas.DataFrame({"t": 0.01 * np.arange(len(cells)), "x": cells}), q="x")
