"""Models a ship with a rudder and a propeller in the horizontal plane, whose numbers zig-zags and circles determine.

Source: Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, sections 6.5 (Coriolis and added mass in
surge, sway and yaw) and 7.1 (damping); a rudder whose force grows with the square of the speed, section 9.5.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from covariant._typing import Number
from covariant.geometry.lie import SE2
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace

_SOURCE = "chosen: of the size of a workboat"


def ship(
    mass: Sequence[Number] = (2000.0, 2500.0, 5000.0),
    coupling: Number = 0.0,
    drag: Sequence[Number] = (50.0, 1000.0, 4000.0),
    quadratic_drag: Sequence[Number] = (50.0, 500.0, 3000.0),
    rudder: Number = 100.0,
    rudder_arm: Number = 2.5,
    propeller: Number | None = None,
    current: Sequence[Number] = (0.0, 0.0),
) -> GroupSystem:
    """Ship with rudder and propeller on SE(2); v = (surge, sway, yaw rate) [m/s, m/s, rad/s].

    The position is (north, east) [m], the angle the heading [rad] from north to east. The inputs are the angle of the
    rudder [rad], which turns the bow to starboard where it is positive and the ship moves ahead, and the thrust [N] or,
    with a coefficient `propeller`, the speed of the propeller [rad/s].

    Use it for a boat or a ship under way whose numbers are fitted to a log. The Coriolis and centripetal forces, those
    of the added mass included, follow from the masses. `manoeuvring_ship` is a tanker whose many coefficients are
    known; `cybership` and `supply_vessel` have three forces as inputs.

    Args:
        mass: Mass in surge and in sway [kg] and moment of inertia in yaw [kg m²], those of the water that moves along
            included: m − X_u̇, m − Y_v̇, I_z − N_ṙ.
        coupling: Coupling of sway and yaw `m x_G − Y_ṙ` [kg m], with the centre of mass x_G forward of the origin.
        drag: Linear damping (3,) of each velocity [N s/m, N s/m, N m s/rad].
        quadratic_drag: Quadratic damping (3,) of each velocity [N s²/m², N s²/m², N m s²/rad²].
        rudder: Normal force of the rudder by the square of surge and the sine of its angle [N s²/m²].
        rudder_arm: Distance of the rudder aft of the origin [m].
        propeller: Thrust by the square of the propeller's speed [N s²/rad²]; none where the input is the thrust.
        current: Velocity of the water towards north and east [m/s], constant over a log or, for a filter with
            `uncertain_parameters`, slowly varying. The ship's velocities are those over ground.

    Returns:
        The system with three velocities and two inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> v_dot = models.acceleration(
        ...     models.marine.ship(), 0.0, jnp.eye(3), jnp.array([2.0, 0.0, 0.0]), jnp.array([0.2, 300.0])
        ... )
        >>> bool(v_dot[1] < 0), bool(v_dot[2] > 0)  # the stern to port, the bow to starboard
        (True, True)
    """
    xp = namespace(mass, coupling)
    zero = 0.0 * coupling
    inertia = [[mass[0], zero, zero], [zero, mass[1], coupling], [zero, coupling, mass[2]]]
    driven = {} if propeller is None else {"propeller": Parameter(propeller, "N s^2/rad^2", _SOURCE)}
    parameters = {
        "mass": Parameter(mass, "kg, kg, kg m^2", _SOURCE),
        "coupling": Parameter(coupling, "kg m", _SOURCE),
        "drag": Parameter(drag, "N s/m, N s/m, N m s/rad", _SOURCE),
        "quadratic_drag": Parameter(quadratic_drag, "N s^2/m^2, N s^2/m^2, N m s^2/rad^2", _SOURCE),
        "rudder": Parameter(rudder, "N s^2/m^2", _SOURCE),
        "rudder_arm": Parameter(rudder_arm, "m", _SOURCE),
        "current": Parameter(current, "m/s", "chosen: water at rest"),
    }
    inertia = xp.stack([xp.stack([xp.asarray(entry, float) for entry in row]) for row in inertia])
    numbers = {"linear": drag, "square": quadratic_drag, "rudder": rudder, "arm": rudder_arm}
    return GroupSystem(
        SE2,
        inertia,
        None,
        Parametric(_thrust, propeller=() if propeller is None else (propeller,)),
        Parametric(_hydrodynamic_force, **numbers, current=current, inertia=inertia),
        velocities=("surge", "sway", "yaw_rate"),
        units=("m/s", "m/s", "rad/s"),
        inputs={"rudder": "rad", "thrust": "N"} if propeller is None else {"rudder": "rad", "propeller": "rad/s"},
        parameters=parameters | driven,
    )


def _thrust(t, g, u, propeller):
    thrust = u[1] if not propeller.size else propeller[0] * jnp.abs(u[1]) * u[1]
    return jnp.zeros(3, u.dtype).at[0].set(thrust)


def _hydrodynamic_force(t, g, v, u, current, inertia, **numbers):
    # In water that moves uniformly the laws are those of water at rest, for the velocity relative to it (Fossen 2011,
    # property 8.1): M ν_r' = ad*_{ν_r} M ν_r + force(ν_r). Here M ν' = ad*_ν M ν, so that the difference is a force.
    flow = jnp.append(g[:2, :2].T @ current, 0.0).astype(v.dtype)
    turning = v[2] * jnp.stack([flow[1], -flow[0], 0.0 * flow[0]])  # the rate of a flow that is constant in the earth
    through = v - flow
    inertial = SE2.coadjoint(through, inertia @ through) - SE2.coadjoint(v, inertia @ v) + inertia @ turning
    return _resistance(through, u, **numbers) + inertial


def _resistance(v, u, linear, square, rudder, arm):
    # Astern the water comes from the other side of the rudder, hence |u| u.
    normal = rudder * jnp.abs(v[0]) * v[0] * jnp.sin(u[0])
    # A positive angle turns the trailing edge to starboard: the force points to port and aft, behind the origin.
    lift = normal * jnp.stack([jnp.sin(u[0]), jnp.cos(u[0]), -arm * jnp.cos(u[0])])
    return -(linear + square * jnp.abs(v)) * v - lift
