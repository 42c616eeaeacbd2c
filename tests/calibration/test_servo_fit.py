"""Servos fitted from commands and positions, against a plain simulation that shares nothing with the library."""

from typing import Any

import numpy as np
import pytest

import covariant
from covariant.signals import Record

TICK = 2 * np.pi / 4096
MASS, LENGTH, GRAVITY = 0.5, 0.2, 9.81
URDF = """<robot name="arm"><link name="base"/><link name="hand"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="{axis}"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""
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


def rows(result: Any) -> dict[str, dict[str, Any]]:
    return {row["name"].removeprefix("servo.elbow."): row for row in result.summary["parameters"]}


def assert_near(result: Any, truth: dict[str, float], least: int) -> None:
    determined = {name: row for name, row in rows(result).items() if row["determined"]}
    assert len(determined) >= least, rows(result)
    for name, row in determined.items():
        assert abs(row["after"] - truth[name]) < 4 * row["standard_error"], (name, row)


def test_numbers_of_a_servo_are_found_through_delay_ticks_and_friction(arm):
    result = covariant.fit(arm(), simulated(), "servo")
    assert result.better
    assert_near(result, TRUTH, 5)
    assert rows(result)["delay"]["after"] == pytest.approx(0.033, abs=0.003)
    assert "open loop" in str(result)
    assert result.summary["held_out_errors"]["after"]["position"][0] < 2 * TICK


@pytest.mark.long
def test_a_servo_that_counts_the_other_way_is_not_fitted_away(arm):
    """Commands of the wrong sign are no motion of these commands: no numbers predict what is held out."""
    record = simulated(20.0)
    wrong = Record(record.t, -np.asarray(record.u), record.y)
    result = covariant.fit(arm(), wrong, "servo.stiffness,servo.delay")
    assert max(result.summary["held_out_errors"]["after"]["position"]) > 30 * TICK
    assert "as no servo does" in result.summary["suspicion"]


def test_a_log_in_which_nothing_moves_is_not_fitted(arm):
    t = np.arange(0.0, 20.0, 0.02)
    still = Record(t, np.full((len(t), 1), 0.1), np.full((len(t), 1), 0.1))
    with pytest.raises(covariant.workflow.MisfitError, match="log a motion"):
        covariant.fit(arm(), still, "servo.stiffness")


@pytest.mark.long
def test_logs_with_other_gains_share_the_numbers_of_the_servo(arm):
    gains = (0.5, 2.0, 1.0)
    logs = [simulated(16.0, gain=gain, seed=i) for i, gain in enumerate(gains)]
    settings = [{"servo.elbow.gain": gain} for gain in gains]
    known = {key: TRUTH[key] for key in ("damping", "feedforward", "viscous", "armature", "delay")}
    result = covariant.fit(arm(**known), logs, "servo.stiffness,servo.coulomb", overrides=settings)
    assert_near(result, TRUTH, 2)
    assert "gain" not in result.content["servo"]["elbow"]  # what holds for one log alone is not written


def test_what_is_fitted_is_the_same_in_all_logs(arm):
    logs = [simulated(4.0, seed=i) for i in range(2)]
    with pytest.raises(ValueError, match=r"servo\.elbow\.stiffness is fitted"):
        covariant.fit(arm(), logs, "servo.stiffness", overrides=[{}, {"servo.elbow.stiffness": 3.0}])
    with pytest.raises(ValueError, match="2 logs and values for 1"):
        covariant.fit(arm(), logs, "servo.stiffness", overrides=[{}])


@pytest.mark.long
def test_stiffness_and_inertia_without_weight_act_by_their_ratio(arm):
    record = simulated(20.0, hanging=False, feedforward=0.0, viscous=0.0)
    names = "servo.stiffness,servo.armature,servo.damping,servo.coulomb"
    start = {"delay": TRUTH["delay"], "feedforward": 0.0, "viscous": 0.0}
    result = covariant.fit(arm(hanging=False, **start), record, names)
    assert not any(rows(result)[name]["determined"] for name in ("stiffness", "armature"))
    said = " ".join(result.summary["undetermined"])
    assert "elbow act by their ratio alone" in said
    assert "known mass" in said


SERVO = {
    **{"stiffness": 12.0, "damping": 0.5, "feedforward": 0.3, "delay": 0.03, "coulomb": 0.06, "stribeck": 0.03},
    **{"stribeck_velocity": 0.05, "load_external": 0.3, "armature": 0.01},
}
SERVOS = {
    "rotation": "shoulder_pan",
    "pitch": "shoulder_lift",
    "elbow": "elbow_flex",
    "wrist_pitch": "wrist_flex",
    "wrist_roll": "wrist_roll",
}
REACHED = {"step_response": (14.0, 6.0, 5.0, 2.5, 5.0), "slow_precision": (4.0, 5.0, 18.0, 6.0, 6.0)}
"""Open-loop errors [mrad] below which the five joints of a recorded arm must stay."""


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", REACHED)
def test_a_recorded_arm_is_predicted_open_loop(data_folder, tmp_path, name):
    tables = [
        f"[servo.{joint}]\n" + "".join(f"{key} = {value}\n" for key, value in SERVO.items())
        for joint in SERVOS.values()
    ]
    q, u = ([f"{kind}_{column}" for column in SERVOS] for kind in ("q", "cmd"))
    path = tmp_path / "so101.toml"
    path.write_text(
        'system = "robot"\n[parameters]\npath = "so101"\nlock = {gripper = 0.5}\n'
        f'[columns]\nt = "t"\nq = {q}\nu = {u}\n'.replace("'", '"')
        + "".join(tables)
    )
    logs = [str(data_folder / "so101" / f"{log}.csv") for log in ("multisine", "friction_gravity", name)]
    result = covariant.fit(str(path), logs, "servo")
    errors = np.array(result.summary["held_out_errors"]["after"]["position"])
    assert (1e3 * errors < REACHED[name]).all(), errors
