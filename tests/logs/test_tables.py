"""Logs in memory: data frames, datasets and records are read as the same columns in a file are."""

import datetime

import numpy as np
import pyarrow as pa
import pytest

from covariant import logs
from covariant.logs import Columns, LogError
from covariant.signals import Record

pandas = pytest.importorskip("pandas")
xarray = pytest.importorskip("xarray")

COLUMNS = Columns("time", ("arm", "slide"), ("motor",), units={"t": ("ms",), "q": ("deg", "mm"), "u": ("mN m",)})
CELLS = {
    "time": [0.0, 10.0, 20.0, 30.0],
    "arm": [0.0, np.nan, 180.0, 90.0],
    "slide": [1.0, 2.0, 3.0, 4.0],
    "motor": [5, 6, 7, 8],
    "remark": ["on", "", "off", "on"],
}


def of_polars(cells: dict) -> object:
    return pytest.importorskip("polars").DataFrame(cells)


def of_xarray(cells: dict) -> object:
    clock = next(iter(cells))
    return xarray.Dataset(
        {name: (clock, values) for name, values in cells.items() if name != clock}
        | {"picture": ((clock, "pixel"), np.zeros((len(cells[clock]), 2)))},
        coords={clock: cells[clock]},
    )


TABLES = {
    "pandas": pandas.DataFrame,
    "pandas, stamps as the index": lambda cells: pandas.DataFrame(cells).set_index(next(iter(cells))),
    "pyarrow": pa.table,
    "polars": of_polars,
    "xarray": of_xarray,
}
every_table = pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)


@every_table
def test_a_table_is_read_as_its_file_is(table, tmp_path):
    path = tmp_path / "log.parquet"
    pa.parquet.write_table(pa.table(CELLS), path)
    expected, found = logs.read(path, COLUMNS).record, logs.read(table(CELLS), COLUMNS).record
    np.testing.assert_array_equal(found.t, [0.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(found.y[2], [np.pi, 0.003])
    for name in ("t", "u", "y"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert sorted(logs.survey(table(CELLS)).columns) == ["arm", "motor", "slide", "time"]


@every_table
def test_stamps_may_be_dates(table):
    begin = datetime.datetime(2024, 5, 1, 12)
    cells = {"t": [begin + datetime.timedelta(milliseconds=k) for k in (0, 5, 20)], "q": [1.0, 2.0, 3.0]}
    log = logs.read(table(cells), Columns(q=("q",)))
    np.testing.assert_allclose(log.record.t, [0.0, 0.005, 0.02])
    assert np.datetime64(log.origin_ns, "ns") == np.datetime64("2024-05-01T12:00")


@every_table
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"arm": ["1", "two", "3", "4"]}, "column 'arm' [deg], row 2: found 'two', needs a finite number"),
        ({"motor": [5.0, np.nan, 7.0, 8.0]}, "column 'motor' [mN m], row 2: found an empty cell, needs a finite"),
        ({"time": [0.0, 10.0, 10.0, 30.0]}, "rows 2 and 3 have the same stamp 0.01 s"),
        ({"arm": [np.nan] * 4}, "column 'arm' [deg] holds no number in any row; name another column"),
    ],
)
def test_what_is_wrong_is_named_as_in_a_file(table, changed, words):
    log = table(CELLS | changed)
    with pytest.raises(LogError) as caught:
        logs.read(log, COLUMNS)
    name = "dataset" if isinstance(log, xarray.Dataset) else "table"
    message = str(caught.value).replace("found nan,", "found an empty cell,")  # which is what a NaN is
    assert message.startswith(f"{name}: {words}")
    assert "\n" not in message


@every_table
def test_a_column_that_is_missing_is_named_unless_it_is_optional(table):
    log = table(CELLS)
    with pytest.raises(LogError, match=r"no column 'arms'\. Did you mean 'arm'\? There are: "):
        logs.read(log, COLUMNS._replace(q=("arms", "slide")))
    assert logs.read(log, COLUMNS._replace(v=("v1", "v2"))).v is None
    with pytest.raises(LogError, match="no column 'v1'"):
        logs.read(log, COLUMNS._replace(v=("v1", "v2")), optional=())


