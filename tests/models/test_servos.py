"""Robots whose joints are told positions: the torque of a servo, its friction, its keys, and how its command acts."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import robots
from covariant.signals import Record, acting_inputs

SERVO = {"stiffness": 20.0, "damping": 0.5, "delay": 0.03}


def arm(**servo) -> Any:
    return models.load("double_pendulum", {"servo.shoulder": {**SERVO, **servo}, "servo.elbow": SERVO})


def torque(model, q, v, u):
    """Generalised force of motors and friction, less the weight of the same robot without motors."""
    force = models.applied_force(model, jnp.zeros(()), q, u) + models.resistance(model, jnp.zeros(()), q, v, u)
    plain = robots.load("double_pendulum")
    rest = models.applied_force(plain, jnp.zeros(()), q, jnp.zeros(2)) + models.resistance(
        plain, jnp.zeros(()), q, v, jnp.zeros(2)
    )
    return np.asarray(force - rest)


q, v, u = jnp.array([0.3, -0.2]), jnp.array([0.4, -1.0]), jnp.array([0.5, -0.1])


def law(position, rate, command, *, k=20.0, d=0.5, offset=0.0, band=0.0, limit=np.inf, back_emf=0.0, on=1.0, part=1.0):
    """The torque of a servo, written from its definition."""
    error = command + offset - position
    error = np.sign(error) * max(abs(error) - band, 0.0)
    inner = max(-part * limit, min(part * limit, part * k * error - d * rate))
    return on * (inner - back_emf * rate)


@pytest.mark.exhaustive("keys1-same1", "keys6-same6")
@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("keys", "same"),
    [
        ({}, {}),
        ({"gain": 3.0}, {"k": 60.0}),
        ({"offset": 0.05}, {"offset": 0.05}),
        ({"dead_band": 0.05}, {"band": 0.05}),
        ({"limit": 1.0}, {"limit": 1.0}),
        ({"limit": 1.0, "back_emf": 0.3}, {"limit": 1.0, "back_emf": 0.3}),
        (
            {"supply": 8.0, "resistance": 4.0, "torque_constant": 0.5, "pwm_limit": 0.7},
            {"limit": 0.7, "back_emf": 0.0625},
        ),
    ],
)
def test_a_servo_gives_the_torque_of_its_definition(keys, same):
    model = arm(**keys).model
    found = torque(model, q, v, u)
    assert found[0] == pytest.approx(law(0.3, 0.4, 0.5, **same), abs=1e-9)
    assert found[1] == pytest.approx(law(-0.2, -1.0, -0.1), abs=1e-9)


def test_angles_on_a_circle_are_compared_the_short_way():
    model = arm().model
    assert model.circles
    np.testing.assert_allclose(torque(model, q, v, u + jnp.array([2 * jnp.pi, 0.0])), torque(model, q, v, u), atol=1e-9)


def test_a_servo_of_an_mjcf_file_is_one_too(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(
        """<mujoco><worldbody><body><joint name="hinge" range="-90 90" limited="true"/>
        <geom type="sphere" size=".1" pos=".3 0 0"/></body></worldbody>
        <actuator><position joint="hinge" kp="5" kv=".2" gear="2"/></actuator></mujoco>"""
    )
    model = robots.load(file)
    force = model.force(jnp.zeros(()), jnp.array([0.1]), jnp.array([0.5]))
    assert force.tolist() == pytest.approx([2 * 5 * (0.5 - 2 * 0.1)])
    delayed: Any = models.load(str(file), {"servo.hinge.delay": 0.02, "servo.hinge.limit": 1.0})
    assert delayed.input_delay == (0.02,)
    assert delayed.model.force(jnp.zeros(()), jnp.array([0.1]), jnp.array([0.5])).tolist() == [1.0]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"servo.elbow": {"stiffness": 1.0, "stifness": 1.0}}, "Did you mean 'stiffness'"),
        ({"servo.elbw": {"stiffness": 1.0}}, "joint of servo"),
        ({"servo.elbow": {"damping": 1.0}}, "needs a stiffness"),
        ({"servo.elbow": {"stiffness": -1.0}}, "servo 'elbow': stiffness must be positive"),
        ({"servo.elbow": {"stiffness": 1.0, "delay": -0.1}}, "delay must be"),
        ({"servo.elbow": {"stiffness": 1.0, "sign": 2}}, "sign must be 1 or -1"),
        ({"servo.elbow": {"stiffness": 1.0, "switch": 1}}, "switch must be true or false"),
        ({"servo.elbow": {"stiffness": 1.0, "supply": 5.0}}, "together"),
        ({"servo.elbow": {"stiffness": 1.0, "logged_supply": True}}, "logged_supply needs"),
        ({"servo.elbow": 3.0}, "must be a table"),
        ({"servo.elbow": {"stiffness": [1.0]}}, "must be"),
        (
            {"servo.elbow": {"stiffness": 1.0, "coulomb": 0.1}, "parameters.friction": {"elbow": {"coulomb": 0.2}}},
            "state it in one of them",
        ),
        ({"servo.elbow": {"stiffness": 1.0, "delay": 0.1}, "inputs.delay": 0.2}, "states again"),
        ({"servo.elbow": {"stiffness": 1.0}, "inputs.kind": "torque"}, "contradicts"),
        ({"inputs.kind": "command"}, "needs \\[servo.JOINT\\]"),
        ({"servo.elbow": {"stiffness": "10"}}, "servo 'elbow': stiffness must be one number"),
        ({"servo.elbow": {"stiffness": 1.0, "coulomb": True}}, "coulomb must be one number"),
        ({"servo.elbow": {"stiffness": 1.0, "armature": -0.1}}, "servo 'elbow': armature must be"),
        ({"servo.elbow": {"stiffness": 1.0, "like": ["elbow"]}}, "like must be a joint"),
        (
            {"servo.elbow": {"stiffness": 1.0, "supply": 7.0, "resistance": 0.0, "torque_constant": 1.0}},
            "resistance must be positive",
        ),
        ({"servo.elbow": {"stiffness": 1.0, "pwm_limit": 0.5}}, "part of a drive"),
        ({"parameters.friction": {"elbow": {"coulomb": 0.1, "load": 0.3}}}, "need a servo"),
        ({"servo.shoulder": {"stiffness": 1.0}, "parameters.actuated": ["elbow"]}, "has no input"),
    ],
)
def test_a_wrong_servo_is_refused_in_one_line(overrides, said):
    with pytest.raises(models.ModelError, match=said) as error:
        models.load("double_pendulum", overrides)
    assert "\n" not in str(error.value)


def test_servos_are_for_robots():
    with pytest.raises(models.ModelError, match="for robots"):
        models.load("oscillator", {"servo.q": SERVO})


def test_each_command_acts_after_its_own_delay_and_lead():
    t = np.arange(0.0, 1.0, 0.1)
    commands = np.stack([np.sin(3 * t), np.cos(3 * t)], axis=1)
    record = Record(t, commands, np.zeros((10, 1)))
    both = acting_inputs(record, delay=[0.05, 0.12], lead=[0.0, 0.02])
    for i, (delay, lead) in enumerate(((0.05, 0.0), (0.12, 0.02))):
        alone = acting_inputs(record._replace(u=commands[:, i : i + 1]), delay=delay, lead=lead)
        np.testing.assert_allclose(both.u[:, i], alone.u[:, 0])
    # The lead of a ramp is its rate times the time.
    ramp = record._replace(u=t[:, None])
    led = acting_inputs(ramp, "linear", 0.05, lead=0.3).u - acting_inputs(ramp, "linear", 0.05).u
    np.testing.assert_allclose(led[2:-1], 0.3)
