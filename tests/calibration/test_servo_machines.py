"""The machines of the benchmark, which judge fits of servos: their bodies, servos and friction are what they state."""

import os
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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

    def rate(q, v):
        return v, np.asarray(acceleration(q, v))

    for _ in range(60):
        a = rate(q, v)
        b = rate(q + h / 2 * a[0], v + h / 2 * a[1])
        c = rate(q + h / 2 * b[0], v + h / 2 * b[1])
        d = rate(q + h * c[0], v + h * c[1])
        q, v = (x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip((q, v), a, b, c, d, strict=True))
    assert np.abs(log.velocity).max() > 3
    np.testing.assert_allclose(log.position[100], q, atol=2e-4)
    np.testing.assert_allclose(log.velocity[100], v, atol=4e-3)


def test_a_servo_sags_by_the_torque_over_its_stiffness():
    machine, stiffness = two_joints(), np.array([4.0, 2.0])
    servo = Servo.of(2, stiffness=stiffness, damping=0.2, armature=0.01, offset=[0.03, -0.02], delay=0.05)
    log = simulate(machine, servo, *held(machine, 4.0), ticks=False)
    sag = log.position[-1] - machine.middle - servo.offset
    np.testing.assert_allclose(sag, shoulder_weight(log.position[-1]) / stiffness, rtol=1e-4)


def test_friction_holds_below_its_bound_for_good_and_lets_go_above_it():
    """Load-dependent friction of both kinds: the bound at rest is known by hand."""
    machine = two_joints()
    weight = shoulder_weight(machine.middle)
    # The command holds with no torque, so that the friction bears the weight by itself, or does not.
    numbers = {"stiffness": 1e-9, "armature": 0.01, "coulomb": 0.01, "stribeck": 0.02}
    for factor, holds in ((1.02, True), (0.98, False)):
        needed = (factor * np.abs(weight) - 0.03) / np.abs(weight)
        servo = Servo.of(2, **numbers, load_external=needed)
        log = simulate(machine, servo, *held(machine, 10.0), ticks=False)
        moved = np.abs(log.position[-1] - log.position[50])
        assert (moved < 1e-5).all() if holds else (moved > 0.01).any(), (factor, moved)


def test_the_torque_of_a_motor_loads_its_friction():
    machine = two_joints()
    weight = shoulder_weight(machine.middle)
    # A position error of .1 rad pulls upward more than the weight pulls down; the difference is what friction bears.
    up = np.array([6.0, 2.0]) * 0.1
    rest = up + weight
    for factor, holds in ((1.03, True), (0.97, False)):
        servo = Servo.of(2, stiffness=[6.0, 2.0], armature=0.01, load=factor * np.abs(rest) / up)
        log = simulate(machine, servo, *held(machine, 2.0, at=machine.middle + 0.1), q0=machine.middle, ticks=False)
        moved = np.abs(log.position[-1] - log.position[0])
        assert (moved < 1e-5).all() if holds else (moved > 1e-3).any(), (factor, moved)


@pytest.mark.parametrize("delay", [0.002, 0.0137, 0.1])
def test_a_command_acts_its_delay_after_its_stamp_within_a_step_of_the_simulation(delay):
    """A joint without damping and weight answers a step by k e (t − delay)²/2 over its inertia."""
    machine = two_joints()
    machine = machine._replace(middle=np.zeros(2))
    t, moves = held(machine, 0.4, rate=200.0)
    moves[20:, 0] = 0.02
    servo = Servo.of(2, stiffness=[3.0, 0.0], armature=[5.0, 1e3], delay=delay)
    log = simulate(machine, servo, t, moves, ticks=False)
    # Both links hang at rest, so the inertia is that of the rotor and of the links, nearly constant.
    inertia = 5.0 + 2e-4 + 0.12 * 0.06**2 + 1.5e-4 + 0.1 * 0.17**2
    rows = t > t[20] + delay + 0.02
    since = np.sqrt(2 * inertia * log.position[rows, 0] / (3.0 * 0.02))
    np.testing.assert_allclose(since, t[rows] - t[20] - delay, atol=3e-3)
    np.testing.assert_allclose(since[0], (t[rows] - t[20] - delay)[0], atol=2e-4)
    assert np.abs(log.position[t <= t[20] + delay]).max() < 1e-12


def test_the_torque_of_a_servo_ends_at_its_limit():
    machine = two_joints()
    servo = Servo.of(2, stiffness=20.0, damping=0.2, limit=[0.3, 0.2], armature=0.01, coulomb=0.01)
    t, moves = held(machine, 2.0)
    moves[50:] += 0.5
    log = simulate(machine, servo, t, moves)
    assert np.abs(log.torque).max(axis=0).tolist() == [0.3, 0.2]


def test_half_a_step_of_the_simulation_changes_a_log_by_much_less_than_a_tick():
    machine, rng = two_joints(), np.random.default_rng(2)
    servo = bench["draw_servo"](machine, bench["SO101"], rng)._replace(limit=np.array([0.8, 0.5]))
    t, moves = bench["commands"](machine, 9.0, 100.0, rng)
    whole, half = (simulate(machine, servo, t, moves, ticks=False, step=machine.step / k) for k in (1, 4))
    assert (np.abs(whole.torque) == servo.limit).any(), "the servos saturate"
    assert np.sqrt(np.mean((whole.position - half.position) ** 2)) < 0.05 * bench["TICK"]


def test_a_payload_pulls_by_its_weight_where_the_arm_stands_still():
    machine = two_joints()
    servo = Servo.of(2, stiffness=8.0, damping=0.5, armature=0.01)
    log = simulate(machine, servo, *held(machine, 4.0), mass=0.2, ticks=False)
    q = log.position[-1]
    elbow = -EARTH * 0.2 * 0.1 * np.sin(q[0] + q[1])
    pull = [-EARTH * 0.2 * 0.12 * np.sin(q[0]) + elbow, elbow]
    np.testing.assert_allclose(log.external[-1], pull, rtol=1e-4)


def test_the_quadruped_has_four_legs_alike():
    machine = quadruped()
    assert len(machine.joints) == 12
    model = bench["compile_machine"](machine, Servo.of(12))
    np.testing.assert_allclose(model.body_mass[1:].reshape(4, 3), np.tile([0.678, 1.152, 0.194], (4, 1)))


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
