"""Models a tanker with rudder and propeller in three degrees of freedom, by the MMG standard method.

Source: Yasukawa & Yoshimura 2015, Introduction of MMG standard method for ship maneuvering predictions, Journal of
Marine Science and Technology 20, with its tables for KVLCC2.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from covariant._linalg import solve
from covariant._names import refuse_unknown
from covariant.models._parameters import Parameter, Parametric
from covariant.models._state_space import StateSpace
from covariant.models.marine._craft import yaw_rotation

_MMG = "Yasukawa & Yoshimura 2015, KVLCC2"

HULL = (
    {"R0": 0.022, "Xvv": -0.040, "Xvr": 0.002, "Xrr": 0.011, "Xvvvv": 0.771}
    | {"Yv": -0.315, "Yr": 0.083, "Yvvv": -1.607, "Yvvr": 0.379, "Yvrr": -0.391, "Yrrr": 0.008}
    | {"Nv": -0.137, "Nr": -0.049, "Nvvv": -0.030, "Nvvr": -0.294, "Nvrr": 0.055, "Nrrr": -0.013}
)
"""Dimensionless hydrodynamic derivatives of the hull: forces by ½ρLdU², moments by ½ρL²dU², velocities by U and U/L."""

PROPELLER = {"k0": 0.2931, "k1": -0.2753, "k2": -0.1385, "deduction": 0.220, "C1": 2.0, "C2+": 1.6, "C2-": 1.1}
"""Thrust `K_T = k0 + k1 J + k2 J²`, thrust deduction, and the wake that changes with the inflow angle."""

RUDDER = {"deduction": 0.387, "hull": 0.312, "place": -0.464, "straightening+": 0.640, "straightening-": 0.395} | {
    "arm": -0.710,
    "wake": 1.09,
    "jet": 0.50,
    "lift": 2.747,
}
"""Interaction coefficients t_R, a_H, x_H', γ_R, l_R', ε and κ, and the slope f_α of the rudder's lift."""


def manoeuvring_ship(
    length: float = 7.0,
    draught: float = 0.46,
    displacement: float = 3.27,
    centre: float = 0.25,
    propeller_diameter: float = 0.216,
    rudder_height: float = 0.345,
    rudder_area: float = 0.0539,
    wake: float = 0.40,
    density: float = 1000.0,
    hull: Mapping[str, float] | None = None,
    propeller: Mapping[str, float] | None = None,
    rudder: Mapping[str, float] | None = None,
) -> StateSpace:
    """Model of the tanker KVLCC2, 7 m long; x = (north, east, heading, surge, sway, yaw rate).

    The outputs are north, east [m] and heading [rad]. The input is (rudder angle [rad], revolutions [1/s]); a positive
    angle turns the bow to starboard. The model is valid only at cruising speed ahead, with the propeller turning ahead
    and positive surge.

    Args:
        length: Length [m].
        draught: Draught [m].
        displacement: Displacement [m³].
        centre: Distance of the centre of gravity forward of midships [m].
        propeller_diameter: Diameter of the propeller [m].
        rudder_height: Height of the rudder [m].
        rudder_area: Area of the rudder [m²].
        wake: Wake fraction at the propeller in straight motion.
        density: Density of the water [kg/m³].
        hull: Entries of `HULL` to override.
        propeller: Entries of `PROPELLER` to override.
        rudder: Entries of `RUDDER` to override.

    Returns:
        The system with six states and two inputs.

    Raises:
        ValueError: An entry is not known; the message names it.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> ahead = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
        >>> rate = models.marine.manoeuvring_ship().f(0.0, ahead, jnp.array([0.2, 10.0]))
        >>> bool(rate[5] > 0)  # the bow turns to starboard
        True
    """
    h, p, r = _merge("hull", HULL, hull), _merge("propeller", PROPELLER, propeller), _merge("rudder", RUDDER, rudder)
    mass, scale = density * displacement, density / 2 * length * draught
    added = {"x": 0.022 * scale * length, "y": 0.223 * scale * length, "z": 0.011 * scale * length**3}
    # The source assumes the radius of gyration L/4; the moment is about midships, hence Steiner's term.
    turning = mass * (length / 4) ** 2 + centre**2 * mass + added["z"]
    ratio = propeller_diameter / rudder_height
    stated = {"length": (length, "m"), "draught": (draught, "m"), "displacement": (displacement, "m^3")}
    stated |= {"centre": (centre, "m"), "propeller_diameter": (propeller_diameter, "m"), "wake": (wake, "1")}
    stated |= {"rudder_height": (rudder_height, "m"), "rudder_area": (rudder_area, "m^2")}
    return StateSpace(
        Parametric(
            _f,
            length=length,
            mass=mass,
            scale=scale,
            added=added,
            turning=turning,
            ratio=ratio,
            centre=centre,
            diameter=propeller_diameter,
            rudder_area=rudder_area,
            wake=wake,
            density=density,
            hull=h,
            propeller=p,
            rudder=r,
        ),
        _position,
        coordinates=("north", "east", "heading", "surge", "sway", "yaw_rate"),
        units=("m", "m", "rad", "m/s", "m/s", "rad/s"),
        outputs=("north", "east", "heading"),
        inputs={"rudder": "rad", "revolutions": "1/s"},
        circles=(2,),
        parameters={name: Parameter(value, unit, _MMG) for name, (value, unit) in stated.items()}
        | {
            name: Parameter(list(each.values()), "1", f"{_MMG}: {', '.join(each)}")
            for name, each in (("hull", h), ("propeller", p), ("rudder", r))
        },
    )


