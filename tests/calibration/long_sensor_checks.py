"""What is wrong with a sensor beside the positions is named, and right ones are left in peace."""

import json

import numpy as np
import pandas
import pytest

import covariant
from covariant import models, observers
from covariant.calibration import Beside
from covariant.calibration.diagnosis._case import case_without_outliers
from covariant.calibration.diagnosis._sensor_checks import sensor_checks
from covariant.logs import Columns
from covariant.signals import Record

CHAIN = """
system = "pendulum_chain"
[parameters]
mass = [1.0, 0.6]
length = [0.5, 0.4]
viscous = [0.05, 0.02]
[columns]
q = ["q1", "q2"]
[measurement]
std = 1e-3
[sensors.rate]
kind = "tachometer"
of = ["q1", "q2"]
columns = ["rate 1", "rate 2"]
units = "deg/s"
std = 0.02
bias = 0.05
[sensors.motor]
kind = "encoder"
of = ["q2"]
columns = ["motor"]
reduction = 20.0
std = 1e-2
"""
ROBOT = """
system = "robot"
[parameters]
path = "double_pendulum"
[measurement]
std = 1e-3
[sensors.imu]
kind = "gyro"
link = "lower"
columns = ["wx", "wy", "wz"]
std = 0.01
"""
CAMERA = """
[sensors.camera]
kind = "pose"
link = "lower"
columns = ["cx", "cy", "cz", "cw", "ci", "cj", "ck"]
attitude = "quaternion_wxyz"
position_std = 2e-3
rotation_std = 5e-3
delay = 0.02
[sensors.acc]
kind = "accelerometer"
link = "lower"
place = [0.0, 0.0, -0.5]
columns = ["ax", "ay", "az"]
std = 0.05
bias = 0.1
"""
RATES, SPINS, FELT = ["rate 1", "rate 2"], ["wx", "wy", "wz"], ["ax", "ay", "az"]


def simulated(folder, text, rate, seed=1):
    path = folder / "model.toml"
    path.write_text(text)
    noise = {"noise": 1e-3, "seed": seed, "duration": 3.0, "rate": rate}
    log = covariant.simulate(str(path), q0=[0.6, -0.4], amplitude=[0.3, 0.2], **noise)
    return str(path), pandas.DataFrame(log.columns)


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("chain"), CHAIN, 500.0)


def late(frame, names, delay):
    return np.stack([np.interp(frame.t - delay, frame.t, frame[name]) for name in names], axis=1)


def changed(frame, names, values):
    frame = frame.copy()
    frame[names] = np.asarray(values)
    return frame


def wrong(path, frame):
    found = covariant.check(path, frame).findings
    return [(each.what, each.where, each.line) for each in found if each.wrong]


FAULTS = {
    "all signs": (RATES, lambda f: -f[RATES], "sign of a sensor", 'units = "-1 deg/s"'),
    "a sign": (["rate 2"], lambda f: -f[["rate 2"]], "sign of a sensor", 'units = ["deg/s", "-1 deg/s"]'),
    "columns": (RATES, lambda f: f[RATES[::-1]], "axes of a sensor", 'columns = ["rate 2", "rate 1"]'),
    "unit": (RATES, lambda f: np.deg2rad(f[RATES]), "unit of a sensor", 'units = "rad/s"'),
    "gear": (["motor"], lambda f: 1.5 * f[["motor"]], "unit of a sensor", "reduction = 30"),
    "delay": (RATES, lambda f: late(f, RATES, 5e-3), "delay of a sensor", "delay = 0.005"),
    "bias": (["rate 1"], lambda f: f[["rate 1"]] + 40.0, "bias of a sensor", "bias = 0.7"),
    "noise": (
        *(["motor"], lambda f: f[["motor"]] + np.random.default_rng(0).normal(size=(len(f), 1))),
        *("noise of a sensor", "std = 0.98"),
    ),
}


@pytest.mark.exhaustive("columns", "all signs")
@pytest.mark.parametrize("fault", FAULTS)
def test_one_fault_is_one_finding_with_its_setting(chain, fault):
    path, frame = chain
    names, change, what, line = FAULTS[fault]
    found = wrong(path, changed(frame, names, change(frame)))
    assert [each[0] for each in found] == [what]
    assert line in found[0][2]


def test_right_sensors_have_no_findings(chain):
    assert covariant.check(*chain).findings == ()


