"""A satellite with reaction wheels: only torques between its parts act, so its total angular momentum is constant."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from covariant._typing import Number
from covariant.geometry.lie import SO2, SO3, Product
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace

_SOURCE = "chosen: of the size of a small satellite"


def satellite(
    inertia: Sequence[Number] = (0.05, 0.06, 0.04),
    wheel_inertia: Number = 2e-4,
    axes: Sequence[Sequence[Number]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    bearing: Number = 0.0,
) -> GroupSystem:
    """Attitude and wheel angles on SO(3) × SO(2)^k; v holds the angular velocity and the rates against the body.

    - `inertia` [kg m²]: principal moments of the satellite with its wheels, except their inertia of spin.
    - `wheel_inertia` [kg m²]: of each wheel about its axis; `axes` (k, 3): these axes, as unit vectors.
    - `bearing` [N m s/rad]: friction of the wheels.

    Inputs are the k motor torques [N m].
    """
    directions = np.asarray(axes, float)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"satellite: axes must have shape (k, 3); got {directions.shape}")
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    k = directions.shape[0]
    xp = namespace(inertia, wheel_inertia)
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
