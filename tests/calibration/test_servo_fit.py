"""Servos fitted from commands and positions, against a plain simulation that shares nothing with the library."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration.identification import (
    _robot_combinations,
    _servo_fit,
    _servo_motion,
    predict_servos,
    stick_bands,
)
from covariant.calibration.identification._robot_torques import flattened
from covariant.signals import Record

TICK = 2 * np.pi / 4096
MASS, LENGTH, GRAVITY = 0.5, 0.2, 9.81
URDF = """<robot name="arm"><link name="base"/><link name="hand"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="{axis}"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""
HELD = {"inputs.between": "held"}
TRUTH = {
    "stiffness": 12.0,
    "damping": 0.3,
    "feedforward": 0.2,
    "delay": 0.033,
    "viscous": 0.1,
    "coulomb": 0.15,
    "armature": 0.02,
}
FIRST = {
    "stiffness": 20.0,
    "damping": 0.6,
    "feedforward": 0.0,
    "delay": 0.01,
    "viscous": 0.3,
    "coulomb": 0.05,
    "armature": 0.05,
}


def simulated(
    duration: float = 30.0,
    rate: float = 100.0,
    *,
    hanging: bool = True,
    sign: int = 1,
    gain: float = 1.0,
    limit: float = np.inf,
    band: float = 0.0,
    load: float = 0.0,
    mass: float = MASS,
    ticks: bool = True,
    seed: int = 0,
    **changed: float,
) -> Record:
    """A mass on an arm behind a servo, in steps of 0.2 ms, with friction that stops it within a step."""
    truth = {**TRUTH, **changed}
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1 / rate)
    phases = rng.uniform(0, 2 * np.pi, 6)
    command = sum(
        0.12 * np.sin(2 * np.pi * f * t + p) for f, p in zip((0.1, 0.23, 0.5, 0.9, 1.4, 2.3), phases, strict=True)
    )
    command = np.where((t % 8) > 5, np.sign(np.sin(2 * np.pi * 0.7 * t)) * 0.3, command)
    h, n = 2e-4, round(duration / 2e-4)
    inertia = mass * LENGTH**2 + 1e-6 + truth["armature"]
    q, v, before, measured = 0.0, 0.0, 0.0, np.zeros_like(t)
    k = 0
    for i in range(n):
        now = i * h
        if k < len(t) and now >= t[k] - 1e-9:
            measured[k] = sign * q
            k += 1
        mean = v + (v - before) / 2  # of the speeds before and after: v is that half a step ago
        acting = now - truth["delay"]
        row = min(max(int(acting * rate + 1e-9), 0), len(t) - 1)
        slope = (command[row] - command[max(row - 1, 0)]) * rate
        error = command[row] + truth["feedforward"] / (gain * truth["stiffness"]) * slope - q
        error -= min(max(error, -band), band)
        torque = min(max(gain * truth["stiffness"] * error - truth["damping"] * mean, -limit), limit)
        weight = -mass * GRAVITY * LENGTH * np.sin(q) if hanging else 0.0
        size = truth["coulomb"] + load * abs(torque)
        free = inertia * v + h * (torque + weight - truth["viscous"] * mean)
        before = v
        v = (free - min(max(free, -h * size), h * size)) / inertia
        q += h * v
    assert k == len(t)
    y = np.round(measured / TICK) * TICK if ticks else measured
    return Record(t, sign * command[:, None], y[:, None])


@pytest.fixture
def arm(tmp_path) -> Any:
    """Writes the model file of the arm with first values of its servo."""

    def write(hanging: bool = True, **servo: Any) -> str:
        urdf = URDF.format(z=-LENGTH if hanging else 0.0, mass=MASS, axis="0 1 0" if hanging else "0 0 1")
        (tmp_path / "arm.urdf").write_text(urdf)
        lines = [f"{key} = {value}" for key, value in {**FIRST, **servo}.items()]
        path = tmp_path / "arm.toml"
        path.write_text('system = "robot"\n[parameters]\npath = "arm.urdf"\n[servo.elbow]\n' + "\n".join(lines) + "\n")
        return str(path)

    return write


def test_a_log_in_which_nothing_moves_is_not_fitted(arm):
    t = np.arange(0.0, 20.0, 0.02)
    still = Record(t, np.full((len(t), 1), 0.1), np.full((len(t), 1), 0.1))
    with pytest.raises(covariant.verbs.MisfitError, match="log a motion"):
        covariant.fit(arm(), still, "servo.stiffness")


def test_what_is_fitted_is_the_same_in_all_logs(arm):
    logs = [simulated(4.0, seed=i) for i in range(2)]
    with pytest.raises(ValueError, match=r"servo\.elbow\.stiffness is fitted"):
        covariant.fit(arm(), logs, "servo.stiffness", overrides=[{}, {"servo.elbow.stiffness": 3.0}])
    with pytest.raises(ValueError, match="2 logs and values for 1"):
        covariant.fit(arm(), logs, "servo.stiffness", overrides=[{}])


def test_a_log_of_three_seconds_gives_intervals(arm):
    known = {key: TRUTH[key] for key in ("damping", "feedforward", "delay", "viscous", "armature")}
    result = covariant.fit(arm(**known), simulated(3.3), "servo.stiffness,servo.coulomb")
    truth = np.array([TRUTH["stiffness"], TRUTH["coulomb"]])
    assert result.better
    assert (np.abs(result.values - truth) < np.maximum(4 * result.standard_errors, 0.02 * truth)).all()


