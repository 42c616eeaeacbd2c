"""Names of columns and numbers as people write them: read as meant, or refused with what to write."""

import re

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_unknown_units import T, columns, frame

from covariant import calibration, logs, models, verbs
from covariant.logs import Columns, LogError

KNOWN = {
    **dict.fromkeys(
        ("q.deg", "q/deg", "q°", "qDeg", "deg_q", "q-deg", "q{deg}", "q<deg>", "q1deg", "q_deg_1", "pitchdeg", "DEG q",
         "angleDegrees", "left_knee_deg_raw", "q_deg [1]", "q (in deg)", "q (left, deg)", "[deg] q"),
        ("q", "deg"),
    ),
    **{"qMm": ("q", "mm"), "x_millimeters": ("q", "mm"), "q_revs": ("q", "turn"), "angle_milliradians": ("q", "mrad")},
    **{"xmm": ("q", "mm"), "q_cdeg": ("q", "0.01 deg"), "q_millidegrees": ("q", "0.001 deg")},
    **{"torque_Ncm": ("u", "N cm"), "torque [N-cm]": ("u", "N cm"), "tau_mNm": ("u", "mN m"), "F kN": ("u", "kN")},
    **{"tau_cNm": ("u", "cN m"), "tau [N×cm]": ("u", "N cm"), "torque_millinewtonmeters": ("u", "mN m")},
    **dict.fromkeys(("ms", "millis", "millis()", "timeMs", "t.ms", "ms_since_boot", "Time(ms)", "timems",
                     "t_milli", "timestamp (ms since epoch)", "[ms]"), ("t", "ms")),
    **dict.fromkeys(("us", "usec", "micros", "TimeUS", "stamp_usec"), ("t", "us")),
    **dict.fromkeys(("nanoseconds", "timestamp_ns", "ros_time_nanosec"), ("t", "ns")),
    **{"days": ("t", "24 h"), "time [d]": ("t", "24 h"), "t_h": ("t", "h"), "minutes": ("t", "min")},
    "time_10ms": ("t", "10ms"),
    **{"w_rpm": ("v", "rpm"), "omegaDegPerSec": ("v", "deg/s"), "w_dps": ("v", "deg/s"), "v_km_h": ("v", "km/h")},
    **{"w_degs": ("v", "deg/s"), "w [deg s^-1]": ("v", "deg/s"), "w (1/min)": ("v", "rpm")},
    "v [mm s⁻¹]": ("v", "mm/s"),
}  # fmt: skip
UNKNOWN = {
    **dict.fromkeys(("q_ticks", "q.counts", "encoderCounts", "ticks_left", "q%", "q_rpm", "q_gon", "q_inches"), "q"),
    **dict.fromkeys(("quadcounts", "q_thou", "q_V"), "q"),
    **dict.fromkeys(("u_A", "u_mA", "u/A", "u_V", "tau_amps", "u_percent", "force_lbf", "tau_kgcm", "u_deg"), "u"),
    **dict.fromkeys(("tau_oz_in", "tau_ftlb", "tau_in-lb", "force_kg", "i_amp", "u_milliamps", "cmd_us"), "u"),
    **dict.fromkeys(("tick", "frame", "time_samples", "t_deg", "step", "sample_idx", "header.seq", "t_hhmmss"), "t"),
    **dict.fromkeys(("v_deg", "v_counts_s", "v_mph", "w_erpm", "w_hz"), "v"),
}
PLAIN = {
    "q": (
        "q1",
        "q_A",
        "theta_m",
        "q_min",
        "x_cm_ref",
        "cm_x",
        "/ns1/arm",
        "second_joint",
        "hip_rad",
        "q_raw",
        "degas",
        "lb_hip",
        "q_lp10hz",
        "comm",
        "index_finger",
        "micro_arm",
        "q (joint 2)",
        "counter_arm",
    ),
    "u": (
        "tau_m",
        "torque_Nm",
        "torque.Nm",
        "torque_N_m",
        "Nm_tau",
        "u_nm",
        "pwm",
        "motor_current",
        "u_min",
        "amp_1",
        "tau_g",
        "u_in",
    ),
    "t": (
        "time",
        "seconds",
        "sample_time",
        "tick_time",
        "t_sim",
        "header.stamp",
        "time (UTC)",
        "Time [sec.]",
        "time_step",
    ),
    "v": ("speed", "w_rad_per_s", "v_s", "w_rads", "w [rad s-1]"),
}


