"""How columns were read: codings of signs, resolutions, stamps that begin anew, rows that were made from others.

A generator draws the codings, so that none of them is known to the code by a line of its own.
"""

import numpy as np
import pandas
import pytest
from logs_with_faults import made

from covariant import logs
from covariant.calibration import diagnose, draft, mended_clock
from covariant.logs import Register, unit_factor
from covariant.signals import Record

T = np.arange(1500) * 0.002
TICK = 2 * np.pi / 4096
MOTION = np.sin(3 * T) + 0.3 * np.sin(11 * T)
DRAWS = range(12)


@pytest.mark.parametrize("seed", DRAWS)
def test_a_sign_is_decoded_whatever_its_bit_its_coding_and_its_unit(seed):
    random = np.random.default_rng(seed)
    bit, unit = 2.0 ** random.choice([8, 9, 10, 11, 12, 15, 23, 31]), random.choice([1.0, 0.004, 0.01, 0.0245])
    largest = random.uniform(0.2, 0.45 if seed % 3 == 0 else 0.95) * min(bit, 5000)
    held = np.repeat(random.uniform(-1, 1, 300), 5)
    load = np.round(largest * (held if seed % 3 == 0 else np.sin(5 * T) + 0.02 * random.normal(size=T.size)) / 1.1)
    sign, complement = np.where(load < 0, bit - load, load), np.where(load < 0, 2 * bit + load, load)
    for span, coded in ((0.0, sign), (2 * bit, complement))[: 1 + (bit > 2000)]:
        found = Register.of(unit * coded)
        assert (found.negative, found.span) == pytest.approx((unit * bit, unit * span))
        assert f"x >= {unit * bit:.10g}" in str(found.fault("load"))
        table = pandas.DataFrame({"t": T, "q1": MOTION, "load": unit * coded})
        with pytest.raises(logs.LogError, match="'load' holds"):
            logs.read(table, logs.Columns(q=("q1",), u=("load",)))
        with pytest.raises(ValueError, match="'load' holds"):
            draft({name: column.to_numpy() for name, column in table.items()}, {"u": ["load"]})


def numbers_with_their_sign(random):
    yield np.repeat(random.integers(0, 256, 300), 5).astype(float)  # the duty of a drive in 8 bits
    yield np.where(np.sin(5 * T) > 0, float(random.integers(100, 900)), 0.0)
    yield np.abs(np.round(np.where(np.sin(5 * T) > 0, 240, 10.0) + 4 * random.normal(size=T.size)))
    yield np.round(random.uniform(3e3, 3e4) * T) % 4096
    yield np.round(2048 + 900 * np.sin(4 * T))
    yield np.round(20 * np.sin(4 * T)) % 360
    for range_, digits in ((2 * np.pi, 3), (360, 1), (360, 2), (1.0, 4), (1000, 0)):  # one that wraps
        yield np.round((0.1 + random.uniform(0.1, 0.6) * np.sin(4 * T)) % 1 * range_, digits) % range_
    yield random.integers(0, 1024, T.size).astype(float)
    yield np.round(random.uniform(1e3, 1e4) * np.sin(4 * T))


@pytest.mark.parametrize("seed", DRAWS)
def test_other_numbers_have_their_sign(seed):
    for values in numbers_with_their_sign(np.random.default_rng(seed)):
        assert not Register.of(values).negative


@pytest.mark.parametrize("seed", DRAWS)
def test_rows_that_were_made_from_their_neighbours_are_known(seed):
    random = np.random.default_rng(seed)
    every = int(random.integers(2, 16))
    first, digits = int(random.integers(0, every)), int(random.choice([4, 6, 12]))
    knots = np.arange(first, T.size + every, every)
    reading = np.round(np.interp(knots, np.arange(T.size), MOTION) / TICK) * TICK
    for factor in (1.0, 180 / np.pi):
        assert Register.read_rows(T, np.round(factor * np.interp(np.arange(T.size), knots, reading), digits)) == (
            every,
            first,
        )


