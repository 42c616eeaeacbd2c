"""What takes long of `test_servo_machines.py`."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain import rk4
from test_servo_machines import Servo, bench, held, simulate, two_joints

from covariant import models


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


def judged(case, folder):
    """The numbers of a fit from usual first values, and errors of velocities over those of the best other filters."""
    first = bench["usual_servo"](case.machine, case.ranges)
    numbers = bench["fit_servo"](folder, case.machine, first, case.log, case.servo, case.ranges)
    ours, theirs = bench["velocity_ratio"](folder, case, numbers.servo)
    return numbers, ours / theirs


@pytest.mark.exhaustive
def test_a_fit_finds_servos_that_mujoco_moves_and_velocities_profit(tmp_path):
    numbers, ratio = judged(bench["draw_case"]("two", 4, seconds=30.0), tmp_path)
    assert len(numbers.within) >= 14, "the log determines most of the numbers"
    assert numbers.within.all(), dict(zip(numbers.names, numbers.error, strict=True))
    assert (ratio <= 0.5).all(), ratio


@pytest.mark.exhaustive
def test_an_so101_in_mujoco_is_fitted_and_its_velocities_profit(tmp_path):
    if not (Path(os.environ.get("COVARIANT_DATA", "/none")) / "so101").exists():
        pytest.skip("COVARIANT_DATA has no so101")
    numbers, ratio = judged(bench["draw_case"]("so101", 2, seconds=40.0), tmp_path)
    assert numbers.within.mean() >= 0.9, dict(zip(numbers.names, numbers.error, strict=True))
    assert (ratio <= 0.5).all(), ratio
