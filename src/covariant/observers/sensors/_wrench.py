"""Forces and torques on the links of a robot, as slow states of a filter.

What pushes a link acts on the joints by the transpose of its Jacobian. The filter estimates the force on the link and
not the torques of the joints, so that joints that cannot feel a component leave it as uncertain as it was at first: no
Jacobian is inverted, near singular poses either.
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
            # f @ R is Rᵀ f: from the axes of the world to those of the link.
            rotation = self.space.pose(q, self.link)[:3, :3]
            force, torque = force @ rotation, torque @ rotation
        # The power f·(v + ω × p) + τ·ω of a force at p is that of (f, τ + p × f) at the origin.
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
    """A force and a torque that act on a link of a robot from outside, and that are forgotten: a push, a contact.

    Each component is a Gauss–Markov process about zero. Beside it give an `external_force` of the size of what the
    model does not know of the joints, such as their friction: all that is wrong with it would be taken for a push.

    Args:
        space: The configuration space of the robot, `model.space`.
        link: Name of the link.
        force_std: Usual size of the force [N], one number or (3,); zero for a component that does not act.
        torque_std: Usual size of the torque [N m], one number or (3,); zero (default) for none.
        time: Time constant τ [s] after which it is forgotten.
        name: Ending of the names of the states, by default the name of the link: `fx_hand` … `tz_hand`.
        frame: Axes of the components, those of the "link" (default) or of the "world".
        point: Where the force acts, in the frame of the link [m]; its origin by default. Torques are about this point.

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
