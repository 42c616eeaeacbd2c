"""Models a rigid body that rotates about a fixed point: the heavy top and, without gravity, the free body."""

from collections.abc import Sequence

from covariant._typing import Number
from covariant.geometry.lie import SO3
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter, Parametric, namespace

_SOURCE = "chosen: the paper gives no numbers"


def heavy_top(
    inertia: Sequence[Number] | Sequence[Sequence[Number]] = (0.2, 0.2, 0.1),
    moment: Number = 1.0,
    axis: Sequence[Number] = (0.0, 0.0, 1.0),
    viscous: Number = 0.0,
) -> GroupSystem:
    """Heavy top of Maithripala, Berg & Dayawansa 2004, section IV-A, equations (31)–(32), with any inertia.

    Gravity points along −z in space. Inputs are three torques in the body frame [N m].

    Args:
        inertia: Inertia about the fixed point [kg m²]: three principal moments, or a matrix (3, 3).
        moment: Gravity moment m g l [N m], the weight times the distance of the centre of mass from the fixed point.
        axis: Direction (3,) of the centre of mass in the body frame; it need not have unit length.
        viscous: Friction coefficient [N m s/rad] of the angular velocity.

    Returns:
        The system on SO(3), with the angular velocity in the body frame [rad/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.heavy_top(moment=2.0).potential(jnp.eye(3)).item()  # upright
        2.0
    """
    xp = namespace(inertia, moment, axis)
    matrix, along = xp.asarray(inertia, float), xp.asarray(axis, float)
    matrix = xp.diag(matrix) if matrix.ndim == 1 else matrix
    # U is m g l times the height of the unit vector along the arm: only the product m g l is identifiable.
    arm = moment * along / xp.linalg.norm(along)
    return GroupSystem(
        SO3,
        matrix,
        Parametric(_height, arm=arm),
        dissipation=Parametric(_viscous, coefficient=viscous),
        velocities=("w1", "w2", "w3"),
        units=("rad/s",) * 3,
        parameters={
            "inertia": Parameter(matrix.ravel(), "kg m^2", _SOURCE),
            "moment": Parameter(moment, "N m", _SOURCE),
            "viscous": Parameter(viscous, "N m s/rad", _SOURCE),
        },
    )


def free_body(inertia: Sequence[Number] | Sequence[Sequence[Number]] = (1.0, 2.0, 3.5)) -> GroupSystem:
    """Freely rotating rigid body: a `heavy_top` without gravity. Inputs are three torques in the body frame [N m].

    Use it for a satellite or for first tests of observers on SO(3). Its rotation has no friction, so kinetic energy and
    angular momentum are constant without inputs. Near the axis of the middle inertia the motion is unstable, which
    makes it a hard test.

    Args:
        inertia: Inertia [kg m²]: three principal moments, or a matrix (3, 3).

    Returns:
        The system on SO(3), with the angular velocity in the body frame [rad/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> body = models.free_body((1.0, 2.0, 3.0))
        >>> models.energy(body, jnp.eye(3), jnp.array([0.0, 0.0, 2.0])).item()
        6.0
    """
    return heavy_top(inertia, moment=0.0)


def _height(g, arm):
    return g[2] @ arm  # height: the z coordinate in space of the body vector `arm`


def _viscous(g, v, coefficient):
    return -coefficient * v
