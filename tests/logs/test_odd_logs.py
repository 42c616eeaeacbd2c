"""Odd and malformed logs: each is read as it was meant, or refused in one line that names what is wrong."""

import datetime
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covariant import logs
from covariant.logs import Columns, LogError

Q = Columns(q=("q",))
T, Y = [0.0, 0.5, 1.0], [1.5, -2.25, 3.0]
"""What every log that is read holds."""


def with_units(**units: str) -> Columns:
    return Q._replace(units={field: (unit,) for field, unit in units.items()})


READ: dict[str, tuple[str | bytes, Columns]] = {
    "semicolons": ("t;q\n0;1.5\n.5;-2.25\n1;3\n", Q),
    "tabs": ("t\tq\n0\t1.5\n0.5\t-2.25\n1\t3\n", Q),
    "strokes": ("t|q\n0|1.5\n0.5|-2.25\n1|3\n", Q),
    "spaces": ("t q\n0 1.5\n0.5 -2.25\n1 3\n", Q),
    "columns set by spaces": ("   t       q\n 0.0     1.5\n 0.5   -2.25\n 1.0     3.0  \n", Q),
    "tabs and spaces": ("t \t q\n0 \t 1.5\n0.5\t-2.25\n1\t3\n", Q),
    "decimal commas": ("t;q\n0,0;1,5\n0,5;-2,25\n1,0;3\n", Q),
    "decimal commas between tabs": ("t\tq\n0\t1,5\n0,5\t-2,25\n1\t3,0e0\n", Q),
    "names with spaces between commas": ("t,q,note one\n0,1.5,a b\n0.5,-2.25,c d\n1,3,e f\n", Q),
    "names with commas between semicolons": ("t;q;x, y\n0;1.5;1\n0.5;-2.25;1\n1;3;1\n", Q),
    "byte order mark": ("\ufefft,q\n0,1.5\n0.5,-2.25\n1,3\n", Q),
    "carriage returns and ends of line": ("t,q\r\n0,1.5\r\n0.5,-2.25\r\n1,3\r\n", Q),
    "spaces around commas": (" t , q \n 0 , 1.5 \n 0.5 , -2.25\n 1 , +3.0e0 \n", Q),
    "quotes and blank lines": ('t,q\n0,"1.5"\n\n0.5,-2.25\n\n1,3\n', Q),
    "unused columns of one name": ("t,q,x,x\n0,1.5,,\n0.5,-2.25,,\n1,3,,\n", Q),
    "quoted header": ('"t","q"\n0,1.5\n0.5,-2.25\n1,3\n', Q),
    "byte order mark and semicolons": ("\ufefft;q\n0;1,5\n0,5;-2,25\n1;3\n", Q),
    "UTF-16, as Excel writes it": ("t\tq\n0\t1.5\n0.5\t-2.25\n1\t3\n".encode("utf-16"), Q),
    "carriage returns only": ("t,q\r0,1.5\r0.5,-2.25\r1,3\r", Q),
    "two ends of line": ("t,q\n0,1.5\r\n0.5,-2.25\r\r\n1,3\r", Q),
    "a note over several lines": ('t,q,note\n0,1.5,"a\nb, c"\n0.5,-2.25,5" pipe\n1,3,"d\n\n"\n', Q),
    "no end of line at the end": ("t,q\n0,1.5\n0.5,-2.25\n1,3", Q),
    "a comment above": ("# made by a logger, at 2 Hz\n% and more, and more\nt,q\n0,1.5\n0.5,-2.25\n1,3\n", Q),
    "comments between rows": ("t,q\n0,1.5\n# paused, resumed\n0.5,-2.25\n  % end\n1,3\n", Q),
    "the header as a comment": ("# t q\n0 1.5\n0.5 -2.25\n1 3\n", Q),
    "the header as a comment, with commas": ("% t,q\n0,1.5\n0.5,-2.25\n1,3\n", Q),
    "empty lines first and between": ("\n\nt,q\n\n0,1.5\n   \n0.5,-2.25\n1,3\n\n", Q),
    "a delimiter at the end of rows": ("t;q\n0;1.5;\n0.5;-2.25;\n1;3;\n", Q),
    "a delimiter at the end of all lines": ("t,q,\n0,1.5,\n0.5,-2.25,\n1,3,\n", Q),
    "a delimiter at the end of the header": ("t,q,\n0,1.5\n0.5,-2.25\n1,3\n", Q),
    "an index without a name": (",t,q\n0,0,1.5\n1,0.5,-2.25\n2,1,3\n", Q),
    "milliseconds": ("t,q\n0,1.5\n500,-2.25\n1000,3\n", with_units(t="ms")),
    "microseconds": ("t,q\n0,1.5\n500000,-2.25\n1000000,3\n", with_units(t="µs")),
    "nanoseconds since 1970": (
        "t,q\n1700000000000000001,1.5\n1700000000500000001,-2.25\n1700000001000000001,3\n",
        with_units(t="ns"),
    ),
    "seconds since 1970": ("t,q\n1700000000.123456789,1.5\n1700000000.623456789,-2.25\n1700000001.123456789,3\n", Q),
    "dates in UTC": ("t,q\n2024-02-29T23:59:59.5Z,1.5\n2024-03-01T00:00:00Z,-2.25\n2024-03-01T00:00:00.500Z,3\n", Q),
    "dates with a zone": (
        "t,q\n2024-05-01 12:00:00.000000001+02:00,1.5\n2024-05-01 10:00:00.500000001+00:00,-2.25\n"
        "2024-05-01 12:00:01.000000001+02:00,3\n",
        Q,
    ),
    "dates without a zone, spaces around": (
        "t, q\n 2024-05-01 12:00:00 ,1.5\n2024-05-01 12:00:00.5,-2.25\n2024-05-01 12:00:01,3\n",
        Q,
    ),
    "dates and decimal commas": (
        "t;q\n2024-05-01T12:00:00,0;1,5\n2024-05-01T12:00:00,5;-2,25\n2024-05-01T12:00:01,0;3\n",
        Q,
    ),
    "a unit in the name and one that is given": (
        "t_s,q_deg\n0,1.5\n0.5,-2.25\n1,3\n",
        Columns(t="t_s", q=("q_deg",), units={"q": ("rad",)}),
    ),
    "dates under a name with a unit": (
        "time_ms,q\n2024-05-01T12:00:00,1.5\n2024-05-01T12:00:00.5,-2.25\n2024-05-01T12:00:01,3\n",
        Q._replace(t="time_ms"),
    ),
    "degrees": ("t,q\n0,85.94366926962348\n0.5,-128.91550390443524\n1,171.88733853924697\n", with_units(q="deg")),
    "ticks of 4096 a turn": (
        "t,q\n0,977.847970356605\n0.5,-1466.7719555349074\n1,1955.69594071321\n",
        with_units(q="turn/4096"),
    ),
    "the other sign": ("t,q\n0,-1.5\n0.5,2.25\n1,-3\n", with_units(q="-1")),
    "an ending in capitals": ("t,q\n0,1.5\n0.5,-2.25\n1,3\n", Q),
}

