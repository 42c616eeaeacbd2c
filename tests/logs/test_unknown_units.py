"""A text in brackets that is no known unit of its column is an error; an index, a key or a remark is part of a name."""

import re
from typing import Any

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covariant import calibration, logs
from covariant.logs import Columns, LogError

T = [0.0, 0.5, 1.0]
FIELDS = {"t": "t", "q": "q", "u": "u", "v": "v", "truth": "truth"}


def frame(field, name):
    return pandas.DataFrame({name if field == each else plain: T for each, plain in FIELDS.items()})


def columns(field, name, unit=None):
    named: dict[str, Any] = {each: plain if each == "t" else (plain,) for each, plain in FIELDS.items()}
    named[field] = name if field == "t" else (name,)
    return Columns(**named, units={} if unit is None else {field: (unit,)})


UNKNOWN = {
    "q": (
        "q [ticks]",
        "q [counts]",
        "q [COUNTS]",
        "q [rpm]",
        "q [%]",
        "q [gon]",
        "q [V]",
        "q (ticks)",
        "q (%)",
        "q[ticks]",
        "q[gon]",
        "q(counts)",
    ),
    "u": ("u [A]", "u [mA]", "u [V]", "u [%]", "u (A)", "u [lbf]", "u [rad]", "u [PWM]"),
    "t": ("t [frames]", "t [samples]", "t [ticks]", "t (ticks)", "t [Hz]"),
    "v": ("v [ticks/s]", "v [rad]"),
    "truth": ("truth [counts]",),
}


@pytest.mark.parametrize(("field", "name"), [(field, name) for field, names in UNKNOWN.items() for name in names])
def test_what_is_no_unit_is_an_error_with_a_remedy_that_works(field, name):
    log = frame(field, name)
    with pytest.raises(LogError) as caught:
        logs.read(log, columns(field, name))
    message = str(caught.value)
    unit = re.findall(r"[\[(](.*)[\])]", name)[0]
    known = f"table: column {name!r} has {unit!r} in brackets, which is no unit of {field} here; known"
    assert message.startswith(known)
    assert "\n" not in message
    example = re.search(rf'as {field} = "([^"]+)"', message)
    assert example is not None
    assert logs.read(log, columns(field, name, example[1])).record.t[-1] > 0
    assert logs.read(log.rename(columns={name: "plain"}), columns(field, "plain")).record.y[-1, 0] == 1.0


@pytest.mark.parametrize(
    ("field", "name", "unit"),
    [("u", "u [mA]", "mA"), ("u", "u [V]", "V"), ("q", "q [ticks]", "turn/4096"), ("q", "q [%]", "1e-2 m")],
)
def test_a_unit_that_the_model_file_states_counts(field, name, unit):
    record = logs.read(frame(field, name), columns(field, name, unit)).record
    read = {"u": record.u, "q": record.y}[field][:, 0]
    np.testing.assert_allclose(read, np.array(T) * logs.unit_factor(unit))


def test_the_units_that_are_known_are_named():
    with pytest.raises(LogError, match=r'known are N m, mN m and N, kN\. .*or u = "mA" where the model takes it in'):
        logs.read(frame("u", "u [mA]"), columns("u", "u [mA]"))


@pytest.mark.parametrize(
    "names",
    [
        ("q[0]", "q[1]"), ("position[1]", "position[2]"), ("q(1)", "q(2)"), ("q [0]", "q [1]"), ("a[0,1]", "a[0, 2]"),
        ("/joint_states/position[0]", "/joint_states/position[1]"), ("joint[2].angle", "joint[3].angle"),
        ("position[hip]", "position[knee]"), ("angle (left)", "angle (right)"), ("q (filtered)", "p (raw)"),
        ("q1 [rad]", "q2 [m]"), ("q1 (rad)", "q2 [radians]"), ("q []", "p ()"), ("q [1]", "p [-]"), ("q [meters]", "p"),
    ],
)  # fmt: skip
def test_an_index_a_key_or_a_remark_is_no_unit(names):
    log = pandas.DataFrame({"t": T, names[0]: T, names[1]: T})
    assert logs.read(log, Columns(q=names)).record.y.tolist() == [[each, each] for each in T]


def test_units_are_read_as_people_write_them():
    log = pandas.DataFrame({"t": T, "v [degrees/s]": T})
    with pytest.raises(LogError, match='write v = "deg/s" under'):
        logs.read(log, Columns(q=("t",), v=("v [degrees/s]",)))
    torque = pandas.DataFrame({"t": T, "tau [Newton meters]": T})
    assert logs.read(torque, Columns(q=("t",), u=("tau [Newton meters]",))).record.u[-1, 0] == 1.0


def test_files_tables_and_datasets_alike(tmp_path):
    log = frame("q", "q [ticks]")
    log.to_csv(tmp_path / "log.csv", index=False)
    pq.write_table(pa.Table.from_pandas(log), tmp_path / "log.parquet")
    for source in (tmp_path / "log.csv", tmp_path / "log.parquet", pa.Table.from_pandas(log)):
        with pytest.raises(LogError, match=r"column 'q \[ticks\]' has 'ticks' in brackets"):
            logs.read(source, columns("q", "q [ticks]"))
        with pytest.raises(LogError, match=r"column 'q \[ticks\]' has 'ticks' in brackets"):
            logs.record(source, q="q [ticks]")
        assert logs.record(source, q="q [ticks]", units={"q": "turn/4096"}).y[-1, 0] == pytest.approx(2 * np.pi / 4096)


def test_attributes_of_a_dataset_and_columns_of_sensors():
    xarray = pytest.importorskip("xarray")
    log = xarray.Dataset({"q": ("t", T, {"units": "counts"})}, {"t": T})
    with pytest.raises(LogError, match="column 'q' has 'counts' in its attributes, which is no unit of q here"):
        logs.read(log, Columns(q=("q",)))
    beside = pandas.DataFrame({"t": T, "q": T, "rate [LSB]": T})
    sensor = Columns(q=("rate [LSB]",))
    with pytest.raises(LogError, match=r"'LSB' in brackets, which is no unit of what is measured in rad/s; write"):
        logs.read(beside, Columns(q=("q",)), sensors=[(sensor, "rad/s")])
    named = sensor._replace(units={"q": ("0.1 rad/s",)})
    (scaled,) = logs.read(beside, Columns(q=("q",)), sensors=[(named, "rad/s")]).readings
    assert scaled is not None
    assert scaled[-1, 0] == pytest.approx(0.1)
    log = xarray.Dataset({"q": ("t", T), "rate": ("t", T, {"units": "deg/s"})}, {"t": T})
    with pytest.raises(LogError, match=r'column .rate. has a unit in its attributes.*units = "deg/s" in the table'):
        logs.read(log, Columns(q=("q",)), sensors=[(Columns(q=("rate",)), "rad/s")])


def test_a_draft_guesses_no_unit_in_the_place_of_an_unknown_one():
    t = np.arange(0.0, 2.0, 0.01)
    with pytest.raises(ValueError, match=r"column 'q \[ticks\]' has 'ticks' in brackets.* Say what one of it is by"):
        calibration.draft({"t": t, "q [ticks]": 500 * np.sin(t)})