@pytest.mark.parametrize("counts", [0, 52, 360, 1000, 4096, 65536])
def test_readings_of_a_sensor_were_all_read(counts):
    random = np.random.default_rng(counts)
    tick = 2 * np.pi / counts if counts else 0.0
    reading = np.round(MOTION / tick) * tick if counts else MOTION + 1e-4 * random.normal(size=T.size)
    for column in (reading, np.round(reading, 3), np.repeat(reading[::3], 3), np.repeat(reading[::50], 50)):
        assert Register.read_rows(T, column) == (1, 0)


@pytest.mark.parametrize("seed", range(4))
def test_readings_that_were_made_are_left_out_of_a_check(seed):
    log = made("pendulum", 2 * seed, between="linear", counts=4096)
    every = 2 + seed
    y = np.interp(log.record.t, log.record.t[::every], log.record.y[::every, 0])[:, None]
    found = diagnose(log.file, log.record._replace(y=y)).findings
    assert [each.what for each in found if each.wrong] == ["interpolated rows"]
    assert f"--every {every}" in found[0].line


@pytest.mark.parametrize("seed", DRAWS)
def test_a_counter_that_begins_anew_goes_on(seed, tmp_path):
    random = np.random.default_rng(seed)
    bits, unit = [(16, "ms"), (32, "us"), (24, "us"), (32, "ns"), (31, "us"), (32, "ms")][seed % 6]
    step = random.integers(2, 40) if unit == "ms" else random.integers(500, 9000) * (1000 if unit == "ns" else 1)
    count = 2**bits - random.integers(3, 900) * step + np.arange(1000) * step
    signed = seed >= 6 and bits in (16, 32)
    stamps = count % 2**bits - signed * 2 ** (bits - 1)
    assert (np.diff(Register.continued(stamps.astype(float))) == step).all()
    pandas.DataFrame({"t": stamps, "q1": np.sin(np.arange(1000) / 30)}).to_csv(tmp_path / "a.csv", index=False)
    read = logs.read(tmp_path / "a.csv", logs.Columns(q=("q1",), units={"t": (unit,)}))
    assert np.allclose(np.diff(read.record.t), step * unit_factor(unit), rtol=1e-6)


@pytest.mark.parametrize("seed", DRAWS)
def test_single_rows_that_are_stamped_wrongly_are_one_finding(seed):
    random = np.random.default_rng(seed)
    late, step = random.choice([-1.0, 1.0, -0.5, -60.0, 0.256, -3600.0]), random.choice([0.002, 0.01, 0.02])
    t = 53004.7 + step * np.arange(1000) + 0.02 * step * random.normal(size=1000)
    rows = 20 + 100 * np.arange(9) + random.integers(0, 50, 9)
    shifted = t.copy()
    shifted[rows] += late
    mended = mended_clock(Record(shifted, y=np.zeros((1000, 1))))
    assert [each.what for each in mended.findings] == ["clock of single rows"]
    assert f"{'subtract' if late > 0 else 'add'} {abs(late):g} s" in mended.findings[0].line
    assert np.abs(mended.record.t - t).max() < 0.1 * step


@pytest.mark.parametrize(
    "text",
    [
        lambda s: f"{int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}:{s % 60:06.3f}",
        lambda s: f"{int(s // 3600) % 24}:{int(s // 60) % 60:02d}:{s % 60:06.3f}".replace(".", ","),
        lambda s: f"{int(s // 60) % 60:02d}:{s % 60:06.3f}",
        lambda s: (
            f"{int(s // 3600 - 1) % 12 + 1}:{int(s // 60) % 60:02d}:{s % 60:06.3f} {'AP'[int(s % 86400 >= 43200)]}M"
        ),
        lambda s: f"29.11.2026 {int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}:{s % 60:06.3f}",
        lambda s: f"11/29/2026 {int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}:{s % 60:06.3f}",
        lambda s: str(pandas.Timedelta(round(1e3 * s), "ms")),
    ],
)
@pytest.mark.parametrize("begin", [12345.6, 43195.0, 86395.0])
def test_times_of_day_are_seconds(text, begin, tmp_path):
    stamps = begin + 0.02 * np.arange(500)
    table = pandas.DataFrame({"Step": np.arange(500), "clock": [text(s) for s in stamps], "q1": np.sin(stamps)})
    table.to_csv(tmp_path / "a.csv", index=False, sep=";")
    read = logs.read(tmp_path / "a.csv", logs.Columns(t="clock", q=("q1",)))
    assert np.allclose(np.diff(read.record.t), 0.02, atol=1.1e-3)
    columns = logs.survey(tmp_path / "a.csv").columns
    assert draft(columns).t == "clock"


