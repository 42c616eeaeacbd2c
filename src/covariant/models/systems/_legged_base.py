"""Models the base of a legged robot, whose velocity an IMU and leg encoders determine, without the robot's dynamics.

Source: Bloesch et al. 2012, State estimation for legged robots, RSS, for feet as fixed points; Hartley, Ghaffari,
Eustice & Grizzle 2020, Contact-aided invariant extended Kalman filtering for robot state estimation, IJRR 39(4). Here
all vectors are in the axes of the base, in which the model is linear; position and heading, which are not measured,
drop out.
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant._typing import Number
from covariant.models._state_space import StateSpace
from covariant.models.files import ModelFile
from covariant.models.robots import legs, load

GRAVITY = 9.81
"""Gravity [m/s²]."""
SPEED, TILT = 0.3, 0.3
"""Standard deviations of the first velocity [m/s] and of the first tilt [rad]."""
BIASES = 0.05, 0.4
"""Standard deviations of the initial biases of gyro [rad/s] and accelerometer [m/s²]."""
DRIFTS = 1e-4, 1e-3
"""Standard deviations of their drift in a second, as a random walk."""


def legged_base(
    path: str,
    feet: Mapping[str, Sequence[Number]],
    radius: Number = 0.0,
    gyro_noise: Number = 5e-4,
    accelerometer_noise: Number = 5e-3,
    slip: Number = 1e-3,
    flags: bool = False,
) -> ModelFile:
    """Base of a legged robot, whose velocity an IMU and encoders determine; for the observer `legged-base`.

    The IMU is at the origin of the root link, in its axes. Its readings are the inputs: angular velocity [rad/s], then
    specific force [m/s²]. The joints of the robot are measured. The states, all in the axes of the base, are its
    velocity, gravity, the positions of the standing feet, and the biases of gyro and accelerometer.

    Args:
        path: Robot file, URDF or MJCF.
        feet: Centre of each foot in the frame of its link, `{link: [x, y, z]}` [m].
        radius: Radius of spherical feet [m], which roll; 0 for points.
        gyro_noise: Noise density of the gyro [rad/s/√Hz].
        accelerometer_noise: Noise density of the accelerometer [m/s²/√Hz], vibration included.
        slip: Creep of a standing foot, as a random walk [m/√s].
        flags: Whether a log has a column for each foot: 1 while it stands, 0 while it does not, empty if unknown.

    Returns:
        The model with its noise, which `[uncertainty]` and `[initial]` of a model file may replace.

    Raises:
        ValueError: The robot has no such link, or the leg of a foot has fewer than three joints.

    Example:
        >>> from covariant import models
        >>> feet = {"FL_FOOT": [0.0, 0.0, 0.0], "HR_FOOT": [0.0, 0.0, 0.0]}
        >>> base = models.load("legged_base", {"parameters.path": "quadruped", "parameters.feet": feet})
        >>> base.model.coordinates[:6:5], len(base.columns.q), base.columns.u
        (('velocity_x', 'gravity_z'), 12, ('u1', 'u2', 'u3', 'u4', 'u5', 'u6'))
    """
    robot = load(path, floating=True)
    made = legs(robot.space, feet, radius)
    axes, names = ("x", "y", "z"), tuple(feet)
    parts = ("velocity", "gravity", *names, "gyro_bias", "accelerometer_bias")
    units = ("m/s", "m/s^2", *("m",) * len(names), "rad/s", "m/s^2")
    outputs = robot.coordinates + tuple(f"{name}_contact" for name in names) * flags
    model = StateSpace(
        made,
        eqx.Partial(_joints, len(outputs)),
        coordinates=tuple(f"{part}_{axis}" for part in parts for axis in axes),
        units=tuple(unit for unit in units for _ in axes),
        outputs=outputs,
        inputs=6,
    )
    noise = (accelerometer_noise, GRAVITY * gyro_noise, *(slip,) * len(names), *DRIFTS)
    first = (SPEED, TILT * GRAVITY, *(1.0,) * len(names), *BIASES)
    start = np.zeros(len(model.coordinates))
    start[5] = -GRAVITY
    return ModelFile(
        "legged_base",
        model,
        process_std=tuple(float(each) for each in noise for _ in axes),
        initial_state=tuple(start.tolist()),
        initial_std=tuple(float(each) for each in first for _ in axes),
    )


def _joints(count, t, x, u):
    return jnp.full(count, jnp.nan, x.dtype)  # the motion of the base does not determine the joint positions