@pytest.mark.core(38)
@pytest.mark.parametrize(("name", "field", "unit"), [(name, *meant) for name, meant in KNOWN.items()])
def test_a_unit_in_a_name_is_an_error_that_says_what_to_write(name, field, unit):
    with pytest.raises(LogError, match=re.escape(f'write {field} = "{unit}" under [units]')):
        logs.read(frame(field, name), columns(field, name))
    log = logs.read(frame(field, name), columns(field, name, unit))
    read = {"t": log.record.t, "q": log.record.y[:, 0], "u": log.record.u, "v": log.v}[field]
    assert np.ravel(read)[-1] == pytest.approx(logs.unit_factor(unit))


@pytest.mark.parametrize(("name", "field"), UNKNOWN.items())
def test_what_is_no_unit_of_the_column_is_refused_without_brackets_too(name, field):
    with pytest.raises(LogError, match=rf"in its name, which is no unit of {field} here; known are "):
        logs.read(frame(field, name), columns(field, name))


@pytest.mark.parametrize(("name", "field"), [(name, field) for field, names in PLAIN.items() for name in names])
def test_a_word_that_is_no_unit_is_part_of_a_name(name, field):
    log = logs.read(frame(field, name), columns(field, name))
    assert np.ravel({"t": log.record.t, "q": log.record.y, "u": log.record.u, "v": log.v}[field])[-1] == 1.0


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("q (raw ticks)", "q"), ("q (counts per rev)", "q"), ("q [0..4095]", "q"), ("q (0-360)", "q"),
        ("u (% rated)", "u"), ("u (A rms)", "u"), ("u (kgf cm)", "u"), ("u (lbs)", "u"), ("v (counts/s)", "v"),
        ("t (мс)", "t"), ("time (cycles)", "t"),
    ],
)  # fmt: skip
def test_a_remark_in_brackets_that_holds_a_unit_is_one(name, field):
    with pytest.raises(LogError, match=rf"in brackets, which is no unit of {field} here"):
        logs.read(frame(field, name), columns(field, name))


def test_the_joints_a_and_b_are_no_amperes():
    frame = pandas.DataFrame({"t": T, "q": T, "torque_A": T, "torque_B": T})
    assert logs.read(frame, Columns(q=("q",), u=("torque_A", "torque_B"))).record.u.shape == (3, 2)


NO_HEADER = {
    "spaces": "0.0 1.5 2\n0.5 -2.25 3\n1.0 3 4\n",
    "a missing measurement first": "0.0,1.5,nan\n0.5,-2.25,3\n1.0,3,4\n",
    "words in a column": "0.0,1.5,ok\n0.5,-2.25,ok\n1.0,3,late\n",
    "a comment that names nothing": "# made at 2 Hz, by a logger\n0.0,1.5,2\n0.5,-2.25,3\n1.0,3,4\n",
    "decimal commas": "0,0;1,5;2\n0,5;-2,25;3\n1,0;3,0;4\n",
    "dates": "2024-05-01T12:00:00,1.5,2\n2024-05-01T12:00:00.5,-2.25,3\n2024-05-01T12:00:01,3,4\n",
}


@pytest.mark.parametrize("case", NO_HEADER)
def test_a_log_without_a_header_keeps_its_first_row(tmp_path, case):
    (tmp_path / "log.txt").write_text(NO_HEADER[case])
    record = logs.read(tmp_path / "log.txt", Columns(t="1", q=("2",))).record
    assert (record.t.tolist(), record.y[:, 0].tolist()) == (T, [1.5, -2.25, 3.0])
    with pytest.raises(LogError, match=r"no column 'q'\. Its first line, '.*', names no columns, so that they are"):
        logs.read(tmp_path / "log.txt", Columns(t="1", q=("q",)))


def test_a_count_of_columns_is_a_header(tmp_path):
    for first in (0, 1):
        text = f"{first},{first + 1}\n0.0,1.5\n0.5,-2.25\n1.0,3.0\n"
        (tmp_path / "log.csv").write_text(text)
        record = logs.read(tmp_path / "log.csv", Columns(t=str(first), q=(str(first + 1),))).record
        assert (record.t.tolist(), record.y[:, 0].tolist()) == (T, [1.5, -2.25, 3.0])


