"""A planar hovercraft on SE(2), driven by two fans."""

from collections.abc import Sequence

import jax.numpy as jnp

from covariant._typing import Number
from covariant.geometry.lie import SE2
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace

_SOURCE = "chosen: of the size of a laboratory model"


def hovercraft(
    mass: Number = 5.0,
    inertia: Number = 0.05,
    fan_offset: Number = 0.12,
    drag: Sequence[Number] = (0.3, 0.5, 0.02),
) -> GroupSystem:
    """Planar hovercraft on SE(2), driven by two fans; v = (surge, sway, yaw rate) [m/s, m/s, rad/s].

    The inputs are the thrusts [N] of the right and of the left fan.

    Args:
        mass: Mass [kg].
        inertia: Inertia about the centre of mass [kg m²].
        fan_offset: Distance of each fan from the middle [m].
        drag: Coefficients (3,) of a drag proportional to v [N s/m, N s/m, N m s].

    Returns:
        The system with three velocities and two inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> craft = models.hovercraft(fan_offset=0.5)
        >>> craft.force(0.0, jnp.eye(3), jnp.array([2.0, 1.0])).tolist()
        [3.0, 0.0, 0.5]
    """
    xp = namespace(mass, inertia)
    return GroupSystem(
        SE2,
        xp.diag(xp.asarray([mass, mass, inertia])),
        None,
        Parametric(_fans, offset=fan_offset),
        Parametric(_drag, coefficients=drag),
        velocities=("surge", "sway", "yaw_rate"),
        units=("m/s", "m/s", "rad/s"),
        inputs={"right_thrust": "N", "left_thrust": "N"},
        parameters={
            "mass": Parameter(mass, "kg", _SOURCE),
            "inertia": Parameter(inertia, "kg m^2", _SOURCE),
            "fan_offset": Parameter(fan_offset, "m", _SOURCE),
            "drag": Parameter(drag, "N s/m, N m s", _SOURCE),
        },
    )


def _fans(t, g, u, offset):
    # The right fan is u[0]: its thrust, at y = −offset, turns the bow to the left, a positive yaw rate.
    return jnp.stack([u[0] + u[1], jnp.zeros_like(u[0]), offset * (u[0] - u[1])])


def _drag(g, v, coefficients):
    return -coefficients * v
