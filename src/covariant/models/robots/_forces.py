"""The forces in a robot: weight and springs, motors, friction of its joints."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Scalar
from covariant.geometry.lie import SO3
from covariant.models.robots._space import RobotSpace

COULOMB_STEEPNESS = 100.0
"""Slope at rest of the smoothed Coulomb friction `friction (2/π) atan(100 v)` [s/rad or s/m]."""


class Potential(Functional):
    """Potential energy `q -> ()` [J] of the weight and of the springs of the joints.

    - `gravity` (3,) [m/s²]; `stiffness` (k,) [N m/rad or N/m] and `rest` (k,) [rad or m] of the springs.
    - `sprung`: which ball joints have a spring; it turns them back the short way, and rests at the identity.
    """

    space: RobotSpace
    gravity: Float[Array, "3"]
    stiffness: Float[Array, "k"]
    rest: Float[Array, "k"]
    sprung: tuple[int, ...] = eqx.field(default=(), static=True)

    def __call__(self, q: Array) -> Scalar:
        gravity, stiffness, rest = (part.astype(q.dtype) for part in (self.gravity, self.stiffness, self.rest))
        stretched = self.space.joint_angles(q) - rest
        for ball in self.sprung:
            first = self.space.tree.balls[ball]
            stretched = stretched.at[first : first + 3].set(SO3.log(self.space.ball_rotations(q)[ball]))
        return jnp.sum(stiffness * stretched**2) / 2 - gravity @ self.space.first_moment(q, self.space.joints(q))


def force(t, q, u, motors: Float[Array, "n m"], base: Float[Array, "b"]):
    return jnp.concatenate([base, motors @ u])


def resistance(
    q,
    v,
    coordinates: Float[Array, "k n"],
    damping: Float[Array, "k"],
    friction: Float[Array, "k"],
    base: Float[Array, "b"],
):
    rates = coordinates @ v[base.shape[0] :]
    torque = damping * rates + friction * (2 / jnp.pi) * jnp.arctan(COULOMB_STEEPNESS * rates)
    return jnp.concatenate([base, -coordinates.T @ torque])