def test_names_that_two_columns_have_are_refused():
    frame = pandas.DataFrame([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0]], columns=["t", "q", "q"])
    with pytest.raises(LogError, match=r"^table: .*'q'") as caught:
        logs.read(frame, Columns(q=("q",)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("log", [7, None, {"t": [0.0]}, np.zeros((3, 2))])
def test_other_objects_are_no_log(log):
    with pytest.raises(LogError, match="a log is a path, a data frame, a dataset of xarray or a Record; got "):
        logs.read(log, Columns(q=("q",)))


def test_a_dataset_of_pictures_alone_is_refused():
    with pytest.raises(LogError, match=r"^dataset: it has no variable along one dimension"):
        logs.survey(xarray.Dataset({"picture": (("t", "pixel"), np.zeros((3, 2)))}))


RECORD = Record(np.arange(4.0), np.ones((4, 1)), np.arange(8.0).reshape(4, 2), np.arange(16.0).reshape(4, 4))


def test_a_record_is_a_log_in_si_units():
    log = logs.read(RECORD, COLUMNS, every=2, start=0.5)
    np.testing.assert_array_equal(log.record.t, [1.0, 3.0])
    np.testing.assert_array_equal(log.record.y, RECORD.y[1::2])
    np.testing.assert_array_equal(log.record.u, RECORD.u[1::2])
    np.testing.assert_array_equal(log.record.x, RECORD.x[1::2])
    assert log.v is None
    assert log.truth is None


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (RECORD._replace(y=RECORD.y[:, :1]), r"record: it has positions of shape \(1,\), needs 2 of them"),
        (Record(RECORD.t, y=RECORD.y), "record: it has 0 inputs, needs 1"),
        (RECORD._replace(t=RECORD.t[::-1]), "record: row 2: time goes back"),
    ],
)
def test_a_record_that_does_not_fit_is_refused(record, words):
    with pytest.raises(LogError, match=words):
        logs.read(record, COLUMNS)


def test_a_record_of_a_table_needs_no_model():
    found = logs.record(
        pandas.DataFrame(CELLS), t="time", q=["arm", "slide"], u="motor", units={"t": "ms", "q": ["deg", "mm"]}
    )
    np.testing.assert_allclose(found.t, [0.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(found.y[2], [np.pi, 0.003])
    np.testing.assert_array_equal(found.u[:, 0], [5.0, 6.0, 7.0, 8.0])
    assert logs.record(pandas.DataFrame(CELLS), "time", "slide").u.shape == (4, 0)


def test_a_log_is_printed_in_one_line():
    log = logs.read(pandas.DataFrame(CELLS), COLUMNS._replace(v=("arm", "slide")))
    assert repr(log) == "<Log: 4 rows over 0.03 s, 2 positions, 1 input, with velocities>"


def test_periods_of_time_are_no_numbers():
    frame = pandas.DataFrame({"t": pandas.period_range("2024-01-01", periods=3, freq="min"), "q": [1.0, 2.0, 3.0]})
    for table in (frame, frame.set_index("t")):
        with pytest.raises(logs.LogError, match="column 't' holds periods of time"):
            logs.record(table, q="q")


def test_a_dataset_may_give_its_units():
    dataset = xarray.Dataset(
        {"q": ("t", [1.0, 2.0, 3.0], {"units": "deg"})}, coords={"t": ("t", [0.0, 10.0, 20.0], {"units": "ms"})}
    )
    with pytest.raises(logs.LogError, match="column 't' has a unit in its attributes"):
        logs.record(dataset, q="q")
    found = logs.record(dataset, q="q", units={"t": "ms", "q": "deg"})
    np.testing.assert_allclose(found.t, [0.0, 0.01, 0.02])
    np.testing.assert_allclose(found.y[:, 0], np.radians([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("units", [{"q": "ms"}, {"q": "kg"}])
def test_units_of_positions_are_those_of_angles_and_lengths(units):
    with pytest.raises(logs.LogError, match="is no unit of an angle or a length"):
        logs.record(pandas.DataFrame({"t": [0.0, 1.0], "q": [1.0, 2.0]}), q="q", units=units)
