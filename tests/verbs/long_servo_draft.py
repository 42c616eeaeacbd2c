"""What takes long of `test_servo_draft.py`."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import leave, refused
from test_servo_draft import data_set, recorded

import covariant
from covariant import models, verbs

SERVO = {"stiffness": 12.0, "damping": 0.9, "coulomb": 0.02, "delay": 0.04}


SERVOS = {"servo.shoulder": SERVO, "servo.elbow": SERVO}


NOISE = {"uncertainty.acceleration": 20.0, "uncertainty.correlation_time": 0.02}


def matched(result):
    assert result.joints is not None
    return result.joints


@pytest.mark.exhaustive
def test_from_a_data_set_of_lerobot_to_velocities_and_torques(tmp_path):
    settings = {"amplitude": [0.5, 0.4], "frequency": 0.7, "overrides": SERVOS}
    simulated = covariant.simulate("double_pendulum", duration=6.0, rate=50.0, **settings).record
    log = data_set(tmp_path, simulated)
    path = tmp_path / "arm.toml"
    known = {"units.q": "deg", "parameters.path": "double_pendulum"}
    verbs.init(log, overrides=known).save(path)
    table = covariant.estimate(path, log, overrides=NOISE | SERVOS).to_pandas()
    velocity, torque = table.filter(regex="^v[0-9]+$"), table.filter(like="torque_")
    assert list(torque) == ["torque_shoulder", "torque_elbow"]
    q, v = np.split(np.asarray(simulated.x), 2, axis=1)
    model = models.load("double_pendulum", SERVOS).model
    servos = models.robots.servos_in(model)
    assert servos is not None
    late = covariant.signals.acting_inputs(simulated, "held", 0.04).u
    truth = jax.vmap(servos.torque)(jnp.asarray(q), jnp.asarray(v), jnp.asarray(late))
    settled = slice(50, -1)
    for found, true in ((velocity, v), (torque, truth)):
        error = np.asarray(found)[settled] - np.asarray(true)[settled]
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.std(np.asarray(true)[settled])


def test_joints_are_matched_by_name_and_columns_follow_the_robot(tmp_path, recorded):
    swapped = recorded._replace(y=recorded.y[:, ::-1], u=recorded.u[:, ::-1])
    log = data_set(tmp_path, swapped, names=("elbow.pos", "shoulder.pos"), unit=1.0)
    result = verbs.init(log, overrides={"parameters.path": "double_pendulum"})
    assert matched(result).names == ("shoulder", "elbow")
    assert not matched(result).guess
    file = models.load(result.save(tmp_path / "arm.toml"))
    assert file.columns.q == ("observation.state[1]", "observation.state[0]")
    assert file.columns.u == ("action[1]", "action[0]")


def test_joints_of_other_names_are_matched_in_order_and_it_is_said(tmp_path, recorded):
    frame = pd.DataFrame({"t": recorded.t, "q_lift": recorded.y[:, 0], "q_fold": recorded.y[:, 1]})
    frame = frame.assign(cmd_lift=recorded.u[:, 0], cmd_fold=recorded.u[:, 1])
    result = verbs.init(frame, overrides={"parameters.path": "double_pendulum"})
    assert "that shoulder is q_lift, elbow is q_fold is guessed from their order" in str(result)
    (text,) = result.texts().values()
    assert "# That shoulder is q_lift, elbow is q_fold is guessed from their order" in text
    more = frame.assign(q_jaw=recorded.y[:, 0] + 0.1, cmd_jaw=recorded.u[:, 0] + 0.1)
    result = verbs.init(more, overrides={"parameters.path": "double_pendulum"})
    assert "q_jaw have no joint in double_pendulum, and are left out" in str(result)
    assert result.draft.u == ("cmd_lift", "cmd_fold")
    models.load(result.save(tmp_path / "more.toml"))
    fewer = verbs.init(frame[["t", "q_lift", "cmd_lift"]], overrides={"parameters.path": "double_pendulum"})
    file = models.load(fewer.save(tmp_path / "fewer.toml"))
    assert file.model.coordinates == ("shoulder",)
    assert "lock = { elbow = 0.0 }" in fewer.texts()["draft.toml"]


@pytest.mark.exhaustive
def test_a_servo_that_is_off_has_no_torque(tmp_path, recorded):
    on = np.where(np.arange(len(recorded.t)) % 200 < 150, 1.0, 0.0)
    frame = pd.DataFrame({"t": recorded.t, "q": recorded.y[:, 0], "cmd": recorded.u[:, 0], "torque_enabled": on})
    path = verbs.init(frame).save(tmp_path / "draft.toml")
    estimate = covariant.estimate(path, frame, anyway=True, overrides=NOISE).to_pandas()
    assert (estimate["torque_q"][160:198] == 0).all()
    assert (estimate["torque_q"][10:140] != 0).all()


def test_a_joint_without_a_command_is_free(tmp_path, recorded):
    frame = pd.DataFrame({"t": recorded.t, "q_a": recorded.y[:, 0], "q_b": recorded.y[:, 1]})
    result = verbs.init(frame.assign(cmd_a=recorded.u[:, 0]))
    assert "q_b have no command" in str(result)
    file = models.load(result.save(tmp_path / "draft.toml"))
    assert (file.model.coordinates, file.columns.u) == (("a", "b"), ("cmd_a",))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"parameters.mass": 1.0}, "parameters.mass is no value of a draft; write it into its file. There are units.t"),
        ({"parameters.path": "nothing.urdf"}, "nothing.urdf: No such file"),
        ({"units.q": "kg"}, "unit 'kg' is no unit of q"),
    ],
)
def test_values_that_are_given_to_a_draft_are_checked(overrides, message, recorded):
    frame = pd.DataFrame({"t": recorded.t, "q": recorded.y[:, 0], "cmd": recorded.u[:, 0]})
    with pytest.raises(ValueError, match=re.escape(message)):
        verbs.init(frame, overrides=overrides)
    with pytest.raises(ValueError, match="no commands of servos were found"):
        verbs.init(frame[["t", "q"]], overrides={"parameters.path": "scara"})


def test_the_command_asks_for_a_unit_in_its_own_words(tmp_path, monkeypatch, recorded):
    monkeypatch.chdir(tmp_path)
    init = ("init", data_set(tmp_path, recorded), "-o", "draft.toml")
    asked = "per cent of the range of each servo, as LeRobot logs them"
    refused(*init, named=[asked, "--set 'units.q=\"deg\"'"])
    (tmp_path / "robot.urdf").write_text(models.robots.located("double_pendulum").read_text())
    code, printed, _ = leave(*init, "--set", 'units.q="deg"', "--set", 'parameters.path="robot.urdf"')
    assert code == 0
    assert "commands action[0], action[1]" in printed
    assert models.document("draft.toml")["parameters"]["path"] == "robot.urdf"
