"""Models a satellite with reaction wheels: only internal torques act, so its total angular momentum is constant."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from covariant._typing import Number
from covariant.geometry.lie import SO2, SO3, Product
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace
from scalargraph.errors import InputError

_SOURCE = "chosen: of the size of a small satellite"


def satellite(
    inertia: Sequence[Number] = (0.05, 0.06, 0.04),
    wheel_inertia: Number = 2e-4,
    axes: Sequence[Sequence[Number]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    bearing: Number = 0.0,
) -> GroupSystem:
    """Satellite with k reaction wheels, on SO(3) × SO(2)^k; inputs are the k motor torques [N m].

    The velocity is the angular velocity of the body [rad/s], followed by the rates of the wheels relative to the body
    [rad/s]. Only internal torques act, so the total angular momentum is constant.

    Args:
        inertia: Principal moments (3,) of the satellite with its wheels, without the wheels' spin inertia [kg m²].
        wheel_inertia: Inertia of each wheel about its axis [kg m²].
        axes: Axes (k, 3) of the wheels; they are scaled to unit length.
        bearing: Friction coefficient of the wheels [N m s/rad].

    Returns:
        The system with 3 + k velocities.

    Raises:
        ValueError: The axes have another shape.

    Example:
        >>> from covariant import models
        >>> models.satellite(axes=((0.0, 0.0, 1.0),)).velocities
        ('w1', 'w2', 'w3', 'wheel1')
    """
    directions = np.asarray(axes, float)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise InputError(f"satellite: axes must have shape (k, 3); got {directions.shape}")
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    k = directions.shape[0]
    xp = namespace(inertia, wheel_inertia)
    # The wheels also spin with the body, as v contains their rates relative to it.
    body = xp.diag(xp.asarray(inertia, float)) + wheel_inertia * directions.T @ directions
    spin = wheel_inertia * directions.T
    matrix = xp.block([[body, spin], [spin.T, wheel_inertia * np.eye(k)]])

    return GroupSystem(
        Product((SO3, *(SO2,) * k)),
        matrix,
        None,
        _at_the_wheels,
        Parametric(_bearing_friction, bearing=bearing),
        velocities=("w1", "w2", "w3", *(f"wheel{i + 1}" for i in range(k))),
        units=("rad/s",) * (3 + k),
        inputs=k,
        parameters={
            "inertia": Parameter(inertia, "kg m^2", _SOURCE),
            "wheel_inertia": Parameter(wheel_inertia, "kg m^2", _SOURCE),
            "bearing": Parameter(bearing, "N m s/rad", _SOURCE),
        },
    )


def _at_the_wheels(t, g, u):
    return jnp.concatenate([jnp.zeros(3, u.dtype), u])


def _bearing_friction(g, v, bearing):
    return jnp.concatenate([jnp.zeros(3, v.dtype), -bearing * v[3:]])