REFUSED: dict[str, tuple[str | bytes, Columns, str]] = {
    "nothing": ("", Q, "the file is empty; its first line must name the columns"),
    "comments only": ("# t,q\n% 0,1\n", Q, "the file is empty"),
    "a header only": ("# made\nt;q\n\n", Q, "a header and no rows"),
    "no header": (
        "0,1.5\n0.5,-2.25\n1,3\n",
        Q,
        "no column 't'. Its first line, '0,1.5', names no columns, so that they are called 1, 2; use these",
    ),
    "no header, decimal commas": ("0,5;1,5\n1,0;2\n", Q, "Its first line, '0,5;1,5', names no columns"),
    "units under the header": ("t,q\ns,rad\n0,1\n1,2\n", Q, "column 't', row 1: found 's', needs a finite number"),
    "commas between thousands": (
        "t;q\n0.5;1,234\n1.5;2\n",
        Q,
        "column 'q', row 1: found '1,234', and column 't', row 1, has '0.5'",
    ),
    "commas between thousands, twice": ("t;q\n0;1,234,567\n1;2\n", Q, "column 'q', row 1: found '1,234,567'"),
    "commas between thousands in quotes": (
        't,q\n0,"1,234"\n1,"2,345"\n',
        Q,
        "column 'q', row 1: found '1,234' in a file whose cells have commas between them",
    ),
    "decimal commas in quotes": ('t,q\n0,"1,5"\n"0,5",2\n1,3\n', Q, "column 't', row 2: found '0,5' in a file"),
    "microseconds since 1970 without a unit": (
        "t,q\n1700000000000000,1\n1700000000010000,2\n",
        Q,
        'row 1: found 1700000000000000, which in s is after the year 2200; write t = "us" under [units]',
    ),
    "nanoseconds since 1970 in milliseconds": (
        "t,q\n1700000000000000000,1\n1700000000010000000,2\n",
        with_units(t="ms"),
        'which in ms is after the year 2200; write t = "ns" under [units]',
    ),
    "a clock that is set from 0 to nanoseconds": ("t,q\n0,1\n1.7e18,2\n", Q, "row 2: found 1.7e18"),
    "degrees in the name": (
        "t,q [deg]\n0,1\n1,2\n",
        Columns(q=("q [deg]",)),
        "column 'q [deg]' has a unit in its name, and no unit is given for q; write q = \"deg\" under [units]",
    ),
    "one of two in millimetres": (
        "t,cart_mm,pole\n0,1,0\n1,2,0\n",
        Columns(q=("cart_mm", "pole")),
        'write q = ["mm", "rad"] under [units]',
    ),
    "milliseconds in the name": ("time_ms,q\n0,1\n10,2\n", Q._replace(t="time_ms"), 'write t = "ms" under [units]'),
    "milliseconds by another name": ("time [msec],q\n0,1\n10,2\n", Q._replace(t="time [msec]"), 'write t = "ms" under'),
    "milliseconds after a space": ("time MS,q\n0,1\n10,2\n", Q._replace(t="time MS"), 'write t = "ms" under [units]'),
    "degrees in capitals": ("t,q [DEG]\n0,1\n1,2\n", Columns(q=("q [DEG]",)), 'write q = "deg" under [units]'),
    "milliradians": ("t,q_mrad\n0,1\n1,2\n", Columns(q=("q_mrad",)), 'write q = "mrad" under [units]'),
    "units of a column": (
        "t,q\n0,1\n1,2\n",
        Q._replace(units={"q1": ("deg",)}),
        "units are given for 'q1', which is no",
    ),
    "units of several": (
        "t,q\n0,1\n1,2\n",
        Q._replace(units={"q": ("deg", "mm")}),
        "2 units are given for q, which has 1",
    ),
    "a unit of something else": ("t,q\n0,1\n1,2\n", with_units(t="kHz"), "units of t: unit 'kHz' is no unit of what"),
    "a velocity in degrees": ("t,q,w_deg_s\n0,1,2\n1,2,3\n", Q._replace(v=("w_deg_s",)), 'write v = "deg/s"'),
    "points between thousands": ("t;q\n0;1.234,5\n1;2\n", Q, "column 'q', row 1: found '1.234,5'"),
    "bare decimal commas between commas": ("t,q\n0,5,1,5\n1,0,2,5\n", Q, "row 1 has 4 cells where the header has 2"),
    "a quotation mark that is never closed": (
        't,q,note\n0,1,a\n1,2,"b\n2,3,c\n3,4,d\n',
        Q,
        "row 2 has a quotation mark that is not closed before the next row: 'b\\n2,3,c",
    ),
    "a quotation mark that another one closes": (
        't,q,note\n0,1,a\n1,2,"b\n2,3,c\n3,4,"d\n4,5,e\n',
        Q,
        "row 2 has a quotation mark that is not closed",
    ),
    "a quotation mark whose end looks like a comment": (
        't,q,note\n0,1,a\n1,2,"b\n#c"\n2,3,d\n3,4,e\n',
        Q,
        "row 2 has a quotation mark that is not closed",
    ),
    "zeros where a power cut ended the log": ("t,q\n0,1\n1,2\n" + "\0" * 64, Q, "row 3 has 1 cells"),
    "a zero byte in a number": ("t,q\n0,1\n1,2.\x000\n2,3\n", Q, r"column 'q', row 2: found '2.\x000'"),
    "decimal commas under a header with a comma at its end": (
        "t,q,\n0,1,5\n1,2,25\n2,3,0\n",
        Q,
        "the last column has no name, and its first cell is '5': are the commas",
    ),
    "a cell that is too long": (
        "t,q,picture\n0,1,a\n1,2," + "x" * 140_000 + "\n2,3,b\n",
        Q,
        "line 3 without comments has a cell of more than 131,072 letters",
    ),
    "a cell too many": (
        "t;q\n0;1\n1;2;3\n",
        Q,
        "'1;2;3'; a missing measurement is an empty cell between its semicolons",
    ),
    "a cut last row": ("t\tq\tu\n0\t1\t2\n1\t2\t3\n2\t4", Q, "row 3 has 2 cells where the header has 3"),
    "another delimiter in the rows": ("t,q\n0;1\n1;2\n", Q, "row 1 has 1 cells where the header has 2: '0;1'"),
    "not in Unicode": ("t,q,größe\n0,1,2\n".encode("latin-1"), Q, "cannot be read as .csv: 'utf-8' codec"),
    "bytes of something else": (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", Q, "cannot be read as .csv"),
    "a name in other letters": ("T,q\n0,1\n1,2\n", Q, "no column 't'. There are: T, q"),
    "a name twice": (
        "t;q;q\n0;1;1\n1;1;2\n",
        Q,
        "2 columns are named 'q' and differ, first in row 2: '1' and '2'; rename all but one",
    ),
    "time that stands still": ("t,q\n0,1\n0.1,1\n0.1,1\n", Q, "rows 2 and 3 have the same stamp 0.1 s"),
    "time that goes back, in ms": (
        "t,q\n0,1\n20,1\n10,1\n",
        with_units(t="ms"),
        "row 3: time goes back from 0.02 s to 0.01 s",
    ),
    "dates to the second": (
        "t,q\n2024-05-01T12:00:00,1\n2024-05-01T12:00:00,2\n",
        Q,
        "rows 1 and 2 have the same stamp 0 s",
    ),
    "a month that is none": (
        "t,q\n2024-12-01T12:00:00,1\n2024-13-01T12:00:00,2\n",
        Q,
        "column 't', row 2: found '2024-13-01T12:00:00', needs a date as in row 1",
    ),
    "a zone in some rows": (
        "t,q\n2024-12-01T12:00:00Z,1\n2024-12-01T12:00:01,2\n",
        Q,
        "column 't', row 2: found '2024-12-01T12:00:01'",
    ),
    "an hour among times": ("t,q\n12:00:00,1\n12,2\n", Q, "column 't', row 2: found '12', needs a time of day"),
    "dates with a unit": (
        "t,q\n2024-12-01,1\n2024-12-02,2\n",
        with_units(t="ms"),
        "column 't' [ms] holds dates, which need no unit",
    ),
    "a gap in the dates": ("t,q\n2024-12-01T12:00:00,1\n,2\n", Q, "column 't', row 2: found an empty cell"),
    "a word among degrees": ("t,q\n0,1\n1,off\n", with_units(q="deg"), "column 'q' [deg], row 2: found 'off'"),
    "a hexadecimal number": ("t,q\n0,1\n1,0x1F\n", Q, "row 2: found '0x1F'"),
    "a number and its unit": ("t,q\n0,1 deg\n1,2 deg\n", Q, "row 1: found '1 deg'"),
    "an overflow": ("t,q\n0,1\n1,1e999\n", Q, "column 'q', row 2: found '1e999'"),
    "Excel's error": ("t,q\n0,1\n1,#N/A\n", Q, "column 'q', row 2: found '#N/A'"),
    "one row": ("t;q\n0;1\n", Q, "needs at least two rows; this one has 1"),
    "no first measurement": ("t;q\n0;\n1;2\n", Q, "row 1 lacks a measurement"),
    "an input that is missing": (
        "t;q;u\n0;1;1\n1;2;\n",
        Q._replace(u=("u",)),
        "column 'u', row 2: found an empty cell",
    ),
    "half of the velocities": (
        "t,q,v1\n0,1,1\n1,2,2\n",
        Q._replace(v=("v1", "v2")),
        "no column 'v2'. There are: t, q, v1",
    ),
}


def written(folder: Path, content: str | bytes, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("case", READ)
def test_an_odd_log_is_read_as_it_was_meant(tmp_path, case):
    content, columns = READ[case]
    record = logs.read(
        written(tmp_path, content, "log.TXT" if case.endswith("capitals") else "log.csv"), columns
    ).record
    np.testing.assert_allclose(record.t, T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(record.y[:, 0], Y, rtol=1e-14)


@pytest.mark.parametrize("case", REFUSED)
def test_a_malformed_log_gets_one_line(tmp_path, case):
    content, columns, words = REFUSED[case]
    path = written(tmp_path, content)
    with pytest.raises(LogError) as caught:
        logs.read(path, columns)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [each.name for each in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".mcap"])
def test_a_pipe_or_a_device_is_refused_before_it_is_read(tmp_path, ending):
    """Which might never end."""
    os.mkfifo(tmp_path / f"pipe{ending}")
    (tmp_path / f"device{ending}").symlink_to("/dev/zero")
    for name in ("pipe", "device"):
        for read in (lambda path: logs.read(path, Q), logs.survey):
            with pytest.raises(LogError, match=rf"{name}\{ending}: is no file; write what it delivers to one"):
                read(tmp_path / f"{name}{ending}")


def test_an_error_without_words_is_named(tmp_path, monkeypatch):
    path = tmp_path / "log.csv"
    path.write_text("t,q\n0,1\n1,2\n")

    def interrupted(*_, **__):
        raise TimeoutError

    monkeypatch.setattr(Path, "open", interrupted)
    with pytest.raises(LogError, match=r"log\.csv: TimeoutError; give the path of a log"):
        logs.read(path, Q)


def test_there_are_sixty_of_them():
    assert len(READ) + len(REFUSED) >= 60


def test_dates_and_times_since_1970_keep_their_origin(tmp_path):
    def origin(case):
        return logs.read(written(tmp_path, READ[case][0]), READ[case][1]).origin_ns

    assert origin("nanoseconds since 1970") == 1_700_000_000_000_000_001
    assert origin("seconds since 1970") == 1_700_000_000_123_456_789
    leap = datetime.datetime(2024, 2, 29, 23, 59, 59, 500_000, datetime.UTC)
    assert origin("dates in UTC") == round(leap.timestamp() * 1e9)
    assert origin("dates with a zone") == origin("dates without a zone, spaces around") - 2 * 3600 * 10**9 + 1
    assert origin("semicolons") is None


def test_parquet_may_hold_dates_and_durations(tmp_path):
    ns = np.array([0, 500_000_000, 1_000_000_000])
    for kind, origin in ((pa.timestamp("ns"), 10**18), (pa.timestamp("us", "UTC"), 10**18), (pa.duration("ns"), None)):
        stamps = pa.array(ns + (origin or 0), pa.int64()).cast(pa.timestamp("ns") if origin else kind)
        pq.write_table(pa.table({"t": stamps.cast(kind), "q": Y}), tmp_path / "log.parquet")
        log = logs.read(tmp_path / "log.parquet", Q)
        np.testing.assert_allclose(log.record.t, T, rtol=0, atol=1e-12)
        assert log.origin_ns == origin


def test_parquet_in_single_precision_is_read_unless_the_stamps_are_too_coarse(tmp_path):
    for begin, sound in ((0.0, True), (1e7, False)):
        t = np.float32(begin) + np.arange(3, dtype=np.float32)
        pq.write_table(pa.table({"t": t, "q": np.float32(Y)}), tmp_path / "log.parquet")
        if sound:
            assert logs.read(tmp_path / "log.parquet", Q).record.y[:, 0].tolist() == Y
        else:
            with pytest.raises(
                LogError, match=r"column 't': stamps in float32 near 1e\+07 s are whole multiples of 1 s"
            ):
                logs.read(tmp_path / "log.parquet", Q)


def test_a_stretch_is_counted_from_the_first_row(tmp_path):
    path = written(tmp_path, "t,q\n" + "".join(f"{1700000000 + k},{k}\n" for k in range(10)))
    assert logs.read(path, Q, start=2.0, until=5.0).record.y[:, 0].tolist() == [2, 3, 4, 5]
    assert logs.read(path, Q, start=2.0, until=5.0).record.t.tolist() == [2, 3, 4, 5]
    with pytest.raises(LogError, match=r"every=1, from=20 keep 0 of 10 rows"):
        logs.read(path, Q, start=20.0)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("us", 1e-6), ("ns", 1e-9), ("min", 60.0), ("deg/s", np.pi / 180), ("rpm", np.pi / 30), ("rev", 2 * np.pi),
        ("1/4096 turn", 2 * np.pi / 4096), ("mm", 1e-3), ("cm", 1e-2), ("mN m", 1e-3), ("kN·m", 1e3), ("-1 N m", -1.0),
        ("rad/s²", 1.0), ("kg m^2", 1.0), ("0.5 °", np.pi / 360), ("1e-3", 1e-3), ("m/s/s", 1.0), ("N m/A", 1.0),
    ],
)  # fmt: skip
def test_units(unit, factor):
    assert logs.unit_factor(unit) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize("unit", ["", "degrees per second", "deg//s", "/s", "deg/", "0 m", "1e999", "turn/0", "m^5"])
def test_what_is_no_unit_is_quoted(unit):
    with pytest.raises(ValueError, match=r"^unit '"):
        logs.unit_factor(unit)


def test_a_unit_measures_what_its_column_holds():
    logs.check_unit("deg", "rad")
    logs.check_unit("-1", "rad")
    logs.check_unit("mm", "an unknown one")
    with pytest.raises(ValueError, match="unit 'mm' is no unit of what is measured in rad"):
        logs.check_unit("mm", "rad")
