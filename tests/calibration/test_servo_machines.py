"""The machines of the benchmark, which judge fits of servos: their bodies, servos and friction are what they state."""

import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

bench = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "servo_machines.py"))
Servo, simulate, two_joints, quadruped = (bench[name] for name in ("Servo", "simulate", "two_joints", "quadruped"))
EARTH = 9.81


def held(machine, seconds, rate=100.0, at=None):
    """Stamps, and commands that stand still."""
    t = np.arange(int(seconds * rate)) / rate
    return t, np.tile(machine.middle if at is None else at, (len(t), 1))


def shoulder_weight(q):
    """Torque of the weight of the two links on the shoulder, and of the lower one on the elbow, by hand."""
    upper, lower = np.sin(q[0]), np.sin(q[0] + q[1])
    elbow = -EARTH * 0.1 * 0.05 * lower
    return np.array([-EARTH * (0.12 * 0.06 + 0.1 * 0.12) * upper + elbow, elbow])


def test_a_servo_sags_by_the_torque_over_its_stiffness():
    machine, stiffness = two_joints(), np.array([4.0, 2.0])
    servo = Servo.of(2, stiffness=stiffness, damping=0.2, armature=0.01, offset=[0.03, -0.02], delay=0.05)
    log = simulate(machine, servo, *held(machine, 4.0), ticks=False)
    sag = log.position[-1] - machine.middle - servo.offset
    np.testing.assert_allclose(sag, shoulder_weight(log.position[-1]) / stiffness, rtol=1e-4)
