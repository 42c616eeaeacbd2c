"""A log that is changed on purpose is found to be so, and one that fits is left in peace: what takes long."""

import re

import numpy as np
import pytest
from logs_with_faults import with_fault
from test_diagnosis import SPACING, clean, exact, late, pendulum, torques
from two_links import Truth, swing

from covariant import logs, models
from covariant.calibration import diagnose, misfit, outliers
from covariant.models import load
from covariant.signals import Record
from covariant.simulation import PositionSensor, sense, stamps

QUANTUM = 1.5339807878856412e-3


def one_late(record, joint, time):
    y = record.y.copy()
    y[:, joint] = late(y[:, joint], time, record.t)
    return record._replace(y=y)


def whats(done):
    return [finding.what for finding in done.findings if finding.wrong]


@pytest.mark.parametrize("seed", range(4))
def test_a_log_that_fits_has_no_findings(pendulum, exact, seed):
    record = exact(*np.random.default_rng(seed).uniform(-2, 2, 4))
    record = record._replace(y=sense(PositionSensor(500.0, noise_std=2e-4), record.y, seed))
    assert diagnose(pendulum, record).findings == ()
    assert misfit(pendulum, record) is None


CHANGES = {
    "milliseconds": (lambda r: r._replace(t=r.t * 1e3), "unit of time", '[units] t = "ms"'),
    "seconds taken for milliseconds": (lambda r: r._replace(t=r.t * 1e-3), "unit of time", '[units] t = "1e+03 s"'),
    "nanoseconds": (lambda r: r._replace(t=r.t * 1e9), "unit of time", '[units] t = "ns"'),
    "degrees": (lambda r: r._replace(y=np.rad2deg(r.y)), "unit of positions", '[units] q = "deg"'),
    "turns": (lambda r: r._replace(y=r.y / (2 * np.pi)), "unit of positions", '[units] q = "turn"'),
    "both": (
        lambda r: r._replace(t=r.t * 1e3, y=np.rad2deg(r.y)),
        "unit of time and positions",
        '[units] t = "ms"; [units] q = "deg"',
    ),
    "counts": (
        lambda r: r._replace(y=np.round(r.y / (2 * np.pi) * 16384)),
        "unit of positions",
        '[units] q = "turn/16384"',
    ),
    "one joint in degrees": (
        lambda r: r._replace(y=r.y * [1.0, 180 / np.pi]),
        "unit of positions",
        '[units] q = ["rad", "deg"]',
    ),
    "swapped joints": (lambda r: r._replace(y=r.y[:, ::-1], u=r.u[:, ::-1]), "swapped joints", 'u = ["tau2", "tau1"]'),
    "swapped positions": (lambda r: r._replace(y=r.y[:, ::-1]), "swapped positions", '[columns] q = ["q2", "q1"]'),
    "swapped torques": (lambda r: r._replace(u=r.u[:, ::-1]), "swapped inputs", '[columns] u = ["tau2", "tau1"]'),
    "sign of a torque": (lambda r: r._replace(u=r.u * [-1, 1]), "sign of an input", '[units] u = ["-1", "1"]'),
    "sign of a position": (
        lambda r: r._replace(y=r.y * [1, -1]),
        "sign of a position",
        '[units] q = ["rad", "-1 rad"]',
    ),
    "upside down": (lambda r: r._replace(y=r.y + np.array((np.pi, 0.0))), "zero of a position", "add 3.14159265 to q1"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_a_column_is_in_truth_is_found(pendulum, clean, name):
    change, what, line = CHANGES[name]
    changed = change(clean)
    found = [finding for finding in diagnose(pendulum, changed).findings if finding.wrong]
    assert [finding.what for finding in found] == [what]
    assert line in found[0].line
    if what.startswith("unit") and "one joint" not in name:
        refused = misfit(pendulum, changed)
        assert refused is not None
        assert refused.line == found[0].line


@pytest.mark.parametrize(("joint", "time"), [(0, SPACING), (1, SPACING), (1, 30e-3)])
def test_a_late_joint_is_found_to_half_a_millisecond(pendulum, clean, joint, time):
    (found,) = diagnose(pendulum, one_late(clean, joint, time)).findings
    assert (found.what, found.where) == ("delay", ("q1", "q2")[joint])
    assert abs(found.numbers["delay"] - time) < 3e-4
    assert found.numbers["std"] < 2e-4
    if time == SPACING:
        assert "1 row late" in found.evidence
    given = [float(x) for x in found.line.split("[")[-1].rstrip("]").split(",")]
    np.testing.assert_allclose(given, np.where(np.arange(2) == joint, found.numbers["delay"], 0), atol=1e-4)
    assert misfit(pendulum, one_late(clean, joint, time)) is None
    told = pendulum._replace(delay=tuple(given))
    assert [finding.what for finding in diagnose(told, one_late(clean, joint, time)).findings if finding.wrong] == []


@pytest.mark.exhaustive
def test_the_scale_of_an_input_is_found(pendulum, clean):
    (found,) = diagnose(pendulum, clean._replace(u=clean.u * [1.0, 2.0])).findings
    assert (found.what, found.where) == ("scale of an input", "tau2")
    assert abs(found.numbers["scale"] - 0.5) < 0.01 + 3 * found.numbers["std"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("scales", [(0.02, -0.05), (1.6, 0.5)])
def test_wrong_scales_of_all_inputs_do_not_hide_each_other(pendulum, clean, scales):
    """As where torques of motors are taken for those of the joints."""
    first, second = diagnose(pendulum, clean._replace(u=clean.u * scales)).findings
    for found, name, scale in ((first, "tau1", scales[0]), (second, "tau2", scales[1])):
        assert (found.what, found.where) == ("scale of an input", name)
        assert abs(found.numbers["scale"] * scale - 1) < 0.02 + 3 * found.numbers["std"] * abs(scale)


@pytest.mark.exhaustive
def test_two_faults_are_found_one_after_the_other(pendulum, clean):
    changed = one_late(clean, 1, 6e-3)._replace(t=clean.t * 1e3)
    done = diagnose(pendulum, changed._replace(u=clean.u * [1.0, 1.6]))
    assert whats(done) == ["unit of time", "delay", "scale of an input"]


def test_ticks_are_found_and_told_only_where_the_file_does_not_know_them(pendulum, exact):
    record = exact(0.5, -0.8, 1.0, 2.0)
    record = record._replace(y=sense(PositionSensor(500.0, quantum=QUANTUM), record.y))
    (found,) = diagnose(pendulum, record).findings
    assert found.what == "ticks"
    assert not found.wrong
    assert abs(found.numbers["quantum"] / QUANTUM - 1) < 1e-6
    assert found.line.startswith("[measurement] quantum = 0.001534")
    assert diagnose(pendulum, record, QUANTUM).findings == ()
    assert whats(diagnose(pendulum, record, QUANTUM / 4)) == ["ticks"]


def test_noise_beyond_the_data_sheet_is_found(pendulum, clean):
    noisy = clean._replace(y=sense(PositionSensor(500.0, noise_std=3e-3), clean.y, 1))
    (found,) = diagnose(pendulum, noisy).findings
    assert found.what == "noise"
    assert abs(found.numbers["std"] / 3e-3 - 1) < 0.1


@pytest.mark.exhaustive
def test_outliers_are_found_and_what_is_left_is_compared(pendulum, clean):
    random = np.random.default_rng(0)
    y, bad = clean.y.copy(), random.random(clean.y.shape) < 0.05
    y[bad] += random.normal(0, 0.5, bad.sum())
    done = diagnose(pendulum, clean._replace(y=y))
    assert whats(done) == ["outliers", "outliers"]
    for finding, column in zip(done.findings, bad.T, strict=True):
        assert abs(finding.numbers["share"] - column.mean()) < 0.005
    turned = clean._replace(y=y * [1.0, -1.0])
    assert whats(diagnose(pendulum, turned)) == ["sign of a position", "outliers", "outliers"]


def test_gaps_jitter_and_missing_cells_are_notes(pendulum, exact):
    t = exact(0.5, -0.8, 1.0, 2.0).t
    kept = np.ones(len(t), bool)
    kept[[500, 501, 502, 900]] = False
    record = exact(0.5, -0.8, 1.0, 2.0)
    y = sense(PositionSensor(500.0, noise_std=2e-4, dropout=0.03), record.y, 2)
    done = diagnose(pendulum, Record(t[kept], record.u[kept], y[kept]))
    assert [finding.what for finding in done.findings] == ["missing rows", "missing measurements"]
    assert done.findings[0].numbers["rows"] == 4
    assert not done.wrong
    jitter = stamps(PositionSensor(500.0, jitter=2e-4), 6.0, 1)
    moved = [np.interp(jitter, t, column) for column in (*record.u.T, *record.y.T)]
    done = diagnose(
        pendulum,
        Record(jitter, np.array(moved[:2]).T, sense(PositionSensor(500.0, noise_std=2e-4), np.array(moved[2:]).T)),
    )
    assert [finding.what for finding in done.findings] == ["irregular stamps"]


def test_nothing_is_told_of_a_machine_that_stands_still(pendulum, clean):
    still = clean._replace(
        y=sense(PositionSensor(500.0, noise_std=2e-4), np.tile(clean.y[:1], (len(clean.t), 1))), u=0 * clean.u
    )
    (found,) = diagnose(pendulum, still).findings
    assert found.what == "too little motion"
    assert misfit(pendulum, still) is None
    assert misfit(pendulum, Record(*(array[:20] for array in clean[:3]))) is None


@pytest.mark.exhaustive
def test_a_model_of_another_machine_is_refused(clean):
    other = load("examples/demo_double_pendulum.toml", ("parameters.gravity=0.5", "parameters.com=[0.01, 0.01]"))
    found = misfit(other, clean)
    assert found is not None
    assert found.what == "model"
    assert "model" in whats(diagnose(other, clean))
    # A file that states unknown forces leaves room for what the model does not explain.
    assert misfit(other._replace(external_force_std=1.0, external_force_time=1.0), clean) is None


REAL = {
    "A0_sysid_00": "dfki_double_pendulum",
    "A0_sysid_05": "dfki_double_pendulum",
    "A0_sysid_12": "dfki_double_pendulum",
    "ddp": "dfki_simple_pendulum",
    "dircol": "dfki_simple_pendulum_dircol",
}


def real(data_folder, name):
    file = load(f"examples/{REAL[name]}.toml")
    folder = REAL[name].removesuffix("_dircol")
    return file, logs.read(data_folder / folder / f"{name}.csv", file.columns).record


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_recorded_logs_fit_their_models(data_folder, name):
    file, record = real(data_folder, name)
    assert whats(diagnose(file, record)) == []


@pytest.mark.data
@pytest.mark.parametrize(("name", "joint"), [("A0_sysid_00", 0), ("A0_sysid_00", 1), ("A0_sysid_05", 0)])
def test_a_row_late_is_found_in_a_recorded_log(data_folder, name, joint):
    file, record = real(data_folder, name)
    y = record.y.copy()
    y[1:, joint] = record.y[:-1, joint]
    (found,) = [finding for finding in diagnose(file, record._replace(y=y)).findings if finding.wrong]
    assert (found.what, found.where) == ("delay", ("q1", "q2")[joint])
    assert abs(found.numbers["delay"] - 2e-3) < 1e-3  # joint 1 of that log seems to be late already


@pytest.mark.exhaustive
@pytest.mark.data
def test_faults_of_a_recorded_log_are_found(data_folder):
    file, record = real(data_folder, "dircol")
    for changed, what in (
        (record._replace(t=record.t * 1e3), "unit of time"),
        (record._replace(y=np.rad2deg(record.y)), "unit of positions"),
        (record._replace(u=-record.u), "sign of an input"),
        (record._replace(u=2 * record.u), "scale of an input"),
    ):
        assert whats(diagnose(file, changed)) == [what]
    file, record = load("examples/multiarm_double.toml"), None
    record = logs.read(data_folder / "multiarm_pendulum" / "double.csv", file.columns, until=6.0).record
    assert whats(diagnose(file, record)) == []
    (found,) = diagnose(file, one_late(record, 1, 2.5e-3)).findings
    assert abs(found.numbers["delay"] - 2.5e-3) < 5e-4


def test_single_outliers_are_named_by_row_and_spoil_nothing(pendulum, clean):
    y = clean.y.copy()
    y[[400, 1500], 1] += 0.4
    (found,) = diagnose(pendulum, clean._replace(y=y), first_row=11, every=2).findings
    assert (found.what, found.where, found.wrong) == ("outliers", "q2", False)
    assert "2 of 3001 cells" in found.evidence
    assert "by 0.4 rad: row 811 (0.8 s), row 3011 (3 s)" in found.evidence


@pytest.mark.exhaustive
def test_a_log_in_which_nothing_moves_is_said_to_be_one(pendulum, clean):
    done = diagnose(pendulum, clean._replace(y=np.broadcast_to([0.5, -0.25], clean.y.shape)))
    assert [(found.what, found.wrong) for found in done.findings] == [("nothing moves", True)]
    assert done.findings[0].evidence == "q1 is 0.5 rad, q2 is -0.25 rad in all 3001 rows"
    one = diagnose(pendulum, clean._replace(y=np.where([True, False], clean.y, 0.1)))
    assert ("a position does not move", "q2", False) in [(f.what, f.where, f.wrong) for f in one.findings]


def test_readings_that_repeat_are_told_from_ticks(pendulum, clean):
    """A sensor that is read at 125 Hz into a log of 500 Hz."""
    held = clean._replace(y=clean.y[np.arange(len(clean.t)) // 4 * 4])
    (found,) = [each for each in diagnose(pendulum, held).findings if each.what == "repeated rows"]
    assert found.wrong
    assert found.numbers["in_a_row"] == 4
    assert "2250 of 3001 rows (75 %)" in found.evidence
    ticks = diagnose(pendulum, clean._replace(y=QUANTUM * 4 * np.round(clean.y / (QUANTUM * 4))))
    assert "repeated rows" not in [found.what for found in ticks.findings]
    assert "repeated rows" not in [found.what for found in diagnose(pendulum, clean).findings]


@pytest.mark.parametrize("end", [1560, 3001])
def test_a_stuck_encoder_is_named_with_its_rows(pendulum, clean, end):
    y = clean.y.copy()
    y[1500:end, 1] = y[1500, 1]
    (found,) = diagnose(pendulum, clean._replace(y=y)).findings
    assert (found.what, found.where, found.wrong) == ("repeated rows", "q2", True)
    assert f"in all rows from row 1501 (3 s) to row {end}" in found.evidence
    assert found.line.startswith("until = 3 keeps" if end == len(y) else "leave the cells of q2 empty")


def test_a_zero_that_moves_during_the_log_is_named_with_time_and_size(pendulum, clean):
    y = clean.y.copy()
    y[1500:, 1] += 0.1
    y[2000:, 1] += 0.1
    found = diagnose(pendulum, clean._replace(y=y)).findings
    assert [(each.what, each.where, each.wrong) for each in found] == [("zero of a position", "q2", True)] * 2
    assert [each.numbers["jump"] for each in found] == pytest.approx([0.1, 0.1], abs=2e-3)
    assert [each.numbers["begin"] for each in found] == pytest.approx([3.0, 4.0])
    assert found[0].line.startswith("until = 3 keeps")
    assert found[1].line.startswith("subtract 0.")


def test_a_joint_that_rests_and_then_moves_is_not_called_stuck(pendulum, exact):
    """Its encoder reads one value for a second, and later for 67 rows at a turn beside ticks of three rows."""
    moved = exact(0.0, 0.0, 0.0, 0.0)
    t, rest = np.arange(len(moved.t) + 500) * SPACING, np.zeros((500, 2))
    y = QUANTUM * np.round(np.concatenate([rest, moved.y]) / QUANTUM)
    found = diagnose(pendulum._replace(quantum=QUANTUM), Record(t, np.concatenate([rest, moved.u]), y)).findings
    assert not [each for each in found if each.wrong]


@pytest.mark.exhaustive
def test_inputs_that_never_change_are_named_before_an_uncertainty(pendulum, clean):
    u = np.where([True, False], 0.0, clean.u)[:1000]
    short = clean._replace(t=clean.t[:1000], y=clean.y[:1000])
    (found,) = [each for each in diagnose(pendulum, short._replace(u=u)).findings if each.wrong]
    assert found.what in ("model", "uncertainty")
    assert found.evidence.startswith("tau1 is 0 in all 1000 rows; ")
    assert found.line.startswith("log what drives the machine")


def test_what_spoils_most_comes_first(pendulum, clean):
    y = clean.y.copy()
    y[400] += 0.4
    found = diagnose(pendulum, clean._replace(t=1e3 * clean.t, y=y)).findings
    assert [each.what for each in found] == ["unit of time", "outliers", "outliers"]


TWO_LINKS = {"viscous": (0.0, 0.0), "coulomb": (0.0, 0.0), "asymmetry": (0.0, 0.0), "armature": (0.0, 0.0)}
"""Numbers that the URDF file of the arm does not have."""


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("unknown", "what", "line"),
    [
        ({"viscous": (0.3, 0.06), "coulomb": (0.2, 0.08)}, "friction", "friction"),
        ({"armature": (0.01, 0.004)}, "rotor inertia", "armature"),
        ({"viscous": (0.3, 0.06), "armature": (0.01, 0.004)}, "friction and rotor inertia", "friction,armature"),
        ({"armature": (0.01, 0.0)}, "rotor inertia", "armature.shoulder"),
        ({"load": 0.3}, "", ""),
    ],
)
def test_friction_and_rotors_that_a_robot_lacks_are_named(unknown, what, line):
    t, u, y = swing(1, Truth(**TWO_LINKS | unknown), 15.0)
    arm = load("double_pendulum", ("measurement.std=1e-4",))
    found = [
        each for each in diagnose(arm, Record(t, u[0], y[0])).findings if each.what not in ("model", "uncertainty")
    ]
    assert {each.what for each in found} == ({what} if what else set())
    if line:
        assert found[0].line == f"covariant fit MODEL LOG --parameters {line}"
        assert found[0].numbers["unexplained_after"] < 0.02
        for name, values in unknown.items():
            kind = {"viscous": "viscous friction", "coulomb": "Coulomb friction", "armature": "rotor inertia"}[name]
            for joint, value in zip(("shoulder", "elbow"), values, strict=True):
                if not value:
                    assert f"{kind} of {joint}" not in found[0].numbers
                    continue
                assert 0.7 * value < found[0].numbers[f"{kind} of {joint}"] < 1.3 * value


@pytest.mark.exhaustive
def test_a_wrong_centre_of_mass_is_not_called_a_rotor(pendulum, clean):
    """A rotor explains half of it and more, and leaves a quarter."""
    wrong = load("examples/demo_double_pendulum.toml", ("measurement.std=2e-4", "parameters.com=[0.1, 0.2]"))
    found = diagnose(wrong._replace(columns=pendulum.columns), clean)
    assert found.wrong
    assert not {each.what for each in found.findings} & {"friction", "rotor inertia", "friction and rotor inertia"}


@pytest.mark.exhaustive
def test_what_a_model_lacks_is_named_before_an_estimate_and_for_chains():
    fault = with_fault("unknown rotor", 1)
    (found,) = (each for each in diagnose(fault.file, fault.record).findings if each.wrong)
    command = r"covariant fit MODEL LOG --parameters rotor_inertia --set 'parameters.rotor_inertia=\[(.*), (.*)\]'"
    first = re.fullmatch(command, found.line)
    assert first is not None
    # That of the other joint is a tenth of it, for a fit to start from.
    assert np.isclose(float(first[1]), 10 * float(first[2]), rtol=0.05)
    refused = misfit(fault.file, fault.record)
    assert refused is not None
    assert refused.what == "rotor inertia"


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e-9])
def test_a_fast_small_motion_is_no_standstill_and_no_second_sender(size):
    """A mass on a spring with nine rows in a period, in m, in µm and in nm, with and without stated noise."""
    t = np.arange(1500) / 610.0
    random, pace = np.random.default_rng(0), 2 * np.pi * 68.0
    exact = size * (np.sin(pace * t) + 0.1 * np.sin(pace * t + 1.0))
    record = Record(t, np.zeros((1500, 1)), (exact + 1e-3 * size * random.normal(size=1500))[:, None])
    spring = models.ModelFile("spring", models.oscillator(stiffness=pace**2), measurement_std=1e-3 * size)
    spring = spring._replace(columns=spring.columns._replace(q=("q",), u=("u",)))
    for file in (spring, spring._replace(measurement_std=None)):
        done = diagnose(file, record)
        assert (done.findings, done.skipped) == ((), ())
    late = diagnose(spring, record._replace(t=1e3 * t))
    assert whats(late) == ["unit of time"]
