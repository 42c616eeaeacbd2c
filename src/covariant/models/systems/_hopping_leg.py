"""Models a body on a leg of two links in a vertical plane, whose foot touches the ground."""

from collections.abc import Sequence

import jax.numpy as jnp

from covariant._typing import Number
from covariant.models._mechanical import Lagrangian
from covariant.models._parameters import Parameter, Parametric

_UNITS = {"body": "kg", "mass": "kg", "inertia": "kg m^2", "length": "m", "gravity": "m/s^2"}


def hopping_leg(
    body: Number = 4.0,
    mass: Sequence[Number] = (1.0, 0.4),
    inertia: Sequence[Number] = (0.01, 0.004),
    length: Sequence[Number] = (0.3, 0.3),
    gravity: Number = 9.81,
) -> Lagrangian:
    """A body on a leg of two links with a foot, in a vertical plane; the body does not turn.

    Use it to see the effect of an impact on an estimate, and as an example of a model with `feet`. The foot is a point
    and may be anywhere, since the ground is not part of the model.

    Args:
        body: Mass of the body [kg], at the hip.
        mass: Masses of thigh and shank [kg], at their midpoints.
        inertia: Their inertias [kg m²] about the midpoints.
        length: Their lengths [m].
        gravity: Gravity [m/s²].

    Returns:
        The system with the coordinates x and z of the hip [m], the angle of the thigh from hanging down, and the angle
        of the knee [rad]. Inputs are the torques [N m] of hip and knee, and the contact of the foot: 1 on the ground.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> leg = models.hopping_leg()
        >>> leg.coordinates, leg.inputs
        (('x', 'z', 'hip', 'knee'), 3)
        >>> leg.feet(jnp.array([0.0, 0.6, 0.0, 0.0])).tolist()  # stretched, on the ground
        [[0.0, 0.0]]
    """
    numbers = {"body": body, "mass": jnp.asarray(mass), "inertia": jnp.asarray(inertia), "length": jnp.asarray(length)}
    weight = numbers | {"gravity": gravity}
    return Lagrangian(
        Parametric(_metric, **numbers),
        Parametric(_potential, **{name: weight[name] for name in ("body", "mass", "length", "gravity")}),
        _force,
        coordinates=("x", "z", "hip", "knee"),
        units=("m", "m", "rad", "rad"),
        inputs=3,
        feet=Parametric(_feet, length=numbers["length"]),
        parameters={name: Parameter(weight[name], unit, "chosen") for name, unit in _UNITS.items()},
    )


def _down(angle):
    """Direction (2,) of a link that hangs down at angle zero and swings forwards."""
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


def _turned(angle):
    """Derivative of `_down` by the angle."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _metric(q, body, mass, inertia, length):
    thigh, shank = length[0] * _turned(q[2]), length[1] * _turned(q[2] + q[3])
    none = jnp.zeros(2)
    # Velocities of the links' midpoints per rate of the four coordinates; the shank turns with both angles.
    middles = [
        jnp.column_stack([jnp.eye(2), thigh / 2, none]),
        jnp.column_stack([jnp.eye(2), thigh + shank / 2, shank / 2]),
    ]
    turning = jnp.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    links = sum(mass[i] * middles[i].T @ middles[i] for i in range(2)) + turning.T @ (inertia[:, None] * turning)
    return links + jnp.diag(body * jnp.array([1.0, 1.0, 0.0, 0.0]))


def _potential(q, body, mass, length, gravity):
    knee = q[1] + length[0] * _down(q[2])[1]
    middles = (q[1] + knee) / 2, knee + length[1] * _down(q[2] + q[3])[1] / 2
    return gravity * (body * q[1] + mass[0] * middles[0] + mass[1] * middles[1])


def _feet(q, length):
    return (q[:2] + length[0] * _down(q[2]) + length[1] * _down(q[2] + q[3]))[None]


def _force(t, q, u):
    """The torques of hip and knee; the last input, the contact of the foot, is not a force."""
    return jnp.stack([jnp.zeros_like(u[0]), jnp.zeros_like(u[0]), u[0], u[1]])
