"""A rigid body in water, on SE(3): no Euler angles, so that no pitch is special.

Source: Leonard 1997, Stability of a bottom-heavy underwater vehicle, for the left-invariant kinetic energy of body and
water; Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, chapter 6, for the drag.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from covariant.geometry.lie import SE3, SO3
from covariant.models._group_system import GroupSystem
from covariant.models._lagrangian import Parameter

_SOURCE = "chosen: of the size of a small inspection vehicle"


def underwater_vehicle(
    mass: float = 12.0,
    inertia: Sequence[float] = (0.2, 0.35, 0.4),
    added_mass: Sequence[float] = (5.0, 12.0, 14.0, 0.1, 0.2, 0.2),
    buoyancy: float = 120.0,
    gravity: float = 9.81,
    centre_of_mass: Sequence[float] = (0.0, 0.0, -0.02),
    centre_of_buoyancy: Sequence[float] = (0.0, 0.0, 0.01),
    drag: Sequence[float] = (4.0, 6.0, 5.0, 0.1, 0.1, 0.1),
    quadratic_drag: Sequence[float] = (18.0, 22.0, 37.0, 1.5, 1.5, 1.5),
) -> GroupSystem:
    """Vehicle in still water; twist (v, ω) in the body [m/s, rad/s], z up in space.

    `mass` [kg], `inertia` [kg m²] about the body's origin, `added_mass` [kg, kg m²] along and about the body's axes,
    `buoyancy` [N], centres of mass and buoyancy [m] in the body, `drag` and `quadratic_drag` for each component of
    the twist. The input is the wrench (force, torque) at the origin, in the body [N, N m].
    """
    centre = jnp.asarray(centre_of_mass, float)
    lift = jnp.asarray(centre_of_buoyancy, float)
    coupling = mass * SO3.hat(centre)
    rigid = jnp.block([[mass * jnp.eye(3), -coupling], [coupling, jnp.diag(jnp.asarray(inertia, float))]])
    linear, square = jnp.asarray(drag, float), jnp.asarray(quadratic_drag, float)

    def potential(g):
        height = SE3.act(g, centre.astype(g.dtype))[2], SE3.act(g, lift.astype(g.dtype))[2]
        return mass * gravity * height[0] - buoyancy * height[1]

    def dissipation(g, v):
        return -(linear.astype(v.dtype) + square.astype(v.dtype) * jnp.abs(v)) * v

    return GroupSystem(
        SE3,
        rigid + jnp.diag(jnp.asarray(added_mass, float)),
        potential,
        dissipation=dissipation,
        velocities=("surge", "sway", "heave", "roll_rate", "pitch_rate", "yaw_rate"),
        units=("m/s",) * 3 + ("rad/s",) * 3,
        parameters={
            "mass": Parameter(mass, "kg", _SOURCE),
            "inertia": Parameter(tuple(inertia), "kg m^2", _SOURCE),
            "added_mass": Parameter(tuple(added_mass), "kg, kg m^2", _SOURCE),
            "buoyancy": Parameter(buoyancy, "N", _SOURCE),
            "centre_of_mass": Parameter(tuple(centre_of_mass), "m", _SOURCE),
            "centre_of_buoyancy": Parameter(tuple(centre_of_buoyancy), "m", _SOURCE),
            "drag": Parameter(tuple(drag), "N s/m, N m s", _SOURCE),
            "quadratic_drag": Parameter(tuple(quadratic_drag), "N s^2/m^2, N m s^2", _SOURCE),
        },
    )