def _merge(name: str, defaults: Mapping[str, float], overrides: Mapping[str, float] | None) -> dict[str, float]:
    for entry in overrides or {}:
        refuse_unknown(f"entry of {name}", entry, defaults)
    return {**defaults, **(overrides or {})}


def _f(t, x, u, mass, added, turning, centre, **rest):
    nu = x[3:]
    surge, sway, yaw = nu
    zero = jnp.zeros_like(mass)
    m = jnp.stack(
        [
            jnp.stack([mass + added["x"], zero, zero]),
            jnp.stack([zero, mass + added["y"], mass * centre]),
            jnp.stack([zero, mass * centre, turning]),
        ]
    )
    # Coriolis and centripetal terms, on the right-hand side.
    turned = jnp.stack(
        [
            (mass + added["y"]) * sway * yaw + mass * centre * yaw**2,
            -(mass + added["x"]) * surge * yaw,
            -mass * centre * surge * yaw,
        ]
    )
    return jnp.concatenate([yaw_rotation(x[2]) @ nu, solve(m, _forces(nu, u[0], u[1], _Ship(**rest)) + turned)])


def _position(t, x, u):
    return x[:3]


class _Ship(NamedTuple):
    """Parameters of the forces: those of `manoeuvring_ship`, `scale` ½ρLd [kg/m], and `ratio`, propeller to rudder."""

    length: Array
    scale: Array
    ratio: Array
    diameter: Array
    rudder_area: Array
    wake: Array
    density: Array
    hull: dict[str, Array]
    propeller: dict[str, Array]
    rudder: dict[str, Array]


class _Flow(NamedTuple):
    """Water around the ship: speed U at midships [m/s], drift angle β [rad], and r L [m/s] by the yaw rate r."""

    speed: Array
    drift: Array
    turn: Array


