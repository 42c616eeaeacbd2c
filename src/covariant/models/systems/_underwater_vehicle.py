"""Models a rigid body in water on SE(3), without Euler angles and so without a singular pitch.

Source: Leonard 1997, Stability of a bottom-heavy underwater vehicle, for the left-invariant kinetic energy of body and
water; Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, chapter 6, for the drag.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from covariant._typing import Number
from covariant.geometry.lie import SE3
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace

_SOURCE = "chosen: of the size of a small inspection vehicle"


def underwater_vehicle(
    mass: Number = 12.0,
    inertia: Sequence[Number] = (0.2, 0.35, 0.4),
    added_mass: Sequence[Number] = (5.0, 12.0, 14.0, 0.1, 0.2, 0.2),
    buoyancy: Number = 120.0,
    gravity: Number = 9.81,
    centre_of_mass: Sequence[Number] = (0.0, 0.0, -0.02),
    centre_of_buoyancy: Sequence[Number] = (0.0, 0.0, 0.01),
    drag: Sequence[Number] = (4.0, 6.0, 5.0, 0.1, 0.1, 0.1),
    quadratic_drag: Sequence[Number] = (18.0, 22.0, 37.0, 1.5, 1.5, 1.5),
) -> GroupSystem:
    """Underwater vehicle in still water, on SE(3); twist (v, ω) in the body frame [m/s, rad/s], z up in space.

    The input is the wrench (force, torque) at the origin, in the body frame [N, N m].

    Use it to try observers on SE(3): the body turns freely, and the added mass makes the inertia depend on the
    direction. In a current, drag would depend on the velocity relative to the water, which this model does not contain.
    `models.marine.odin` is a vehicle in Euler angles.

    Args:
        mass: Mass [kg].
        inertia: Moments of inertia (3,) about the axes through the origin of the body frame [kg m²].
        added_mass: Added mass (6,) along and about the axes of the body [kg, kg m²].
        buoyancy: Buoyancy force [N].
        gravity: Gravity [m/s²].
        centre_of_mass: Centre of mass (3,) in the body frame [m].
        centre_of_buoyancy: Centre of buoyancy (3,) in the body frame [m].
        drag: Coefficients (6,) of the linear drag of each component of the twist [N s/m, N m s].
        quadratic_drag: Coefficients (6,) of the quadratic drag of each component [N s²/m², N m s²].

    Returns:
        The system with six velocities and six inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> vehicle = models.underwater_vehicle(drag=(4.0,) * 6, quadratic_drag=(18.0,) * 6)
        >>> surge = jnp.zeros(6).at[0].set(2.0)
        >>> vehicle.dissipation(jnp.eye(4), surge)[0].item()
        -80.0
    """
    xp = namespace(mass, inertia, added_mass, centre_of_mass, centre_of_buoyancy)
    centre, lift = xp.asarray(centre_of_mass, float), xp.asarray(centre_of_buoyancy, float)
    coupling = mass * xp.cross(xp.eye(3), centre)  # the matrix of x ↦ mass · centre × x
    # From linear momentum m (v + ω × c) and angular momentum about the origin I ω + m c × v; coupling is antisymmetric.
    rigid = xp.block([[mass * xp.eye(3), coupling.T], [coupling, xp.diag(xp.asarray(inertia, float))]])
    potential = Parametric(_potential, weight=mass * gravity, buoyancy=buoyancy, centre=centre, lift=lift)

    parameters = {
        "mass": Parameter(mass, "kg", _SOURCE),
        "inertia": Parameter(inertia, "kg m^2", _SOURCE),
        "added_mass": Parameter(added_mass, "kg, kg m^2", _SOURCE),
        "buoyancy": Parameter(buoyancy, "N", _SOURCE),
        "centre_of_mass": Parameter(centre_of_mass, "m", _SOURCE),
        "centre_of_buoyancy": Parameter(centre_of_buoyancy, "m", _SOURCE),
        "drag": Parameter(drag, "N s/m, N m s", _SOURCE),
        "quadratic_drag": Parameter(quadratic_drag, "N s^2/m^2, N m s^2", _SOURCE),
    }
    return GroupSystem(
        SE3,
        rigid + xp.diag(xp.asarray(added_mass, float)),
        potential,
        dissipation=Parametric(_drag, linear=drag, square=quadratic_drag),
        velocities=("surge", "sway", "heave", "roll_rate", "pitch_rate", "yaw_rate"),
        units=("m/s",) * 3 + ("rad/s",) * 3,
        parameters=parameters,
    )


def _potential(g, weight, buoyancy, centre, lift):
    # Weight acts at the centre of mass, and buoyancy acts upwards at its own centre; z is up.
    return weight * SE3.act(g, centre)[2] - buoyancy * SE3.act(g, lift)[2]


def _drag(g, v, linear, square):
    return -(linear + square * jnp.abs(v)) * v  # |v| v opposes the motion for either sign
