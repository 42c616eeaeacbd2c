"""What `check` says of logs of servos that are told positions: right ones, and ones with one fault."""

import numpy as np
import pandas
import pytest
import servo_logs
from servo_logs import JOINTS, NAMES, URDF, made, with_fault

import covariant
from covariant import models
from covariant.calibration import diagnose, misfit
from covariant.signals import Record

OF_NUMBERS = ("row early", "row late")
"""Faults that show against the right numbers of the servos alone; others show with first guesses."""


def model(path, arm=None):
    """The arm with first guesses at its servos, or with their right numbers."""
    (path / "arm.urdf").write_text(URDF)
    lines = ['system = "robot"', 'parameters.path = "arm.urdf"', f"measurement.quantum = {servo_logs.TICK}"]
    for i, joint in enumerate(JOINTS):
        lines += [f"[servo.{joint}]", f"stiffness = {arm.stiffness[i] if arm else 1.0}"]
        if arm:
            keys = ("damping", "offset", "armature")
            lines += [f"{key} = {getattr(arm, key)[i]}" for key in keys] + [f"coulomb = {arm.friction[i]}"]
            lines += [f"delay = {arm.delay}"]
    (path / "arm.toml").write_text("\n".join(lines))
    return str(path / "arm.toml")


def wrong(findings):
    return [(each.what, each.where, each.evidence) for each in findings if each.wrong]


@pytest.mark.exhaustive("4-True", "7-True")
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_a_log_without_faults_is_not_called_wrong(seed, known, tmp_path):
    log = made(seed)
    file = models.load(model(tmp_path, log.arm if known else None))
    record = Record(log.t, log.commands, log.readings)
    found = diagnose(file, record).findings
    assert wrong(found) == []
    assert misfit(file, record) is None
    assert known != any(each.what == "servo" and "covariant fit" in each.line for each in found)


@pytest.mark.parametrize("kind", NAMES)
def test_a_fault_of_a_servo_is_named_first(kind, tmp_path):
    log = with_fault(kind, 1)
    file = models.load(model(tmp_path, log.arm if kind in OF_NUMBERS else None))
    found = wrong(diagnose(file, Record(log.t, log.commands, log.readings)).findings)
    assert [name for name, *_ in found[:1]] == [log.name], found
    assert log.joint in found[0][1], found


@pytest.mark.exhaustive("off-until = 13.")
@pytest.mark.parametrize(("kind", "line"), [("sign", "[units] u = "), ("off", "until = 13.")])
def test_a_remedy_is_pasted_and_checked_again(kind, line, tmp_path):
    log = with_fault(kind, 1)
    columns = {"t": log.t, **dict(zip(JOINTS, log.readings.T, strict=True))}
    columns |= {f"cmd_{joint}": each for joint, each in zip(JOINTS, log.commands.T, strict=True)}
    pandas.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    result = covariant.check(model(tmp_path), str(tmp_path / "log.csv"))
    first = result.findings[0]
    assert first.what == log.name
    assert first.line.startswith(line), first.line


def test_the_time_at_which_a_servo_lets_go_is_named(tmp_path):
    log = with_fault("off", 1)
    found = diagnose(models.load(model(tmp_path)), Record(log.t, log.commands, log.readings)).findings[0]
    (begin, end), *more = found.numbers["off"]
    assert (begin, end) == pytest.approx((13.41, log.t[-1]), abs=0.15)
    assert not more


def test_a_switch_that_says_so_is_no_fault(tmp_path):
    log = with_fault("off", 1)
    path = model(tmp_path)
    file = models.load(path, {"servo.lift.switch": True})
    on = np.where(log.t < 13.41, 1.0, 0.0)
    record = Record(log.t, np.column_stack([log.commands, on]), log.readings)
    assert wrong(diagnose(file, record).findings) == []