def _forces(nu, delta, n, ship: _Ship):
    """Surge and sway force and yaw moment at midships [N, N, N m]."""
    u, v, yaw = nu
    speed = jnp.maximum(jnp.sqrt(u**2 + v**2), 1e-9)  # a divisor below
    # A positive drift angle means motion to port, v < 0: the water then comes from that side.
    flow = _Flow(speed, jnp.arctan2(-v, u), yaw * ship.length)
    x, y, z = _hull(v, flow, ship.hull)
    inflow_speed, jet, thrust = _propeller(u, n, flow, ship)
    lift = _lift(delta, inflow_speed, jet, flow, ship)
    # For δ > 0 the force across the ship is −F_N: it pushes the stern to port and turns the bow to starboard.
    side, rudder, length = lift * jnp.cos(delta), ship.rudder, ship.length
    thrust, braking = (1 - ship.propeller["deduction"]) * thrust, (1 - rudder["deduction"]) * lift * jnp.sin(delta)
    return jnp.stack(
        [
            ship.scale * x + thrust - braking,
            ship.scale * y - (1 + rudder["hull"]) * side,
            ship.scale * length * z - (-0.5 + rudder["hull"] * rudder["place"]) * length * side,
        ]
    )


def _hull(v, flow: _Flow, hull: dict[str, Array]):
    """Surge and sway force by `scale`, and yaw moment by `scale * length` [m²/s²], of the hull alone."""
    speed, turn = flow.speed, flow.turn
    # v' = v/U and r' = rL/U, so U² times a quadratic term is independent of U, and a cubic term has the factor 1/U.
    x = -hull["R0"] * speed**2 + hull["Xvv"] * v**2 + hull["Xvr"] * v * turn + hull["Xrr"] * turn**2
    x = x + hull["Xvvvv"] * v**4 / speed**2
    cubic = (v**3, v**2 * turn, v * turn**2, turn**3)
    y, z = (
        (hull[f"{a}v"] * v + hull[f"{a}r"] * turn) * speed
        + sum(hull[f"{a}{name}"] * c for name, c in zip(("vvv", "vvr", "vrr", "rrr"), cubic, strict=True)) / speed
        for a in "YN"
    )
    return x, y, z


def _propeller(u, n, flow: _Flow, ship: _Ship):
    """Speed of the water into the propeller and of its jet [m/s], and its thrust [N]."""
    propeller = ship.propeller
    inflow = flow.drift + 0.5 * flow.turn / flow.speed  # the propeller is half a length aft of midships
    swirl = jnp.where(inflow > 0, propeller["C2+"], propeller["C2-"]) - 1
    inflow_speed = (1 - ship.wake) * u * (1 + (1 - jnp.exp(-propeller["C1"] * jnp.abs(inflow))) * swirl)
    tip = jnp.maximum(n * ship.diameter, 1e-9)  # a divisor below
    advance = inflow_speed / tip
    thrust_coefficient = propeller["k0"] + propeller["k1"] * advance + propeller["k2"] * advance**2
    # Speed of the propeller's jet by momentum theory; for a braking thrust there may be no real root.
    # The source divides by the advance ratio J. Multiplied by its square, the formula is finite without inflow or
    # revolutions.
    jet = jnp.sqrt(jnp.maximum(inflow_speed**2 + 8 * thrust_coefficient * tip**2 / math.pi, 0.0))
    return inflow_speed, jet, ship.density * n**2 * ship.diameter**4 * thrust_coefficient


def _lift(delta, inflow_speed, jet, flow: _Flow, ship: _Ship):
    """Normal force [N] on the rudder."""
    rudder, ratio = ship.rudder, ship.ratio
    drift = flow.drift - rudder["arm"] * flow.turn / flow.speed
    cross = flow.speed * drift * jnp.where(drift > 0, rudder["straightening+"], rudder["straightening-"])
    along = rudder["wake"] * jnp.sqrt(
        ratio * (inflow_speed + rudder["jet"] * (jet - inflow_speed)) ** 2 + (1 - ratio) * inflow_speed**2
    )
    attack = jnp.sin(delta - jnp.arctan2(cross, along))
    return ship.density / 2 * ship.rudder_area * (along**2 + cross**2) * rudder["lift"] * attack
