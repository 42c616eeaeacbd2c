"""What takes long of `test_servo_fit.py`."""

from typing import Any

import numpy as np
import pytest
from test_servo_fit import HELD, TICK, TRUTH, arm, simulated

import covariant
from covariant.signals import Record


def rows(result: Any) -> dict[str, dict[str, Any]]:
    return {row["name"].removeprefix("servo.elbow."): row for row in result.summary["parameters"]}


def assert_near(result: Any, truth: dict[str, float], least: int) -> None:
    determined = {name: row for name, row in rows(result).items() if row["determined"]}
    assert len(determined) >= least, rows(result)
    for name, row in determined.items():
        assert abs(row["after"] - truth[name]) < 4 * row["standard_error"], (name, row)


@pytest.mark.exhaustive
def test_numbers_of_a_servo_are_found_through_delay_ticks_and_friction(arm):
    result = covariant.fit(arm(), simulated(), "servo")
    assert result.better
    assert_near(result, TRUTH, 5)
    assert rows(result)["delay"]["after"] == pytest.approx(0.033, abs=0.003)
    assert "open loop" in str(result)
    assert result.summary["held_out_errors"]["after"]["position"][0] < 2 * TICK


@pytest.mark.exhaustive
def test_a_servo_that_counts_the_other_way_is_not_fitted_away(arm):
    """Commands of the wrong sign are no motion of these commands: no numbers predict what is held out."""
    record = simulated(20.0)
    wrong = Record(record.t, -np.asarray(record.u), record.y)
    result = covariant.fit(arm(), wrong, "servo.stiffness,servo.delay")
    assert max(result.summary["held_out_errors"]["after"]["position"]) > 30 * TICK
    assert "as no servo does" in result.summary["suspicion"]


@pytest.mark.exhaustive
def test_logs_with_other_gains_share_the_numbers_of_the_servo(arm):
    gains = (0.5, 2.0, 1.0)
    logs = [simulated(16.0, gain=gain, seed=i) for i, gain in enumerate(gains)]
    settings = [{"servo.elbow.gain": gain} for gain in gains]
    known = {key: TRUTH[key] for key in ("damping", "feedforward", "viscous", "armature", "delay")}
    result = covariant.fit(arm(**known), logs, "servo.stiffness,servo.coulomb", overrides=settings)
    assert_near(result, TRUTH, 2)
    assert "gain" not in result.content["servo"]["elbow"]  # what holds for one log alone is not written


@pytest.mark.exhaustive
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


@pytest.mark.core(15)
@pytest.mark.parametrize("limit", [np.inf, 2.5])
def test_a_limit_is_found_where_the_log_reaches_it_and_else_its_least_value(arm, limit):
    known = {key: TRUTH[key] for key in ("viscous", "armature")}
    names = ",".join(f"servo.{key}" for key in ("stiffness", "damping", "delay", "coulomb", "limit"))
    log = simulated(16.0, limit=limit, feedforward=0.0)
    # The first limit is below what the steps demand, and cuts torques that the servo of the log gives.
    result = covariant.fit(arm(**known, limit=2.0), log, names, overrides=HELD)
    rows = {row["name"].rpartition(".")[2]: row for row in result.summary["parameters"]}
    for key in ("stiffness", "damping", "delay", *["limit"] * (limit < np.inf)):
        assert rows[key]["determined"], key
        assert abs(rows[key]["after"] - (TRUTH | {"limit": limit})[key]) < 4 * rows[key]["standard_error"], rows[key]
    beyond = [each for each in result.summary["undetermined"] if "servo.elbow.limit is at least" in each]
    assert len(beyond) == (limit == np.inf)
    if beyond:
        assert not rows["limit"]["determined"]
        # A command acts 3.3 rows after its stamp; the fit sees two thirds of the log.
        seen = 2 * len(log.t) // 3
        demanded = TRUTH["stiffness"] * np.abs(log.u[: seen - 4] - log.y[4:seen]).max()
        least = float(beyond[0].split()[4])
        assert least == pytest.approx(demanded, rel=0.1)
        assert rows["limit"]["after"] > least


@pytest.mark.long
def test_logs_in_which_the_joint_stands_still_tell_nothing_of_the_errors_of_others(arm):
    known = {key: TRUTH[key] for key in ("damping", "feedforward", "delay", "viscous", "armature")}
    still = Record(np.arange(600) / 100, np.full((600, 1), 0.01), np.zeros((600, 1)))
    logs = [still, still, simulated(6.0), still, simulated(6.0, seed=1)]
    result = covariant.fit(arm(**known), logs, "servo.stiffness,servo.coulomb", overrides=HELD, anyway=True)
    truth = np.array([TRUTH["stiffness"], TRUTH["coulomb"]])
    assert (np.abs(result.values - truth) < np.maximum(4 * result.standard_errors, 0.02 * truth)).all(), result
