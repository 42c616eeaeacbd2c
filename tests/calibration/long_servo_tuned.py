"""`tune` on arms of servos: a right model helps and is said to, and one that lacks a limit does not."""

import numpy as np
import pytest
from servo_logs import JOINTS, TICK, URDF, made

import covariant
from covariant.signals import Record


@pytest.mark.exhaustive("None")
@pytest.mark.parametrize("limit", [None, 0.35])
def test_what_is_said_of_a_servo_arm_is_true(limit, tmp_path):
    """Fifty rows a second of a motion of up to 1.6 Hz, of which a window of three rows makes no reference."""
    log = made(0)
    arm = log.arm
    if limit:
        log = made(0, arm=arm._replace(limit=(limit, limit + 0.6)), rate=1 / log.t[1])
    (tmp_path / "arm.urdf").write_text(URDF)
    lines = ['system = "robot"', "[parameters]", 'path = "arm.urdf"', "[measurement]", f"quantum = {TICK}"]
    lines += ["[uncertainty]", "acceleration = 5.0"]
    for i, joint in enumerate(JOINTS):
        lines += [f"[servo.{joint}]", f"stiffness = {arm.stiffness[i]}", f"coulomb = {arm.friction[i]}"]
        lines += [f"{key} = {getattr(arm, key)[i]}" for key in ("damping", "offset", "armature")]
        lines += [f"delay = {arm.delay}"]
    (tmp_path / "arm.toml").write_text("\n".join(lines))
    record = Record(log.t, log.commands, log.readings)
    tuned = covariant.tune(str(tmp_path / "arm.toml"), record, anyway=True)
    tuned.save(tmp_path / "tuned.toml")
    result = covariant.estimate(str(tmp_path / "tuned.toml"), record, anyway=True)
    free = result.without_model
    own, other = (np.mean((v - log.rates)[free.judged] ** 2) for v in (result.velocity, free.velocity))
    assert (own > other) == bool(limit)
    assert free.verdict.is_worse == bool(limit)
    assert free.verdict.is_better != bool(limit)
    assert any("the model does not help" in each for each in tuned.warnings) == bool(limit)
