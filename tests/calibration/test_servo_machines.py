"""The machines of the benchmark, which judge fits of servos: their bodies, servos and friction are what they state."""

import os
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain import rk4

from covariant import models

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


def test_without_servos_and_friction_the_bodies_move_as_those_of_the_library(tmp_path):
    machine = two_joints()
    (tmp_path / "two.urdf").write_text(bench["with_payload"](machine, 0.15))
    armature = np.array([0.004, 0.002])
    ours = models.robots.load(str(tmp_path / "two.urdf"), armature=dict(zip(machine.joints, armature, strict=True)))
    t, still = held(machine, 1.5)
    log = simulate(machine, Servo.of(2, armature=armature), t, still, mass=0.15, ticks=False, step=1e-4)

    # Half-way through, the state and what the library makes of it until the end, by its own step of fourth order.
    q, v, h = log.position[70], log.velocity[70], 0.005
    acceleration = jax.jit(lambda q, v: models.acceleration(ours, jnp.zeros(()), q, v, jnp.zeros(2)))

    x = np.array([q, v])
    for _ in range(60):
        x = rk4(lambda x: np.array([x[1], acceleration(*x)]), x, h)
    q, v = x
    assert np.abs(log.velocity).max() > 3
    np.testing.assert_allclose(log.position[100], q, atol=2e-4)
    np.testing.assert_allclose(log.velocity[100], v, atol=4e-3)


def test_a_servo_sags_by_the_torque_over_its_stiffness():
    machine, stiffness = two_joints(), np.array([4.0, 2.0])
    servo = Servo.of(2, stiffness=stiffness, damping=0.2, armature=0.01, offset=[0.03, -0.02], delay=0.05)
    log = simulate(machine, servo, *held(machine, 4.0), ticks=False)
    sag = log.position[-1] - machine.middle - servo.offset
    np.testing.assert_allclose(sag, shoulder_weight(log.position[-1]) / stiffness, rtol=1e-4)


def judged(case, folder):
    """The numbers of a fit from usual first values, and errors of velocities over those of the best other filters."""
    first = bench["usual_servo"](case.machine, case.ranges)
    numbers = bench["fit_servo"](folder, case.machine, first, case.log, case.servo, case.ranges)
    ours, theirs = bench["velocity_ratio"](folder, case, numbers.servo)
    return numbers, ours / theirs


@pytest.mark.long  # half a minute of a core, most of it to compile
def test_a_fit_finds_servos_that_mujoco_moves_and_velocities_profit(tmp_path):
    numbers, ratio = judged(bench["draw_case"]("two", 4, seconds=30.0), tmp_path)
    assert len(numbers.within) >= 14, "the log determines most of the numbers"
    assert numbers.within.all(), dict(zip(numbers.names, numbers.error, strict=True))
    assert (ratio <= 0.5).all(), ratio


@pytest.mark.long  # half a minute: a fit of 55 numbers
def test_an_so101_in_mujoco_is_fitted_and_its_velocities_profit(tmp_path):
    if not (Path(os.environ.get("COVARIANT_DATA", "/none")) / "so101").exists():
        pytest.skip("COVARIANT_DATA has no so101")
    numbers, ratio = judged(bench["draw_case"]("so101", 2, seconds=40.0), tmp_path)
    assert numbers.within.mean() >= 0.9, dict(zip(numbers.names, numbers.error, strict=True))
    assert (ratio <= 0.5).all(), ratio