UNITS = {"deg/s": 180 / np.pi, "rpm": 30 / np.pi, "turn/s": 0.5 / np.pi, "-1 rad/s": -1.0, "22.9 rad/s": 1 / 22.9}


@pytest.mark.parametrize("unit", UNITS)
def test_positions_know_the_unit_of_velocities(unit):
    log = made("pendulum", 2, between="linear", counts=4096)
    v = np.gradient(log.exact, log.record.t, axis=0)
    file = log.file._replace(columns=log.file.columns._replace(v=("vel",)))
    assert diagnose(file, log.record, v=v).findings == ()
    (found,) = diagnose(file, log.record, v=UNITS[unit] * v).findings
    assert (found.what, found.where, found.wrong) == ("unit of velocities", "vel", False)
    assert f'[units] v = "{unit}"' in found.line


@pytest.mark.parametrize("counts", [512, 1024, 2000, 2048, 4000, 4096, 16384])
@pytest.mark.parametrize("unit", ["rad", "deg", "turn"])
def test_a_tick_that_is_a_usual_part_of_a_turn_shows_the_unit(counts, unit):
    turn = 2 * np.pi / unit_factor(unit)
    angle = np.round(0.1 * MOTION * counts) / counts * turn
    found = draft({"t": T, "angle": angle})
    if unit != "turn" or counts not in (2000, 4000):  # a tick of a 4000th of a turn looks like one of printed numbers
        assert found.units.get("q", ("rad",)) == (unit,)
        assert found.quantum == pytest.approx(2 * np.pi / counts, rel=1e-3)


@pytest.mark.parametrize("step", [0.5, 1.25, 2.5, 5.5])
def test_a_velocity_shows_the_unit_of_time_and_without_one_it_is_asked(step):
    t = step * np.arange(600)
    for factor in (1.0, 1e-3):
        angle, rate = np.sin(0.2 * t / step), 0.2 * np.cos(0.2 * t / step) / (step * factor)
        found = draft({"time": t, "angle": angle, "speed": rate})
        assert found.units.get("t", ("s",)) == ({1.0: "s", 1e-3: "ms"}[factor],)
    with pytest.raises(ValueError, match="may be seconds or milliseconds; say which by"):
        draft({"time": t, "angle": np.sin(0.2 * t)})
    assert draft({"time": t, "angle": np.sin(0.2 * t)}, units={"t": ["s"]}).rate == pytest.approx(1 / step)


def test_what_counts_rows_is_no_clock():
    rows = np.arange(500.0)
    with pytest.raises(ValueError, match=r"'t' counts rows from 0, and is no clock: say how long a row takes"):
        draft({"t": rows, "q1": np.sin(rows / 50)})
    assert draft({"t": rows, "q1": np.sin(rows / 50)}, units={"t": ["0.01 s"]}).rate == pytest.approx(100)
    assert draft({"n": rows, "stamp_s": 0.01 * rows, "q1": np.sin(rows / 50)}).t == "stamp_s"
    assert draft({"n": rows, "b": 0.01 * rows, "q1": np.sin(rows / 50)}).t == "b"


def test_true_and_false_are_numbers(tmp_path):
    pandas.DataFrame({"t": T, "q1": MOTION, "on": T > 1}).to_csv(tmp_path / "a.csv", index=False)
    read = logs.read(tmp_path / "a.csv", logs.Columns(q=("q1",), u=("on",)))
    assert np.array_equal(read.record.u[:, 0], T > 1)
    frame = pandas.DataFrame({"t": T, "q1": MOTION, "on": T > 1})
    assert np.array_equal(logs.read(frame, logs.Columns(q=("q1",), u=("on",))).record.u[:, 0], T > 1)
