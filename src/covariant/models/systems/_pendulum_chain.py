"""Models planar chains of pendulums: any number of links, absolute or relative angles, geared rotors, joint friction.

The inertia is that of the double pendulum of Wiebe et al. (double_pendulum, DFKI RIC), extended to n links: link i
rotates at the absolute rate ω_i; the rotor of joint i is on link i−1 and turns at ω_{i−1} − gear_i q̇_i.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from covariant._typing import Number
from covariant.models._mechanical import Lagrangian
from covariant.models._parameters import AnyArray, Parameter, Parametric, known, namespace
from scalargraph.errors import InputError

COULOMB_STEEPNESS = 100.0
"""Slope at rest of the smoothed Coulomb friction `coulomb * atan(100 v)` [s/rad]."""

_UNITS = {
    "mass": "kg",
    "length": "m",
    "com": "m",
    "inertia": "kg m^2",
    "rotor_inertia": "kg m^2",
    "gear": "1",
    "viscous": "N m s/rad",
    "coulomb": "N m",
    "offset": "N m",
}


def pendulum_chain(
    mass: Sequence[Number] = (1.0, 1.0),
    length: Sequence[Number] = (1.0, 1.0),
    com: Sequence[Number] | None = None,
    inertia: Sequence[Number] | None = None,
    *,
    angles: str = "relative",
    zero: str = "hanging",
    inertia_about: str = "com",
    rotor_inertia: Sequence[Number] | None = None,
    gear: Sequence[Number] | None = None,
    viscous: Sequence[Number] | None = None,
    coulomb: Sequence[Number] | None = None,
    offset: Sequence[Number] | None = None,
    actuated: Sequence[int] | None = None,
    gravity: Number = 9.81,
    source: str = "chosen",
) -> Lagrangian:
    """Chain of n links that swings in a vertical plane; each sequence has one entry for each link.

    Coordinates are angles on full circles [rad]. The inertia is that of Wiebe et al. (double_pendulum), extended to n
    links.

    Use it for swings, cranes and simple arms; with two links it is the double pendulum, whose free motion is chaotic.
    Angles are relative by default, as encoders at joints measure them. State the `source` of measured parameters.

    Args:
        mass: Mass of each link [kg]; the number of entries is n.
        length: Length from joint to joint [m].
        com: Distance from joint to centre of mass [m]; by default at the end, a point mass.
        inertia: Inertia [kg m²] about the centre of mass, or about the joint (`inertia_about`); zero by default.
        angles: "relative" for joint angles, "absolute" for the angle of each link from the vertical.
        zero: Configuration at zero angles, "hanging" or "upright".
        inertia_about: Point that `inertia` refers to, "com" or "joint".
        rotor_inertia: Inertia of each rotor [kg m²] before the gear ratio; zero by default.
        gear: Gear ratio of each joint; 1 by default.
        viscous: Coefficient [N m s/rad] of the friction torque `viscous q̇ + coulomb atan(100 q̇)` in each joint.
        coulomb: Coefficient [N m] of the same friction torque; zero by default.
        offset: Constant torque in each joint [N m]; zero by default.
        actuated: Indices of the joints with an input torque [N m], in the order of the inputs; all by default.
        gravity: Gravity [m/s²].
        source: Source of the numbers, for their documentation.

    Returns:
        The system with coordinates q1, …, qn.

    Raises:
        ValueError: A sequence has another length, a choice or index does not exist, or a mass, inertia or friction is
            negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> acrobot = models.pendulum_chain(actuated=[1])
        >>> acrobot.coordinates, acrobot.inputs
        (('q1', 'q2'), 1)
        >>> acrobot.metric(jnp.zeros(2)).tolist()  # both links hanging
        [[5.0, 2.0], [2.0, 1.0]]
    """
    n = len(mass)
    sequences = {
        "mass": mass,
        "length": length,
        "com": length if com is None else com,
        "inertia": inertia,
        "rotor_inertia": rotor_inertia,
        "gear": np.ones(n) if gear is None else gear,
        "viscous": viscous,
        "coulomb": coulomb,
        "offset": offset,
    }
    p = {name: _per_link(name, value, n) for name, value in sequences.items()}
    _one_of("angles", angles, ("relative", "absolute"))
    _one_of("zero", zero, ("hanging", "upright"))
    _one_of("inertia_about", inertia_about, ("com", "joint"))
    for name in ("mass", "inertia", "rotor_inertia", "viscous", "coulomb"):
        if known(p[name]) and (p[name] < 0).any():
            raise InputError(f"pendulum_chain: {name} must not be negative; got {tuple(p[name].tolist())}")

    # Steiner's theorem: `coupling` already contains the energy of the centres of mass, hence m com².
    about_com = p["inertia"] - (p["mass"] * p["com"] ** 2 if inertia_about == "joint" else 0.0)
    carriers, identity = np.tri(n, k=-1), np.eye(n)
    arms = carriers * p["length"][None] + identity * p["com"][None]  # arms[k, i]: lever arm of link i at mass k
    # Point masses at rate ω: Σ m_k |Σ_i arms[k, i] ω_i e(θ_i)|²; mixed terms have e(θ_i)·e(θ_j) = cos(θ_i − θ_j).
    coupling = (arms.T * p["mass"][None]) @ arms
    moment = p["mass"] @ arms
    relative = np.eye(n) - np.eye(n, k=-1)  # joint rates from absolute rates
    rotor_rates = np.eye(n, k=-1) - p["gear"][:, None] * relative  # rotor rates from absolute rates
    constant = identity * about_com[None] + (rotor_rates.T * p["rotor_inertia"][None]) @ rotor_rates
    # The inverse has only entries 0 and 1, so elimination makes no rounding errors.
    absolute = np.linalg.inv(relative) if angles == "relative" else np.eye(n)  # absolute rates from the coordinates'
    between = absolute[:, None, :] - absolute[None, :, :]
    joints = np.eye(n) if angles == "relative" else relative  # joint rates from the coordinates'
    # The potential is sign · g · Σ m h cos: at zero angles highest if upright, lowest if hanging.
    sign = 1.0 if zero == "upright" else -1.0
    driven = list(range(n)) if actuated is None else list(actuated)
    if any(not 0 <= i < n for i in driven):
        raise InputError(f"pendulum_chain: actuated {tuple(driven)} must be joints 0 to {n - 1}")

    return Lagrangian(
        Parametric(_metric, coupling=coupling, constant=constant, between=between, absolute=absolute),
        Parametric(_potential, moment=moment, absolute=absolute, gravity=sign * gravity),
        Parametric(_force, offset=p["offset"], motors=np.eye(n)[:, driven], joints=joints),
        Parametric(_dissipation, viscous=p["viscous"], coulomb=p["coulomb"], joints=joints),
        circles=tuple(range(n)),
        coordinates=tuple(f"q{i + 1}" for i in range(n)),
        units=("rad",) * n,
        inputs=len(driven),
        parameters={name: Parameter(p[name], unit, source) for name, unit in _UNITS.items()}
        | {"gravity": Parameter(gravity, "m/s^2", source)},
    )


def _metric(q, coupling, constant, between, absolute):
    # Angles between links are computed directly from the coordinates, so the first link's angle drops out.
    links = coupling * jnp.cos(between @ q)
    return absolute.T @ (links + constant) @ absolute


def _potential(q, moment, absolute, gravity):
    return gravity * (moment @ jnp.cos(absolute @ q))


def _force(t, q, u, offset, motors, joints):
    return joints.T @ (offset + motors @ u)


def _dissipation(q, v, viscous, coulomb, joints):
    rate = joints @ v
    # At high speed the Coulomb torque is coulomb·π/2, not coulomb, as Wiebe et al. define the coefficient.
    return -joints.T @ (viscous * rate + coulomb * jnp.arctan(COULOMB_STEEPNESS * rate))


def _per_link(name: str, value: Sequence[Number] | AnyArray | None, n: int) -> AnyArray:
    array = np.zeros(n) if value is None else namespace(value).asarray(value, float)
    if array.shape != (n,):
        raise InputError(f"pendulum_chain: {name} needs one number a link, {n} as in mass; got {np.size(array)}")
    if known(array) and not np.isfinite(array).all():
        raise InputError(f"pendulum_chain: {name} must be finite; got {tuple(array.tolist())}")
    return array


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise InputError(f"pendulum_chain: {name} must be one of {', '.join(choices)}; got {value!r}")
