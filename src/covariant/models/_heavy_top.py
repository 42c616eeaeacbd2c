"""A rigid body that rotates about a fixed point: the heavy top and, without gravity, the free body."""

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
    """Top of Maithripala, Berg & Dayawansa 2004, section IV-A, equations (31)–(32), with any inertia.

    - `inertia` [kg m²] about the fixed point: three principal moments, or a matrix (3, 3).
    - `moment`: m g l [N m], the weight times the distance of the centre of mass, which lies along `axis` in the body.
      Gravity points along −z in space.
    - `viscous` [N m s/rad]: friction proportional to the angular velocity.

    Inputs are three torques in the body frame [N m].
    """
    xp = namespace(inertia, moment, axis)
    matrix, along = xp.asarray(inertia, float), xp.asarray(axis, float)
    matrix = xp.diag(matrix) if matrix.ndim == 1 else matrix
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
    """A freely rotating body, with torques in the body frame [N m] as inputs: `heavy_top` with no gravity moment."""
    return heavy_top(inertia, moment=0.0)


def _height(g, arm):
    return g[2] @ arm


def _viscous(g, v, coefficient):
    return -coefficient * v
