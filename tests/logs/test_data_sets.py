"""Folders of recorded episodes, and several episodes in one file: which logs there are, and what each of them holds."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from covariant import logs
from covariant.logs import Columns, LogError

ROWS = 12
LISTS = Columns(t="timestamp", q=("observation.state[0]", "observation.state[1]"), u=("action[0]", "action[1]"))
PLAIN = Columns(t="t", q=("q",))


def motion(number, size=1.0, rows=ROWS):
    """Stamps, commands and positions (T, 2) of an episode, which no other episode has."""
    t = np.arange(rows) / 50
    u = size * np.stack([np.sin(3 * t + number), np.cos(5 * t + number)], axis=1)
    return t, u, u - 0.1 - number


def table(number, *, size=1.0, rows=ROWS, **changed):
    """The rows of an episode as LeRobot writes them; None leaves a column out."""
    t, u, q = motion(number, size, rows)
    kind = pa.list_(pa.float32(), 2)
    columns = {
        "action": pa.array(u.tolist(), kind),
        "observation.state": pa.array(q.tolist(), kind),
        "timestamp": pa.array(t, pa.float32()),
        "episode_index": pa.array(np.full(rows, number)),
    } | changed
    return pa.table({name: column for name, column in columns.items() if column is not None})


def data_set(folder, files, names=("pan.pos", "lift.pos"), **info):
    """Write the files of a data set, each a list of tables, one row group each, and its description."""
    for name, tables in files.items():
        path = folder / "data" / "chunk-000" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, tables[0].schema) as writer:
            for each in tables:
                writer.write_table(each)
    (folder / "meta").mkdir()
    features = {name: {"dtype": "float32", "names": list(names)} for name in ("action", "observation.state")}
    (folder / "meta" / "info.json").write_text(json.dumps({"features": features} | info))
    return folder


def csv(path, numbers, delimiter=",", name="episode"):
    """Write a text with a row for each number of an episode; positions count the rows."""
    t = [0.1 * numbers[:k].count(number) for k, number in enumerate(numbers)]
    rows = [f"{a:g}{delimiter}{k}{delimiter}{number}" for k, (a, number) in enumerate(zip(t, numbers, strict=True))]
    path.write_text("\n".join([delimiter.join(("t", "q", name)), *rows, ""]))
    return path


def names_of(log):
    return [Path(each).name for each in logs.episodes(log)]


@pytest.mark.parametrize(
    ("text", "name", "number"),
    [
        ("data.parquet#3", "data.parquet", 3),
        ("data.parquet#012", "data.parquet", 12),
        ("data.parquet", "data.parquet", None),
        ("run#4.csv", "run#4.csv", None),
        ("run#4.csv#5", "run#4.csv", 5),
        ("data.parquet#x", "data.parquet#x", None),
        ("data.parquet#-1", "data.parquet#-1", None),
        ("#3", "#3", None),
    ],
)
def test_the_number_of_an_episode_follows_the_name_of_its_file(text, name, number):
    path, found = logs.part_of(text)
    assert (str(path), found) == (name, number)


def test_a_file_that_is_called_so_is_no_episode(tmp_path):
    whole = csv(tmp_path / "run.csv", [3, 3, 4, 4])
    named = tmp_path / "run.csv#3"
    assert logs.part_of(named) == (whole, 3)
    named.write_text("not a log")
    assert logs.part_of(named) == (named, None)
    with_mark = csv(tmp_path / "a #1 ü.csv", [3, 3, 4, 4])
    assert names_of(with_mark) == ["a #1 ü.csv#3", "a #1 ü.csv#4"]
    assert logs.read(f"{with_mark}#4", PLAIN).record.y[:, 0].tolist() == [2, 3]


@pytest.mark.parametrize("statistics", [True, False])
@pytest.mark.parametrize("group", [5, ROWS, 1000])
def test_an_episode_has_the_rows_that_the_whole_table_has(tmp_path, group, statistics):
    """However the rows are grouped, and whether or not the groups say which episodes they hold."""
    numbers = [4, 9, 2]
    whole = pa.concat_tables([table(number) for number in numbers])
    pq.write_table(whole, tmp_path / "all.parquet", row_group_size=group, write_statistics=statistics)
    assert names_of(tmp_path / "all.parquet") == ["all.parquet#4", "all.parquet#9", "all.parquet#2"]
    for number in numbers:
        t, u, q = motion(number)
        record = logs.read(f"{tmp_path}/all.parquet#{number}", LISTS).record
        assert np.abs(record.t - t).max() < 1e-6
        assert np.abs(record.u - u).max() < 1e-6
        assert np.abs(record.y - q).max() < 1e-6 * 10
        alone = logs.read(whole.filter(pc.field("episode_index") == number), LISTS).record
        assert all(np.array_equal(a, b) for a, b in zip(record[:3], alone[:3], strict=True))


def test_a_file_that_was_written_anew_is_read_anew(tmp_path):
    path = tmp_path / "all.parquet"
    for shift in (0, 1):
        pq.write_table(pa.concat_tables([table(0, size=1 + shift), table(1)]), path)
        assert logs.read(f"{path}#0", LISTS).record.u == pytest.approx((1 + shift) * motion(0)[1], abs=1e-6)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_text_has_episodes_too(tmp_path, delimiter):
    path = csv(tmp_path / "runs.csv", [7, 7, 7, 12, 12, 3, 3], delimiter)
    assert names_of(path) == ["runs.csv#7", "runs.csv#12", "runs.csv#3"]
    assert [logs.read(each, PLAIN).record.y[:, 0].tolist() for each in logs.episodes(path)] == [
        [0, 1, 2],
        [3, 4],
        [5, 6],
    ]


@pytest.mark.parametrize("header", ['"t","q","episode"', "\ufefft,q,episode", "t, q, Episode index", "t,q,demo_id"])
def test_the_header_of_a_text_may_be_written_in_many_ways(tmp_path, header):
    path = tmp_path / "runs.csv"
    path.write_text(header + "\n0,1,0\n1,2,0\n0,3,1\n1,4,1\n", encoding="utf-8")
    assert names_of(path) == ["runs.csv#0", "runs.csv#1"]
    assert logs.read(f"{path}#1", PLAIN).record.y[:, 0].tolist() == [3, 4]


def test_numbers_of_episodes_may_be_floats_and_rows_without_one_belong_to_none(tmp_path):
    path = csv(tmp_path / "runs.csv", ["0.0", "0.0", "nan", "", "1.0", "1.0", "-1"])
    assert names_of(path) == ["runs.csv#0", "runs.csv#1"]
    assert logs.read(f"{path}#1", PLAIN).record.y[:, 0].tolist() == [4, 5]
    t = pa.array([0.0, 0.1, 0.2, 0.0, 0.1])
    numbers = pa.array([3.0, 3.0, np.nan, 5.0, 5.0])
    pq.write_table(pa.table({"t": t, "q": t, "episode": numbers}), tmp_path / "runs.parquet")
    assert names_of(tmp_path / "runs.parquet") == ["runs.parquet#3", "runs.parquet#5"]
    assert len(logs.read(f"{tmp_path}/runs.parquet#3", PLAIN).record.t) == 2


@pytest.mark.parametrize(
    "cells",
    [
        ["a", "a", "b", "b"],
        [None] * 4,
        [[1], [1], [2], [2]],
        [True, True, False, False],
        [0.0, 0.5, 0.7, 1.0],
        [0, 0, 1, 0],
    ],
)
def test_a_column_that_counts_nothing_makes_no_episodes(tmp_path, cells):
    t = [0.0, 0.1, 0.2, 0.3]
    pq.write_table(pa.table({"t": t, "q": t, "trial": cells}), tmp_path / "run.parquet")
    assert names_of(tmp_path / "run.parquet") == ["run.parquet"]
    assert len(logs.read(tmp_path / "run.parquet", PLAIN).record.t) == 4
    with pytest.raises(LogError, match=r"run\.parquet"):
        logs.read(f"{tmp_path}/run.parquet#1", PLAIN)


def test_one_episode_is_the_file_itself(tmp_path):
    pq.write_table(table(5), tmp_path / "one.parquet")
    assert names_of(tmp_path / "one.parquet") == ["one.parquet"]
    assert len(logs.read(f"{tmp_path}/one.parquet#5", LISTS).record.t) == ROWS


def test_an_episode_that_is_missing_is_refused_with_the_name_of_the_file(tmp_path):
    data_set(tmp_path / "set", {"file-000.parquet": [table(0), table(1)]})
    for log, columns in (
        (f"{logs.episodes(tmp_path / 'set')[0]}7", LISTS),
        (f"{csv(tmp_path / 'a.csv', [0, 1])}#7", PLAIN),
    ):
        with pytest.raises(LogError, match=r"(parquet|csv): there is no episode 0?7"):
            logs.read(log, columns)
    pq.write_table(table(0, episode_index=None), tmp_path / "plain.parquet")
    with pytest.raises(LogError, match="no column has the number of an episode"):
        logs.read(f"{tmp_path}/plain.parquet#0", LISTS)
    with pytest.raises(FileNotFoundError, match="no such file"):
        logs.read(f"{tmp_path}/lost.parquet#0", LISTS)


def test_both_layouts_of_a_data_set_have_the_same_episodes(tmp_path):
    each = [table(number) for number in range(12)]
    old = data_set(tmp_path / "v2", {f"episode_{k:06d}.parquet": [one] for k, one in enumerate(each)})
    new = data_set(tmp_path / "v3", {"file-000.parquet": each[:7], "file-001.parquet": each[7:]})
    assert names_of(old) == [f"episode_{k:06d}.parquet" for k in range(12)]
    assert names_of(new) == [f"file-{k // 7:03d}.parquet#{k}" for k in range(12)]
    for a, b in zip(logs.episodes(old), logs.episodes(new), strict=True):
        pairs = zip(logs.read(a, LISTS).record[:3], logs.read(b, LISTS).record[:3], strict=True)
        assert all(np.array_equal(*pair) for pair in pairs)
    (old / "stray.csv").write_text("t,q\n0,0\n")
    pq.write_table(each[0], old / "meta" / "tasks.parquet")
    assert len(logs.episodes(old)) == 12, "only what is in its folder `data` was recorded"


def test_a_folder_has_its_logs_in_the_order_of_the_numbers_in_their_names(tmp_path):
    for name in ("run10.csv", "run9.csv", "Run1.CSV", "b.parquet", ".run3.csv", "notes.md"):
        (tmp_path / name).write_text("t,q\n0,0\n")
    pq.write_table(table(0), tmp_path / "b.parquet")
    csv(tmp_path / "run9.csv", [1, 1, 2, 2])
    (tmp_path / "deeper").mkdir()
    csv(tmp_path / "deeper" / "run0.csv", [1, 2])
    assert names_of(tmp_path) == ["Run1.CSV", "b.parquet", "run9.csv#1", "run9.csv#2", "run10.csv"]


def test_a_folder_that_is_a_log_is_one_and_one_without_logs_is_refused(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    assert logs.episodes(bag) == (bag,)
    assert logs.episodes(tmp_path) == (str(bag),)
    with pytest.raises(LogError, match=r"bag#1: a log of messages has no episodes; leave #1 out"):
        logs.read(f"{bag}#1", PLAIN)
    (bag / "metadata.yaml").unlink()
    for folder in (bag, tmp_path):
        with pytest.raises(ValueError, match=r"this folder has no log; give one with \.csv or \.parquet files"):
            logs.episodes(folder)


def test_a_number_behind_a_folder_is_refused(tmp_path):
    """The numbers of episodes are those of a file, so that no folder is taken as a whole where one was asked for."""
    data_set(tmp_path / "set", {"file-000.parquet": [table(0), table(1)]})
    with pytest.raises(ValueError, match=r"set.*file.*#1"):
        logs.episodes(f"{tmp_path}/set#1")
    with pytest.raises(ValueError, match=r"set.*file.*#1"):
        logs.survey(f"{tmp_path}/set#1")


@pytest.mark.parametrize("content", [b"", b"PAR1 garbage", b"PAR1" + bytes(64) + b"PAR1"])
def test_a_broken_file_is_one_log_and_its_fault_is_said_by_whoever_reads_it(tmp_path, content):
    each = [table(number) for number in range(4)]
    folder = data_set(tmp_path / "set", {f"episode_{k}.parquet": [one] for k, one in enumerate(each)})
    broken = folder / "data" / "chunk-000" / "episode_0.parquet"
    broken.write_bytes(content)
    found = logs.episodes(folder)
    assert len(found) == 4
    with pytest.raises(LogError, match=r"episode_0\.parquet: cannot be read as .parquet"):
        logs.read(found[0], LISTS)
    assert logs.survey(folder).columns["timestamp"].shape == (ROWS,), "another one is drafted from"
    for name in found[1:]:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=r"episode_0\.parquet: cannot be read as .parquet"):
        logs.survey(folder)


def test_the_survey_of_a_folder_is_that_of_the_episode_that_moves_most(tmp_path):
    sizes = [0.1, 0.02, 3.0, 1.0]
    each = [table(k, size=size, rows=40) for k, size in enumerate(sizes)]
    folder = data_set(tmp_path / "set", {"file-000.parquet": each}, robot_type="so101_follower")
    found = logs.survey(folder)
    assert str(found.log).endswith("file-000.parquet#2")
    assert len(found.columns["timestamp"]) == 40
    assert found.columns["action[1]"] == pytest.approx(motion(2, 3.0, 40)[1][:, 1], abs=1e-6)
    assert found.labels["action[1]"] == "lift.pos"
    assert found.robot == "so101"


def test_an_episode_without_numbers_does_not_count(tmp_path, recwarn):
    unknown = pa.array([[float("nan")] * 2] * ROWS, pa.list_(pa.float32(), 2))
    each = [table(0, action=unknown), table(1), table(2, rows=1)]
    data_set(tmp_path / "set", {"file-000.parquet": each})
    assert str(logs.survey(tmp_path / "set").log).endswith("#1")
    assert not recwarn.list


@pytest.mark.parametrize(
    ("stated", "robot"),
    [("so101_follower", "so101"), ("so100", "so100"), (None, ""), ("", ""), (7, "7"), (["a"], "['a']")],
)
def test_the_kind_of_robot_is_that_of_the_description(tmp_path, stated, robot):
    folder = data_set(tmp_path / "set", {"file-000.parquet": [table(0), table(1)]}, robot_type=stated)
    assert logs.survey(folder).robot == robot


def test_arms_in_folders_of_their_own_and_a_file_of_a_data_set_have_the_kind_of_robot_too(tmp_path):
    for arm in "ab":
        data_set(tmp_path / "arms" / arm, {"file-000.parquet": [table(0), table(1)]}, robot_type="so101_follower")
    for log in (tmp_path / "arms", tmp_path / "arms" / "b" / "data" / "chunk-000" / "file-000.parquet"):
        assert logs.survey(log).robot == "so101"


def test_a_folder_with_one_log_is_surveyed_as_others_are(tmp_path):
    folder = data_set(tmp_path / "set", {"a.parquet": [table(0)]}, names=("pan.pos", "gripper.pos"), robot_type="so101")
    found = logs.survey(folder)
    assert found.log == str(folder / "data" / "chunk-000" / "a.parquet")
    assert found.robot == "so101"
    assert "action[1]" not in found.columns
    path = csv(tmp_path / "run.csv", [0, 0, 0])
    assert logs.survey(path).log is path


def test_a_gripper_in_a_data_set_is_left_out(tmp_path):
    folder = data_set(tmp_path / "set", {"a.parquet": [table(0), table(1)]}, names=("pan.pos", "gripper.pos"))
    found = logs.survey(folder)
    assert set(found.columns) == {"timestamp", "episode_index", "observation.state[0]", "action[0]"}
    assert any("action[1], observation.state[1] left out: per cent" in remark for remark in found.remarks)


@pytest.mark.parametrize("place", ["calibration.json", "meta/calibration.json"])
def test_a_calibration_tells_the_unit_of_normalised_positions(tmp_path, place):
    """Positions from -100 to 100 are ticks of the encoder over its range; those in degrees have another tick."""
    rng = np.random.default_rng(0)
    ticks = rng.integers(-400, 400, (300, 2)).cumsum(axis=0) % 1700

    def both(scale):
        cells = pa.array((ticks * scale).tolist(), pa.list_(pa.float32(), 2))
        return {"action": cells, "observation.state": cells}

    ranges = {"pan": 1700, "lift": 2400}
    known = {name: {"id": 1, "range_min": 800, "range_max": 800 + each} for name, each in ranges.items()}
    for name, scale in (("per_cent", 200 / np.array([1700, 2400])), ("degrees", np.full(2, 360 / 4096))):
        folder = data_set(tmp_path / name, {"file.parquet": [table(k, rows=300, **both(scale)) for k in range(2)]})
        (folder / place).write_text(json.dumps(known))
        units = logs.survey(folder).units
        if name == "degrees":
            assert not units
            continue
        for column in ("action[{}]", "observation.state[{}]"):
            for k, each in enumerate(ranges.values()):
                size, unit = units[column.format(k)].split()
                assert unit == "deg"
                assert float(size) == pytest.approx(each / 200 * 360 / 4096, rel=1e-6)
        assert logs.unit_factor(units["action[0]"]) * scale[0] == pytest.approx(2 * np.pi / 4096)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"pan": 3}', '{"pan": {"range_min": null, "range_max": 3}}', "null"])
def test_a_broken_calibration_or_description_tells_nothing(tmp_path, text):
    folder = data_set(tmp_path / "set", {"file.parquet": [table(0), table(1)]}, robot_type="so101")
    (folder / "calibration.json").write_text(text)
    found = logs.survey(folder)
    assert (len(found.columns), dict(found.units), found.robot) == (6, {}, "so101")
    (folder / "meta" / "info.json").write_text(text)
    found = logs.survey(folder)
    assert (len(found.columns), dict(found.units), found.robot) == (6, {}, "")


def test_rows_that_lie_together_are_decoded_once(tmp_path, monkeypatch):
    """However many columns a log has: in a large file an episode is a small part of a group of rows."""
    path, decoded = tmp_path / "all.parquet", []
    pq.write_table(pa.concat_tables([table(number) for number in range(6)]), path)
    read = pq.ParquetFile.read_row_groups

    def counted(file, groups, columns):
        decoded.extend(columns)
        return read(file, groups, columns=columns)

    monkeypatch.setattr(pq.ParquetFile, "read_row_groups", counted)
    for number in range(6):
        logs.read(f"{path}#{number}", LISTS)
    assert sorted(decoded) == ["action", "episode_index", "observation.state", "timestamp"]


def test_reading_episodes_one_by_one_parses_each_footer_once_and_copies_no_other_episode(tmp_path, monkeypatch):
    files = {f"file-{k:03d}.parquet": [table(6 * k + each) for each in range(6)] for k in range(2)}
    whole = {name.replace("file", "whole"): [pa.concat_tables(each)] for name, each in files.items()}
    each = logs.episodes(data_set(tmp_path / "set", files | whole))
    counted, footer, groups = [], pq.read_metadata, pq.ParquetFile.read_row_groups
    monkeypatch.setattr(pq, "read_metadata", lambda path: counted.append(Path(path).name) or footer(path))

    def read(file, of, columns):
        counted.append(f"{len(of)} of {file.metadata.num_row_groups}")
        return groups(file, of, columns=columns)

    monkeypatch.setattr(pq.ParquetFile, "read_row_groups", read)
    for log in each:
        number = logs.part_of(log)[1]
        assert logs.read(log, LISTS).record.y.tolist() == pytest.approx(np.float32(motion(number)[2]))
    assert Counter(counted) == {
        **dict.fromkeys((*files, *whole), 1),
        "1 of 6": 12 * 4,  # the columns of one episode: two lists, stamps, and the numbers
        "1 of 1": 2 * 4,  # of all six at once
    }


def test_a_folder_without_logs_has_those_of_the_folders_in_it(tmp_path):
    for arm in ("arm10", "arm9"):
        data_set(tmp_path / "arms" / arm, {"file-000.parquet": [table(k) for k in range(2)]})
    (tmp_path / "arms" / "notes").mkdir()
    found = [Path(each).relative_to(tmp_path / "arms").as_posix() for each in logs.episodes(tmp_path / "arms")]
    assert found == [f"{arm}/data/chunk-000/file-000.parquet#{k}" for arm in ("arm9", "arm10") for k in range(2)]
    csv(tmp_path / "arms" / "run.csv", [0, 0])
    assert names_of(tmp_path / "arms") == ["run.csv"], "a folder with logs is that of one arm"
