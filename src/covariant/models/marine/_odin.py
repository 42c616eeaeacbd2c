"""Models ODIN, a spherical underwater robot with eight thrusters, in Euler angles, with a quaternion and on SE(3).

Source: Jouffroy & Fossen 2004, equations (80)–(85). The paper gives no numbers. The usual ones are used here: a sphere
of 0.31 m radius and 125 kg, half its displaced mass as added mass, the inertia of a shell, and the quadratic drag of
Choi, Yuh & Takashige 1995 as tabulated in Antonelli, Underwater Robots, appendix A. The drag was not checked against
the printed paper.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from covariant.geometry.lie import rotation_from_quaternion
from covariant.models._parameters import Parameter, Parametric
from covariant.models.marine._craft import Craft, coriolis_matrix, euler_rotation, euler_transform, quaternion_transform

_BODY = "Choi, Yuh & Takashige 1995: a sphere of 0.31 m radius, neutrally buoyant"
_SPHERE = "potential flow about a sphere: half the displaced mass, no added inertia"
_DRAG = "as tabulated after Choi, Yuh & Takashige 1995; not checked in print"
_CHOSEN = "chosen: the paper gives none"


def odin(
    mass: float = 125.0,
    inertia: Sequence[float] = (8.0, 8.0, 8.0),
    added_mass: Sequence[float] = (62.5, 62.5, 62.5, 0.0, 0.0, 0.0),
    drag: Sequence[float] = (0.0,) * 6,
    quadratic_drag: Sequence[float] = (48.0, 48.0, 48.0, 80.0, 80.0, 80.0),
    stability: float = 0.05,
    gravity: float = 9.81,
    coriolis: bool = False,
    quaternion: bool = False,
) -> Craft:
    """ODIN, a spherical underwater robot, in Euler angles: η = (north, east, down [m], roll, pitch, yaw [rad]).

    ν = (surge, sway, heave [m/s], p, q, r [rad/s]). The weight equals the buoyancy. At a pitch of ±90° the angles are
    singular. A quaternion (wxyz) in place of the angles has no singularity, and nor has `underwater_vehicle`, the body
    on SE(3); the sign of measured quaternions must not jump.

    Args:
        mass: Mass [kg].
        inertia: Moments of inertia (3,) [kg m²].
        added_mass: Added mass (6,) along and about the axes of the body [kg, kg m²].
        drag: Coefficients (6,) of the linear drag of each component of ν [N s/m, N m s].
        quadratic_drag: Coefficients (6,) of the quadratic drag [N s²/m², N m s²].
        stability: Distance of the centre of gravity below that of buoyancy, `z_g − z_b` [m].
        gravity: Gravity [m/s²].
        coriolis: Whether to add C(ν)ν, which the paper leaves out.
        quaternion: Whether the attitude is a unit quaternion instead of Euler angles.

    Returns:
        The craft.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> robot = models.marine.odin(mass=100.0, gravity=10.0, stability=0.05)
        >>> robot.restoring(jnp.zeros(6).at[3].set(jnp.pi / 2))[3].round(6).item()  # torque m g h at a roll of 90°
        50.0
    """
    # Translation and rotation are not coupled by m z_g: for a sphere (82) is diagonal.
    m = np.diag(np.asarray([mass] * 3 + list(inertia), float) + np.asarray(added_mass, float))
    angles = ("qw", "qx", "qy", "qz") if quaternion else ("roll", "pitch", "yaw")
    return Craft(
        m,
        quaternion_transform if quaternion else euler_transform,
        Parametric(_damping, linear=drag, square=quadratic_drag),
        Parametric(_restoring, torque=stability * mass * gravity),
        coriolis_matrix(m) if coriolis else None,
        coordinates=("north", "east", "down", *angles),
        units=("m", "m", "m", *("" if quaternion else "rad" for _ in angles)),
        velocities=("surge", "sway", "heave", "roll_rate", "pitch_rate", "yaw_rate"),
        velocity_units=("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s"),
        circles=() if quaternion else (3, 4, 5),
        parameters={
            "mass": Parameter(mass, "kg", _BODY),
            "inertia": Parameter(inertia, "kg m^2", _BODY),
            "added_mass": Parameter(added_mass, "kg, kg m^2", _SPHERE),
            "drag": Parameter(drag, "N s/m, N m s", "none, as in the paper"),
            "quadratic_drag": Parameter(quadratic_drag, "N s^2/m^2, N m s^2", _DRAG),
            "stability": Parameter(stability, "m", _CHOSEN),
        },
    )


def _damping(nu, linear, square):
    return jnp.diag(linear + square * jnp.abs(nu))


def _restoring(eta, torque):
    # The number of coordinates says how the attitude is written.
    rotation = euler_rotation(eta[3:]) if eta.shape == (6,) else rotation_from_quaternion(eta[3:])
    # Moment of a weight below the buoyancy, by the direction of down in the body, the last row: Fossen 2011, (4.6).
    zero = jnp.zeros((), eta.dtype)
    return torque * jnp.stack([zero, zero, zero, rotation[2, 1], -rotation[2, 0], zero])
