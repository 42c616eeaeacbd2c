"""Represents forces and torques on the links of a robot as slow states of a filter.

A force on a link acts on the joints through the transpose of its Jacobian. The filter estimates the force on the link,
and not the torques of the joints. If no joint can feel a component, its uncertainty stays as it was at first: no
Jacobian is inverted, even near singular poses.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Number, Numbers, Vector
from covariant.geometry import AbstractSpace
from covariant.models.robots import RobotSpace, robot_space
from covariant.observers.base import as_numbers, check_positive
from covariant.observers.sensors._slow import SlowVariables, forgotten_force
from scalargraph.errors import InputError

FRAMES = ("link", "world")
_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


class _OnLink(eqx.Module):
    """Generalised force of the components s (k,) of a wrench on a link: `Jᵀ w`."""

    space: RobotSpace
    axes: Float[Array, "6 k"]
    point: Float[Array, "3"]
    link: str = eqx.field(static=True)
    frame: str = eqx.field(static=True)

    def __call__(self, q: Array, v: Vector, s: Float[Array, "k"]) -> Vector:
        force, torque = jnp.split(self.axes.astype(s.dtype) @ s, 2)
        if self.frame == "world":
            # f @ R is Rᵀ f: it converts from the axes of the world to those of the link.
            rotation = self.space.pose(q, self.link)[:3, :3]
            force, torque = force @ rotation, torque @ rotation
        # A force at p has the power f·(v + ω × p) + τ·ω, like (f, τ + p × f) at the origin.
        torque = torque + jnp.cross(self.point.astype(s.dtype), force)
        return self.space.jacobian(q, self.link).T @ jnp.concatenate([force, torque])


def wrench(
    space: AbstractSpace,
    link: str,
    force_std: Numbers,
    torque_std: Numbers = 0.0,
    *,
    time: Number,
    name: str | None = None,
    frame: str = "link",
    point: Numbers = (0.0, 0.0, 0.0),
) -> SlowVariables:
    """An external force and torque on a link of a robot that are forgotten over time, such as a push or a contact.

    Each component is a Gauss–Markov process about zero. Combine it with an `external_force` of the size of the model's
    errors in the joints, such as friction; otherwise every such error would appear as a push.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        force_std: Usual size of the force [N], one number or (3,); zero for a component that does not act.
        torque_std: Usual size of the torque [N m], one number or (3,); zero (default) for none.
        time: Time constant τ [s] with which it is forgotten.
        name: Suffix of the names of the states, by default the name of the link: `fx_hand` … `tz_hand`.
        frame: Axes of the components, those of the "link" (default) or of the "world".
        point: Point at which the force acts, in the frame of the link [m]; its origin by default. Torques are about it.

    Returns:
        A group with a state for each component whose usual size is positive [N and N m].

    Raises:
        ValueError: There is no such link or frame, a number is not finite and ≥ 0, or all of them are zero.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.robots.load("double_pendulum")
        >>> push = observers.wrench(arm.space, "lower", [5.0, 0.0, 5.0], time=0.3)
        >>> push.names
        ('fx_lower', 'fz_lower')
        >>> push.force(arm.manifold.origin(), arm.manifold.zero(arm.manifold.origin()), push.first + 1.0).shape
        (2,)
    """
    if frame not in FRAMES:
        raise InputError(f"wrench: frame must be one of {', '.join(FRAMES)}; got {frame!r}")
    check_positive("wrench", time=time)
    stds = np.concatenate(
        [as_numbers("wrench", "force_std", force_std, 3, 0.0), as_numbers("wrench", "torque_std", torque_std, 3, 0.0)]
    )
    place = as_numbers("wrench", "point", point, 3)
    acting = np.flatnonzero(stds > 0)
    if not acting.size:
        raise InputError("wrench: force_std and torque_std are all zero; give the usual size of a component that acts")
    tree = robot_space(space)
    if tree is None:
        raise InputError(f"wrench: {type(space).__name__} has no links; give the space of a robot")
    force = _OnLink(tree, jnp.asarray(np.eye(6)[:, acting]), jnp.asarray(place), link, frame)
    q = jax.eval_shape(space.manifold.origin)
    v = jax.eval_shape(space.manifold.zero, q)
    try:
        eqx.filter_eval_shape(force, q, v, jax.ShapeDtypeStruct((acting.size,), v.dtype))
    except InputError as error:
        raise InputError(f"wrench: {error}") from error
    names = tuple(f"{_AXES[i]}_{link if name is None else name}" for i in acting)
    return forgotten_force(names, stds[acting], time, force)