def test_init_says_that_there_is_no_header(tmp_path):
    t = np.arange(300) * 2e-3
    np.savetxt(tmp_path / "log.txt", np.column_stack([t, np.sin(3 * t), np.cos(t)]), fmt="%.4f")
    words = r"the columns of numbers are 1, 2, 3\. Its first line, '0\.0000 0\.0000 1\.0000', names no columns"
    with pytest.raises(ValueError, match=words):
        verbs.init(tmp_path / "log.txt")
    result = verbs.init(tmp_path / "log.txt", columns={"q": ["2"], "u": ["3"]})
    assert result.draft.rows == 300
    assert "names no columns, so that they are called 1, 2, 3" in str(result)
    file = models.load(result.save(tmp_path / "m.toml"))
    assert (file.columns.t, file.columns.q, file.columns.u) == ("1", ("2",), ("3",))


def test_columns_of_one_name_are_one_where_they_are_equal(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q,tau,tau\n0,1,0.5,0.50\n1,2,,\n2,3,0.4,.4\n")
    survey = logs.survey(path)
    assert list(survey.columns) == ["t", "q", "tau"]
    assert survey.remarks == ("2 columns are named 'tau' and are equal, so that they count as one",)
    read = logs.read(path, Columns(q=("q",), v=("tau",))).v
    assert read is not None
    assert read[2, 0] == 0.4
    path.write_text("t,q,tau,tau\n0,1,0.5,0.5\n1,2,0.5,0.7\n2,3,0.4,0.4\n")
    words = r"2 columns are named 'tau' and differ, first in row 2: '0\.5' and '0\.7'; "
    with pytest.raises(LogError, match=words + "rename all but one"):
        logs.read(path, Columns(q=("q",), u=("tau",)))
    with pytest.raises(ValueError, match="there is no column 'tau' of numbers.*" + words):
        verbs.init(path, columns={"q": ["q"], "u": ["tau"]})


def with_metadata(**units):
    fields = [pa.field(name, pa.float64(), metadata={"Unit": unit} if unit else None) for name, unit in units.items()]
    return pa.table([pa.array(T)] * len(fields), schema=pa.schema(fields))


@pytest.mark.parametrize("in_file", [True, False])
def test_units_of_parquet_and_arrow_count(tmp_path, in_file):
    def log(**units):
        if in_file:
            pq.write_table(with_metadata(**units), tmp_path / "log.parquet")
        return tmp_path / "log.parquet" if in_file else with_metadata(**units)

    with pytest.raises(LogError, match=r'unit in its attributes, and no unit is given for q; write q = "deg" under'):
        logs.read(log(t="", q="degrees"), Columns(q=("q",)))
    with pytest.raises(LogError, match="column 'q' has 'counts' in its attributes, which is no unit of q here"):
        logs.read(log(t="s", q="counts"), Columns(q=("q",)))
    with pytest.raises(LogError, match='write t = "us" under'):
        logs.read(log(t="µs", q="rad"), Columns(q=("q",)))
    assert logs.read(log(t="s", q="rad"), Columns(q=("q",))).record.y[-1, 0] == 1.0
    survey = logs.survey(log(t="ms", q="deg"))
    guess = calibration.draft(survey.columns, {}, survey.units)
    assert guess.units == {"t": ("ms",), "q": ("deg",)}
    assert guess.guessed == ()


def test_units_in_the_attributes_of_a_table_count(tmp_path):
    frame = pandas.DataFrame({"t": T, "q": T})
    frame.attrs["units"] = {"q": "deg"}
    frame.to_parquet(tmp_path / "log.parquet")
    schema = pa.schema([("t", pa.float64()), ("q", pa.float64())], metadata={"units": '{"q": "deg"}', "note": "{"})
    plain = pa.table([pa.array(T)] * 2, schema=schema)
    key = pa.field("q", pa.float64(), metadata={"unit_of_measurement": "deg"})
    named = pa.table([pa.array(T)] * 2, schema=pa.schema([("t", pa.float64()), key]))
    for log in (frame, tmp_path / "log.parquet", plain, named):
        with pytest.raises(LogError, match=r'column .q. has a unit in its attributes.*write q = "deg" under'):
            logs.read(log, Columns(q=("q",)))


@pytest.mark.parametrize(
    "kind", [pa.string(), pa.large_string(), pa.string_view(), pa.dictionary(pa.int32(), pa.string())]
)
def test_text_of_every_type_of_parquet_is_read_alike(tmp_path, kind):
    stamps = ["2024-05-01T12:00:00", "2024-05-01T12:00:00.5", "2024-05-01T12:00:01"]
    pq.write_table(pa.table({"t": pa.array(stamps).cast(kind), "q": pa.array(["1,5", " 2", "-0,5"]).cast(kind)}),
                   tmp_path / "log.parquet")  # fmt: skip
    record = logs.read(tmp_path / "log.parquet", Columns(q=("q",))).record
    assert (record.t.tolist(), record.y[:, 0].tolist()) == (T, [1.5, 2.0, -0.5])


@pytest.mark.parametrize("delimiter", ["\t", "|", " "])
def test_a_comma_that_may_stand_between_thousands_is_no_decimal_mark(tmp_path, delimiter):
    path = tmp_path / "log.csv"
    path.write_text("t;q\n0;1,234\n1;2,345\n".replace(";", delimiter))
    with pytest.raises(LogError, match=r"column 'q', row 1: found the text '1,234', whose comma may be a decimal mark"):
        logs.read(path, Columns(q=("q",)))
    path.write_text("t;q\n0;1,234\n0,5;2,345\n".replace(";", delimiter))
    assert logs.read(path, Columns(q=("q",))).record.y[:, 0].tolist() == [1.234, 2.345]


def test_texts_with_commas_in_a_table_of_types_are_refused_unless_the_comma_is_a_decimal_mark(tmp_path):
    for texts in (["1,234", "1,235", "-12,500"], ["1,234", "2", "3"]):
        pq.write_table(pa.table({"t": T, "q": texts}), tmp_path / "log.parquet")
        for read in (lambda path: logs.read(path, Columns(q=("q",))), logs.survey):
            with pytest.raises(LogError, match="'q', row 1: found the text '1,234', whose comma may be a decimal"):
                read(tmp_path / "log.parquet")
    pq.write_table(pa.table({"t": T, "q": ["1,5", "1,234", "0,5"]}), tmp_path / "log.parquet")
    assert logs.read(tmp_path / "log.parquet", Columns(q=("q",))).record.y[:, 0].tolist() == [1.5, 1.234, 0.5]


def test_days_are_not_read_as_seconds():
    for first in (45_321.5, 739_221.5, 2_460_321.25):
        days = first + np.arange(200) * 0.01 / 86_400
        frame = pandas.DataFrame({"t": days, "q": np.sin(np.arange(200) * 0.02)})
        for unit in ({}, {"t": ("24 h",)}):
            with pytest.raises(LogError, match=r"dates in days, .* subtract the first of them, and write t = .24 h"):
                logs.read(frame, Columns(q=("q",), units=unit))
        with pytest.raises(ValueError, match="column 't' holds dates in days"):
            calibration.draft({"t": days, "q": frame["q"].to_numpy()})
        frame["t"] -= first
        t = logs.read(frame, Columns(q=("q",), units={"t": ("24 h",)})).record.t
        np.testing.assert_allclose(np.diff(t), 0.01, atol=5e-5)  # the rounding of Julian dates


@pytest.mark.parametrize("stamps", [0.5 + np.arange(200) * 0.01 / 86_400, 2024.5 + np.arange(200) * 1e-3 / 3.2e7])
def test_parts_of_a_day_or_a_year_are_not_read_as_seconds(stamps):
    frame = pandas.DataFrame({"t": stamps, "q": np.sin(np.arange(200) * 0.02)})
    words = r"column 't' has .*e\+\d+ rows a second if it holds seconds; write what one of it is under \[units\]"
    with pytest.raises(LogError, match=words):
        logs.read(frame, Columns(q=("q",)))
    with pytest.raises(ValueError, match=words):
        calibration.draft({"t": stamps, "q": frame["q"].to_numpy()})
    assert len(logs.read(frame, Columns(q=("q",), units={"t": ("s",)})).record.t) == 200


def test_letters_of_a_quaternion_say_its_order():
    frame = pandas.DataFrame(
        {"t": np.arange(300) * 0.01} | dict(zip(["q_w", "q.x", "qY", "q[z]"], quaternion().T, strict=True))
    )
    w, *xyz = list(frame.columns[1:])
    assert logs.read(frame, Columns(quaternion_xyzw=(*xyz, w))).record.y.shape == (300, 3, 3)
    with pytest.raises(LogError, match=r"quaternion_wxyz has .*, whose letters are in the order xyzw; name them"):
        logs.read(frame, Columns(quaternion_wxyz=(*xyz, w)))


def quaternion(count=300):
    angle, axis = 0.9 * np.sin(np.arange(count) * 0.01), np.array([0.6, 0.0, 0.8])
    return np.column_stack([np.cos(angle / 2), np.sin(angle / 2)[:, None] * axis])


@pytest.mark.parametrize(
    ("names", "first"),
    [
        (["q[0]", "q[1]", "q[2]", "q[3]"], "q[0]"), (["q0", "q1", "q2", "q3"], "q0"), (["qw", "qx", "qy", "qz"], "qw"),
        (["orientation.w", "orientation.x", "orientation.y", "orientation.z"], "orientation.w"),
        (["Q1", "Q2", "Q3", "Q4"], "Q1"),
    ],
)  # fmt: skip
def test_four_columns_whose_squares_sum_to_one_are_an_attitude(tmp_path, names, first):
    """In any order, where letters say which is which."""
    order = [1, 2, 3, 0] if first[-1] == "w" else [0, 1, 2, 3]
    log = {"timestamp": 88_123_456 + 5_000 * np.arange(300)}
    log |= {names[k]: np.round(quaternion()[:, k], 5) for k in order}
    log |= {"delta_q_reset[0]": np.ones(300)} | {f"delta_q_reset[{k}]": np.zeros(300) for k in (1, 2, 3)}
    result = verbs.init(pandas.DataFrame(log))
    assert result.draft.quaternion == tuple(names)
    file = models.load(result.save(tmp_path / "m.toml"))
    assert file.columns.quaternion_wxyz == tuple(names)
    assert file.columns.units["t"] == ("us",)
    assert file.model.velocities == ("w1", "w2", "w3")
    assert not any(result.draft.quaternion[0] in name for name in result.draft.left_out)


@pytest.mark.parametrize("length", [16_384, 2**30, 1000])
def test_a_quaternion_of_whole_numbers_is_named(length):
    log = {"t": np.arange(300) * 0.01} | dict(
        zip(["qw", "qx", "qy", "qz"], np.round(length * quaternion()).T, strict=True)
    )
    with pytest.raises(ValueError, match=r"qw, qx, qy, qz are a quaternion of length .*; divide them by it"):
        calibration.draft(log)


def test_four_joints_are_no_quaternion():
    q = quaternion()
    log = {"t": np.arange(300) * 0.01} | {f"q{k}": 1.2 * q[:, k] + 0.1 * k for k in range(4)}
    assert calibration.draft(log).quaternion == ()
    assert calibration.draft(log).q == ("q0", "q1", "q2", "q3")
    unit = {"t": log["t"]} | {f"q{k}": q[:, k] for k in range(4)}
    assert calibration.draft(unit | {"q4": log["t"] / 2}).q == ("q0", "q1", "q2", "q3", "q4")
    assert calibration.draft(unit, {"q": ["q0", "q1"]}).q == ("q0", "q1")


@pytest.mark.parametrize(("counts", "digits"), [(4096, 2), (4096, 3), (500, 1), (8192, 2), (2048, 2)])
def test_ticks_that_are_printed_with_few_decimals(counts, digits):
    t = np.arange(3000) * 1e-3
    degrees = np.round(np.round(90 * np.sin(3 * t) / 360 * counts) * 360 / counts, digits)
    guess = calibration.draft({"t": t, "angle_deg": degrees})
    assert guess.quantum == pytest.approx(2 * np.pi / counts, rel=1e-3)


def test_noise_that_is_printed_with_few_decimals_has_the_tick_of_its_printing():
    t = np.arange(3000) * 1e-3
    noisy = np.round(90 * np.sin(3 * t) + np.random.default_rng(0).normal(0, 0.05, t.size), 2)
    assert calibration.draft({"t": t, "angle_deg": noisy}).quantum == pytest.approx(np.deg2rad(0.01), rel=1e-3)
