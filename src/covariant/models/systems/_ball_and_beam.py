"""The ball and beam of Aghannan & Rouchon 2003, appendix I: a machine whose curvature is always negative."""

import jax.numpy as jnp

from covariant._typing import Number
from covariant.models._mechanical import Lagrangian
from covariant.models._parameters import Parameter, Parametric

_SOURCE = "Aghannan & Rouchon 2003, appendix I (normalised)"


def ball_and_beam(gravity: Number = 1.0, mass: Number = 1.0, inertia: Number = 1.0) -> Lagrangian:
    """Ball at r [m] on a beam at angle θ [rad] from the horizontal, driven by a torque u [N m] on the beam.

    The default values are those of the paper's normalised form (13). The Gaussian curvature of the metric is
    `−inertia/(inertia + mass r²)²`.

    Args:
        gravity: Gravity [m/s²].
        mass: Mass of the ball [kg], rolling inertia included.
        inertia: Inertia of the beam [kg m²].

    Returns:
        The system with coordinates (r, theta) and one input.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.ball_and_beam().metric(jnp.array([2.0, 0.0])).tolist()
        [[1.0, 0.0], [0.0, 5.0]]
    """
    return Lagrangian(
        Parametric(_metric, mass=mass, inertia=inertia),
        Parametric(_potential, mass=mass, gravity=gravity),
        _on_the_beam,
        coordinates=("r", "theta"),
        units=("m", "rad"),
        inputs=1,
        parameters={
            "gravity": Parameter(gravity, "m/s^2", _SOURCE),
            "mass": Parameter(mass, "kg", _SOURCE),
            "inertia": Parameter(inertia, "kg m^2", _SOURCE),
        },
    )


def _metric(q, mass, inertia):
    # The ball has the velocity (r', r θ') and the beam turns with it: T = ½ mass r'² + ½ (inertia + mass r²) θ'².
    return jnp.diag(jnp.stack([jnp.broadcast_to(mass, q[0].shape), inertia + mass * q[0] ** 2]))


def _potential(q, mass, gravity):
    # The height of the ball above the pivot is r sin θ.
    return mass * gravity * q[0] * jnp.sin(q[1])


def _on_the_beam(t, q, u):
    # The torque acts on the beam's angle only: its power is u θ', so the covector is (0, u).
    return jnp.stack([jnp.zeros_like(u[0]), u[0]])
