"""Models two ships in the horizontal plane: an offshore supply vessel at low speed, and a laboratory model ship."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._typing import Numbers
from covariant.models._parameters import Parameter, Parametric
from covariant.models.marine._craft import Craft, coriolis_matrix, positive_definite, yaw_rotation

_SUPPLY = "Fossen, Sagatun & Sørensen 1996, Identification of dynamically positioned ships, CEP 4(3)"
_CYBERSHIP = "Skjetne, Smogeli & Fossen 2004, Modeling, identification, and adaptive maneuvering of CyberShip II, CAMS"


def surface_ship(
    mass: Numbers,
    damping: Numbers | Callable[[Array], Array],
    mooring: Numbers | None = None,
    coriolis: Callable[[Array], Array] | None = None,
    parameters: dict[str, Parameter] | None = None,
) -> Craft:
    """Surface ship with η = (north, east [m], heading [rad]) and ν = (surge, sway [m/s], yaw rate [rad/s]), (38)–(39).

    Args:
        mass: Inertia matrix (3, 3), added mass included.
        damping: Matrix (3, 3), or a function `ν -> (3, 3)`.
        mooring: Stiffness K (3, 3) in north, east and heading, whose force is `R(ψ)ᵀKη` in the body frame; none by
            default. The paper prints Kη, which is the same only at ψ = 0.
        coriolis: Coriolis matrix `ν -> (3, 3)`; zero by default.
        parameters: A `Parameter` for each name, as documentation.

    Returns:
        The craft.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> models.marine.surface_ship(np.eye(3), 0.1 * np.eye(3)).velocities
        ('surge', 'sway', 'yaw_rate')
    """
    return Craft(
        mass,
        _yaw_matrix,
        damping if callable(damping) else Parametric(_constant, matrix=damping),
        None if mooring is None else Parametric(_mooring, stiffness=mooring),
        coriolis,
        coordinates=("north", "east", "heading"),
        units=("m", "m", "rad"),
        velocities=("surge", "sway", "yaw_rate"),
        circles=(2,),
        parameters=parameters,
    )


def _yaw_matrix(eta):
    return yaw_rotation(eta[2])


def _constant(nu, matrix):
    return matrix


def _mooring(eta, stiffness):
    # Rᵀ turns the force from north and east to the body frame.
    return yaw_rotation(eta[2]).T @ (stiffness @ eta)


def supply_vessel(
    length: float = 76.2,
    mass: float = 6000e3,
    gravity: float = 9.81,
    inertia: Sequence[Sequence[float]] = ((1.1274, 0.0, 0.0), (0.0, 1.8902, -0.0744), (0.0, -0.0744, 0.1278)),
    damping: Sequence[Sequence[float]] = ((0.0358, 0.0, 0.0), (0.0, 0.1183, -0.0124), (0.0, -0.0041, 0.0308)),
    mooring: Numbers | None = None,
) -> Craft:
    """Offshore supply vessel near rest, for dynamic positioning: linear damping, no Coriolis force.

    The dimensionless matrices were identified at sea, in the Bis system: lengths are scaled by L, times by √(L/g),
    masses by m.

    Use it for low speed only. It is a typical model on which to try `PassiveShip` and `Station`.

    Args:
        length: Length L [m].
        mass: Mass m [kg].
        gravity: Gravity g [m/s²].
        inertia: Dimensionless inertia matrix (3, 3).
        damping: Dimensionless damping matrix (3, 3).
        mooring: Stiffness (3, 3) of a mooring [N/m, N, N m], as for `surface_ship`; none by default.

    Returns:
        The craft.

    Example:
        >>> from covariant import models
        >>> vessel = models.marine.supply_vessel(mass=6000e3)
        >>> round(vessel.mass[0, 0].item() / 6000e3, 4)  # added mass in surge included
        1.1274
    """
    # Yaw is the only angle: its rows and columns contribute one length each, so moments scale with L².
    stretch = np.diag([1.0, 1.0, length])
    m = mass * stretch @ np.asarray(inertia, float) @ stretch
    d = mass * np.sqrt(gravity / length) * stretch @ np.asarray(damping, float) @ stretch
    return surface_ship(
        positive_definite("inertia", m, 3),
        d,
        mooring,
        parameters={
            "length": Parameter(length, "m", _SUPPLY),
            "mass": Parameter(mass, "kg", _SUPPLY),
            "inertia": Parameter(np.ravel(inertia), "1", _SUPPLY),
            "damping": Parameter(np.ravel(damping), "1", _SUPPLY),
        },
    )


def cybership(
    mass: float = 23.8,
    inertia: float = 1.76,
    centre: float = 0.046,
    added_mass: Sequence[float] = (2.0, 10.0, 0.0, 0.0, 1.0),
    surge_drag: Sequence[float] = (0.72253, 1.32742, 5.86643),
    sway_drag: Sequence[float] = (0.88965, 36.47287, 0.805, 7.25, 0.845, 3.45),
    yaw_drag: Sequence[float] = (-0.0313, -3.95645, -0.13, 1.9, -0.08, 0.75),
) -> Craft:
    """CyberShip II, a supply ship at 1:70, 1.255 m long, with its identified nonlinear drag and Coriolis force.

    The drag was fitted to towed motions. If the ship turns and drifts at the same time, the drag does not dissipate
    energy in every motion. All hydrodynamic derivatives have the opposite sign of the usual ones.

    Args:
        mass: Mass [kg].
        inertia: Inertia about the vertical axis [kg m²].
        centre: Distance of the centre of gravity forward of the origin [m].
        added_mass: Derivatives X_u̇, Y_v̇, Y_ṙ, N_v̇, N_ṙ [kg, kg m, kg m²].
        surge_drag: Derivatives X_u, X_|u|u, X_uuu [N s/m, N s²/m², N s³/m³].
        sway_drag: Derivatives Y_v, Y_|v|v, Y_|r|v, Y_r, Y_|v|r, Y_|r|r [N s/m, N s²/m² and with angles].
        yaw_drag: Derivatives N_v, N_|v|v, N_|r|v, N_r, N_|v|r, N_|r|r [N m s, N m s² and with lengths].

    Returns:
        The craft.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.marine.cybership(surge_drag=(1.0, 2.0, 3.0)).damping(jnp.array([2.0, 0.0, 0.0]))[0, 0].item()
        17.0
    """
    x_u, y_v, y_r, n_v, n_r = added_mass
    # The identified Y_ṙ and N_v̇ differ; their mean makes the inertia symmetric, as a kinetic energy requires.
    across = mass * centre + (y_r + n_v) / 2
    m = np.array([[mass + x_u, 0.0, 0.0], [0.0, mass + y_v, across], [0.0, across, inertia + n_r]])
    return surface_ship(
        m,
        Parametric(_identified_drag, surge=surge_drag, sway=sway_drag, yaw=yaw_drag),
        coriolis=coriolis_matrix(m),
        parameters={
            "mass": Parameter(mass, "kg", _CYBERSHIP),
            "inertia": Parameter(inertia, "kg m^2", _CYBERSHIP),
            "centre": Parameter(centre, "m", _CYBERSHIP),
            "added_mass": Parameter(added_mass, "kg, kg m, kg m^2", _CYBERSHIP),
            "surge_drag": Parameter(surge_drag, "N s/m, N s^2/m^2, N s^3/m^3", _CYBERSHIP),
            "sway_drag": Parameter(sway_drag, "N s/m, N s^2/m^2 and with angles", _CYBERSHIP),
            "yaw_drag": Parameter(yaw_drag, "N m s, N m s^2 and with lengths", _CYBERSHIP),
        },
    )


def _identified_drag(nu, surge, sway, yaw):
    u, v, r = jnp.abs(nu)
    u1, u2, u3 = surge
    (v1, vv, rv, r1, vr, rr), (w1, ww, sw, s1, ws, ss) = sway, yaw
    zero = jnp.zeros_like(u)
    rows = [
        [u1 + u2 * u + u3 * u**2, zero, zero],
        [zero, v1 + vv * v + rv * r, r1 + vr * v + rr * r],
        [zero, w1 + ww * v + sw * r, s1 + ws * v + ss * r],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