def test_the_stated_delay_counts(chain, tmp_path):
    path, frame = chain
    text = CHAIN.replace("std = 1e-2", "std = 1e-2\ndelay = 0.03")
    (tmp_path / "late.toml").write_text(text)
    right = changed(frame, ["motor"], late(frame, ["motor"], 0.03))
    assert wrong(str(tmp_path / "late.toml"), right) == []
    assert "delay = 0.03" in wrong(path, right)[0][2]
    early = wrong(str(tmp_path / "late.toml"), frame)
    assert early[0][0] == "delay of a sensor"
    assert float(early[0][2].split("=")[1]) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.exhaustive
def test_what_stands_still_is_not_judged(chain):
    """A rate that does not change shows neither its sign nor its unit."""
    path, frame = chain
    rng = np.random.default_rng(3)
    still = changed(frame, ["q2", "motor"], 1e-3 * rng.normal(size=(len(frame), 2)) * [1.0, 10.0])
    still["rate 2"] = -np.rad2deg(0.02 * rng.normal(size=len(frame)))
    found = {each.where: each for each in covariant.check(path, still).findings if each.what == "sensor not judged"}
    assert "rate 2" in found["rate"].evidence
    assert not found["rate"].wrong
    assert all("sensor" not in each[0] for each in wrong(path, still))


@pytest.mark.exhaustive
def test_axes_of_a_gyro(tmp_path):
    """On a plane only the turn that takes the axis of rotation to the one that is read is known."""
    path = tmp_path / "model.toml"
    path.write_text(ROBOT)
    file, t, rng = models.load(str(path)), np.arange(0.0, 3.0, 0.01), np.random.default_rng(4)
    angles = np.stack([0.5 * np.sin(5.0 * t), 0.3 * np.cos(8.0 * t)], axis=1)
    # Both hinges turn about y: the lower link turns with the sum of their rates.
    spin = np.outer(2.5 * np.cos(5.0 * t) - 2.4 * np.sin(8.0 * t), [0.0, 1.0, 0.0])
    y, noise = angles + 1e-3 * rng.normal(size=angles.shape), 0.01 * rng.normal(size=spin.shape)
    case, _ = case_without_outliers(file, Record(t, np.zeros((len(t), 2)), y))

    def judged(readings, axes=None):
        sensor = observers.gyro(case.model.space, "lower", 0.01, axes=axes, name="imu")
        return sensor_checks(case, t, [Beside(sensor, Columns(q=tuple(SPINS)), 0.0, "rad/s", readings)])

    assert [(each.what, each.wrong) for each in judged(spin + noise)] == [("sensor not judged", False)]
    angle = 0.6
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = spin @ turn.T + noise
    found = judged(turned)[0]
    assert found.what == "axes of a sensor"
    assert "not determined" in found.evidence
    np.testing.assert_allclose(np.array(found.numbers["matrix"])[:, 1], turn[:, 1], atol=5e-3)
    # What it says to write is right: with it nothing is wrong.
    axes = json.loads(found.line.split(" = ")[1])
    np.testing.assert_allclose(axes, turn.T, atol=5e-3)
    assert [each.wrong for each in judged(turned, axes)] == [False]


@pytest.mark.exhaustive
def test_faults_of_sensors_in_space(tmp_path):
    path, frame = simulated(tmp_path, ROBOT + CAMERA, 200.0)
    assert wrong(path, frame) == []
    places, turns = ["cx", "cy", "cz"], ["cw", "ci", "cj", "ck"]
    for names, values, what, line in (
        (FELT, frame[FELT] / 9.80665, "unit of a sensor", 'units = "9.80665 m/s^2"'),
        (["ax"], frame[["ax"]] + 2.0, "bias of a sensor", "bias = 1.9"),
        (FELT, frame[["az", "ax", "ay"]], "axes of a sensor", 'columns = ["ay", "az", "ax"]'),
        (places, 1e3 * frame[places], "unit of a sensor", "in units of mm"),
        (turns, frame[["ci", "cj", "ck", "cw"]], "axes of a sensor", 'attitude = "quaternion_xyzw"'),
    ):
        found = wrong(path, changed(frame, names, values))
        assert [each[0] for each in found] == [what]
        assert line in found[0][2]


@pytest.mark.exhaustive("3", "0", "1")
@pytest.mark.parametrize("seed", range(10))
def test_there_are_no_false_alarms(seed, tmp_path):
    path, frame = simulated(tmp_path, CHAIN, (100.0, 200.0, 500.0)[seed % 3], seed)
    assert covariant.check(path, frame).findings == ()
