"""Sensors beside the configuration: what they expect is what MuJoCo's sensors read, and they correct as they should."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plants import (
    MEASUREMENT,
    PROCESS,
    SPEED,
    body,
    masses,
    sphere_pendulum,
)

from covariant import observers
from covariant.engine._kernel import KernelForm, _KernelKey
from covariant.models import robots
from covariant.observers import Delayed, FixedLag, IntrinsicKalman, Sensor

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0.3 -0.2 -9.5"/>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="0.3 -0.4 0.5">
      {joint}
      <inertial pos="0.02 0.03 -0.1" mass="2" diaginertia="0.03 0.02 0.04"/>
      <body name="tip" pos="0.1 0 -0.4" euler="0.2 0.7 -0.3">
        <joint name="wrist" type="hinge" axis="0.6 0 0.8"/>
        <inertial pos="0.05 -0.02 0.1" mass="1" diaginertia="0.01 0.02 0.015"/>
        <site name="imu" pos="0.1 -0.05 0.2" euler="0.4 -0.2 0.9"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <gyro site="imu"/><accelerometer site="imu"/>
    <framepos objtype="site" objname="imu"/><framequat objtype="site" objname="imu"/>
  </sensor>
</mujoco>
"""
FIXED, FREE = '<joint name="shoulder" type="hinge" axis="0 1 0"/>', "<freejoint/>"
GRAVITY, PLACE = (0.3, -0.2, -9.5), (0.1, -0.05, 0.2)


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """MuJoCo's model and ours, with two hinges, and floating with one; and the axes of the site in its link."""
    found = {}
    for name, joint in (("fixed", FIXED), ("floating", FREE)):
        path = tmp_path_factory.mktemp("arm") / f"{name}.xml"
        path.write_text(ARM.format(joint=joint))
        theirs = mujoco.MjModel.from_xml_path(str(path))
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, theirs.site_quat[0])
        found[name] = robots.load(str(path)), theirs, turned.reshape(3, 3)
    return found


def on_the_tip(model, axes):
    where = {"axes": axes, "place": PLACE}
    return (
        observers.gyro(model.space, "tip", 0.01, axes=axes),
        observers.accelerometer(model.space, "tip", 0.1, gravity=GRAVITY, **where),
        observers.point_sensor(model.space, "tip", 1e-3, place=PLACE),
        observers.pose_sensor(model.space, "tip", 1e-3, 1e-2, **where),
    )


# A linear system: the textbook's filter and least squares.

NOISES = jnp.asarray(PROCESS), jnp.asarray(MEASUREMENT), SPEED**2 * jnp.eye(2)


def test_a_filter_with_sensors_is_prepared_for_c_once(arms):
    """Every ready sensor has a hash: otherwise each run would trace the filter again."""
    model, _, axes = arms["fixed"]
    few = (observers.encoder([0], 0.1), observers.tachometer([1], 0.1, bias_std=0.1))
    kalman = IntrinsicKalman(model, 1e-2, 1e-4, 1.0, sensors=(*few, *on_the_tip(model, axes)), substeps=1)
    form = KernelForm((2 + kalman._sensors.size,), 2)
    hash(_KernelKey(kalman, form))
    hash(_KernelKey(Delayed(FixedLag(kalman, 2), 0.01, 100.0), form))


def test_a_motor_encoder_within_a_turn_is_read_modulo_its_turn():
    motor = observers.encoder([0], 1e-3, reduction=10.0, period=2 * np.pi)
    apart = motor.innovation(jnp.array([31.0]), jnp.array([31.01 - 8 * np.pi]))
    np.testing.assert_allclose(apart, [0.01], atol=1e-12)


@pytest.mark.core(4)
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda a: observers.gyro(a.space, "elbow", 0.1), "gyro: .*elbow"),
        (lambda a: observers.gyro(a.space, "tip", 0.0), "std must be positive"),
        (lambda a: observers.gyro(a.space, "tip", [1.0, 2.0]), "one number or three"),
        (lambda a: observers.gyro(a.space, "tip", 0.1, axes=np.diag([1.0, 1.0, -1.0])), "right-handed"),
        (lambda a: observers.gyro(a.space, "tip", 0.1, axes=np.ones((3, 3))), "rotation matrix"),
        (lambda a: observers.gyro(sphere_pendulum().space, "tip", 0.1), "has no links"),
        (lambda a: observers.tachometer([0, 0], 0.1), "different indices"),
        (lambda a: observers.encoder([0], 0.1, reduction=0.0), "reduction must not be zero"),
        (lambda a: observers.tachometer([0], 0.1, bias_std=-1.0), "bias_std"),
        (lambda a: Sensor("", lambda now, s: now.q, 1.0), "name must not be empty"),
        (lambda a: Sensor("x", lambda now, s: now.q, [1.0, 0.0]), "cov must have variances that are positive"),
    ],
)
def test_what_makes_no_sense_is_named(arms, make, words):
    with pytest.raises(ValueError, match=words):
        make(arms["fixed"][0])


def test_names_and_lengths_are_checked():
    one = observers.tachometer([0], 0.1)
    with pytest.raises(ValueError, match="two sensors are called 'tachometer'"):
        IntrinsicKalman(masses(), *NOISES, sensors=(one, one))
    with pytest.raises(ValueError, match="must be one Sensor or several"):
        IntrinsicKalman(masses(), *NOISES, sensors="gyro")
    biased = [observers.tachometer([i], 0.1, name=name, bias_std=1.0) for i, name in enumerate(("a", "b"))]
    both = IntrinsicKalman(masses(), *NOISES, sensors=biased)
    assert both.slow_names == ("a_bias", "b_bias")
    on_a_group = IntrinsicKalman(body(), 1.0, 1.0, 1.0, sensors=one)
    with pytest.raises(ValueError, match=r"the configuration \(9 numbers\) and then the 1 readings of tachometer"):
        on_a_group.init(jnp.eye(3))