def test_a_delay_and_a_damping_relative_to_the_stiffness_are_alike():
    numbers = [SimpleNamespace(group="servo", target="a", number=key) for key in ("stiffness", "damping", "delay")]
    names, first = tuple(f"servo.a.{each.number}" for each in numbers), jnp.array([20.0, 1.2, 0.02])
    family: Any = SimpleNamespace(names=names, numbers=numbers, values=lambda x: first + x)
    # Errors of the scale of all torques, of the lag damping / stiffness, and of the delay.
    parts = np.array([[20.0, 1.2, 0.0], [0.0, 20.0, -1.0], [0.0, 0.0, 1.0]]) * np.array([[0.5], [0.01], [0.002]])
    (found,) = _robot_combinations.late_alike(family, np.zeros(3), parts.T @ parts)
    assert found[:2] == ("servo.a.delay", "servo.a.damping")
    assert found[2] == pytest.approx(-1 / np.hypot(1, 0.2))
    parts[2] *= 10
    assert _robot_combinations.late_alike(family, np.zeros(3), parts.T @ parts) == ()


def stops(command, start, weight, stiffness, friction, load):
    """Where a joint stops that is released at rest at `start`, with dry friction that grows with the torque."""
    q, v, h, damping, inertia = start, 0.0, 2e-3, 1.0, 0.05
    for _ in range(600):
        torque = stiffness * (command - q)
        size = h * (friction + load * abs(torque))
        free = inertia * v + h * (torque - weight(q) - damping * v)
        v = (free - min(max(free, -size), size)) / inertia
        q += h * v
    assert v == 0
    return q


@pytest.mark.parametrize(("hanging", "load"), [(False, 0.0), (True, 0.3)])
def test_a_joint_stops_within_the_band_in_which_friction_holds_it(hanging, load, arm):
    known = {"stiffness": 12.0, "coulomb": 0.1, "stribeck": 0.05, "stribeck_velocity": 0.1, "load": load}
    family = models.robot_family(arm(hanging, **known), ["servo.elbow.damping"])
    rng, inside, widest = np.random.default_rng(0), [], 0.0
    weight = lambda q: MASS * GRAVITY * LENGTH * np.sin(q) * hanging  # noqa: E731
    for _ in range(40):
        command = rng.uniform(-0.8, 0.8)
        q = stops(command, command + rng.uniform(-0.3, 0.3), weight, 12.0, 0.15, load)
        record = Record(np.arange(20) / 50, np.full((20, 1), command), np.full((20, 1), q))
        (band,) = {float(f"{each:.6g}") for each in stick_bands(family, np.zeros(1), record)[:, 0]}
        # Friction that grows with the torque holds more above the weight than below it.
        ends = ((weight(q) + sign * 0.15) / (1 - sign * load * np.sign(weight(q) + sign * 0.15)) for sign in (1, -1))
        high, low = (command - each / 12.0 for each in ends)
        assert band == pytest.approx((low - high) / 2, rel=1e-4)
        inside.append(abs(q - (low + high) / 2) <= 1.001 * band)
        widest = max(widest, abs(q - (low + high) / 2) / band)
    assert np.mean(inside) >= 0.95
    assert widest > 0.9


def test_friction_of_motor_and_weight_both_hold_a_joint(arm):
    model = arm(stiffness=12.0, coulomb=0.15, load=0.3, load_external=0.2)
    family, still = models.robot_family(model, ["servo.elbow.damping"]), np.full((20, 1), np.pi / 2)
    band = stick_bands(family, np.zeros(1), Record(np.arange(20) / 50, still, still))
    weight = MASS * GRAVITY * LENGTH
    high, low = (1.2 * weight + 0.15) / (1 - 0.3), (0.8 * weight - 0.15) / (1 + 0.3)
    assert band == pytest.approx((high - low) / 2 / 12.0, rel=1e-3)


def test_a_step_damps_a_velocity_as_exactly_as_time_does():
    z = np.array([-0.5, 0.0, 1e-6, 1e-3, 0.1, 1.0, 10.0, 300.0])
    share = np.asarray(_servo_motion._share_of_new(jnp.asarray(z)))
    # The velocity after a step of v' = −z v with this share of the new velocity, which never rings.
    assert (1 - (1 - share) * z) / (1 + share * z) == pytest.approx(np.exp(-z), rel=1e-6, abs=1e-14)
    assert share[1] == 0.5


def test_a_term_that_is_zero_at_first_is_a_part_of_the_robot(arm):
    family = models.robot_family(arm(load=0.0), ["servo.elbow.load"])
    at, robot = flattened(family)
    assert robot(at(np.array([0.3]))).force.servos.load == pytest.approx(0.3)
    still = np.full((20, 1), 0.1)
    assert predict_servos(family, np.array([0.3]), Record(np.arange(20) / 50, still, still)).shape == (20, 1)


def test_another_minimum_widens_the_intervals_by_how_probable_it_is():
    losses = {0.0: 10.0, 2.0: 10.0, 4.0: 1000.0}
    points: list[Any] = [
        SimpleNamespace(z=np.array([at, 0.0]), blocks=SimpleNamespace(rest=[at], overdispersion=2.0)) for at in losses
    ]
    point, *others = points
    search: Any = SimpleNamespace(
        joints=(np.zeros(1, int), np.zeros(2, int)),
        one_sided=np.zeros(2, bool),
        by_part=lambda at: np.array([losses[at]]),
    )
    for minima in ([point], [point, others[1]]):  # itself, and one that is far worse
        assert _servo_fit._Search.between(search, point, minima) == pytest.approx(np.zeros((2, 2)), abs=1e-12)
    found = _servo_fit._Search.between(search, point, [point, *others])
    assert found == pytest.approx(np.diag([0.5 * 2.0**2, 0.0]))  # two alike: half of the time 2 away
