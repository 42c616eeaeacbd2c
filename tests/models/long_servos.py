"""What takes long of `test_servos.py`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_servos import SERVO, arm, law, q, torque, u, v

import covariant
from covariant import models


@pytest.mark.exhaustive
def test_a_switch_and_a_logged_supply_are_inputs():
    drive = {"supply": 8.0, "resistance": 4.0, "torque_constant": 0.5}
    file = arm(**drive, switch=True, logged_supply=True)
    assert file.columns.u == ("cmd_shoulder", "cmd_elbow", "on_shoulder", "volts_shoulder")
    assert file.model.logged_units["u"] == ("rad", "rad", "1", "V")
    for on, volts in ((1.0, 8.0), (1.0, 6.0), (0.0, 6.0)):
        found = torque(file.model, q, v, jnp.array([0.5, -0.1, on, volts]))
        expected = law(0.3, 0.4, 0.5, limit=1.0, back_emf=0.0625, on=on, part=volts / 8)
        assert found[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.exhaustive
def test_friction_grows_with_the_load_of_the_gear():
    model, plain = arm(load=0.1, load_external=0.3, smoothing=1e-3).model, arm(smoothing=1e-3).model
    weight = -jax.grad(plain.potential)(q)[0]
    motor = law(0.3, 0.4, 0.5)
    found = torque(model, q, v, u) - torque(plain, q, v, u)
    assert found.tolist() == pytest.approx([-abs(0.3 * float(weight) - 0.1 * motor), 0.0], abs=1e-9)


@pytest.mark.exhaustive
def test_a_sign_turns_the_coordinate_round():
    straight, turned = arm().model, arm(sign=-1).model
    mirror = jnp.array([-1.0, 1.0])
    for function in (models.acceleration,):
        one = function(straight, jnp.zeros(()), q, v, u)
        other = function(turned, jnp.zeros(()), mirror * q, mirror * v, mirror * u)
        np.testing.assert_allclose(mirror * other, one, atol=1e-12)


def test_an_encoder_offset_moves_the_weight_and_not_the_servo():
    shifted: Any = models.load(
        "double_pendulum", {"servo.shoulder": SERVO, "servo.elbow": SERVO, "parameters.offsets": {"shoulder": 0.7}}
    ).model
    plain = arm().model
    pushed, other = (model.force(jnp.zeros(()), at, jnp.zeros(2)) for model, at in ((shifted, q), (plain, q)))
    np.testing.assert_allclose(pushed, other)
    np.testing.assert_allclose(shifted.potential(q), plain.potential(q + jnp.array([0.7, 0.0])))


@pytest.mark.exhaustive
def test_a_simulated_servo_settles_where_its_stiffness_holds_the_weight():
    overrides = {"servo.shoulder": {**SERVO, "damping": 4.0}, "servo.elbow": {**SERVO, "damping": 4.0}}
    log = covariant.simulate("double_pendulum", overrides=overrides, duration=4.0, rate=50.0, q0=[0.4, 0.1])
    file: Any = models.load("double_pendulum", overrides)
    at = jnp.asarray(log.record.y[-1])
    weight = -jax.grad(file.model.potential)(at)
    np.testing.assert_allclose(20.0 * (0.0 - at) + weight, 0.0, atol=0.02)


@pytest.mark.exhaustive
def test_torques_are_those_of_the_last_command_where_one_is_missing():
    overrides = {"servo.shoulder": SERVO, "servo.elbow": SERVO}
    record = covariant.simulate(
        "double_pendulum", overrides=overrides, duration=4.0, rate=50.0, amplitude=[0.2, 0.2]
    ).record
    commands = np.array(record.u)
    commands[50:60] = np.nan
    gaps = record._replace(u=commands)
    result = covariant.estimate("double_pendulum", gaps, alpha=40.0, beta=800.0, overrides=overrides)
    assert np.isfinite(result.columns["torque_elbow"]).all()


@pytest.mark.exhaustive
def test_numbers_of_servos_are_opened_and_written_back(tmp_path):
    text = """system = "robot"
[parameters]
path = "double_pendulum"
[servo.shoulder]
stiffness = 20.0  # a guess
delay = 0.03
coulomb = 0.1
[servo.elbow]
stiffness = 10.0
"""
    path = tmp_path / "arm.toml"
    path.write_text(text)
    family = models.robot_family(str(path), ["servo", "servo.elbow.delay", "armature.elbow"])
    assert family.names == (
        "servo.shoulder.stiffness",
        "servo.shoulder.delay",
        "servo.shoulder.coulomb",
        "servo.elbow.stiffness",
        "servo.elbow.delay",
        "armature.elbow",
    )
    content = family.with_values(np.array([21.0, 0.04, 0.2, 11.0, 0.01, 0.002]))
    written = models.rewrite(text, content)
    assert "stiffness = 21.0  # a guess" in written
    path.write_text(written)
    assert models.load(str(path)).input_delay == (0.04, 0.01)
    # The numbers reach the model traced.
    slopes = jax.jacfwd(lambda x: family.make(x).force(jnp.zeros(()), q, u))(jnp.zeros(6))
    np.testing.assert_allclose(slopes[0, 0], 0.2)
    with pytest.raises(models.ModelError, match="has no"):
        models.robot_family(str(path), ["servo.elbow.stifness"])


@pytest.mark.exhaustive
def test_servos_of_one_kind_share_what_they_do_not_state(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(
        """system = "robot"
[parameters]
path = "double_pendulum"
[servo.shoulder]
stiffness = 20.0
delay = 0.03
coulomb = 0.1
[servo.elbow]
like = "shoulder"
coulomb = 0.2
"""
    )
    family = models.robot_family(str(path), ["servo"])
    assert family.names[3:] == ("servo.elbow.coulomb",)
    assert models.robot_family(str(path), ["servo.stiffness"]).names == ("servo.shoulder.stiffness",)
    content = family.with_values(np.array([30.0, 0.04, 0.1, 0.2]))
    path.write_text(models.rewrite(path.read_text(), content))
    file = models.load(str(path))
    assert file.input_delay == (0.04, 0.04)
    slopes = jax.jacfwd(lambda x: family.make(x).force(jnp.zeros(()), q, u))(jnp.zeros(4))
    np.testing.assert_allclose(slopes[:, 0], [0.2, 0.1], atol=1e-12)
    for wrong in ("elbow", "knee"):
        with pytest.raises(models.ModelError, match="must be a joint with"):
            models.load("double_pendulum", {"servo.shoulder": SERVO, "servo.elbow": {"like": wrong}})
