"""Describes the feet of a robot relative to its base: their positions and attitudes, and the forces on them.

All vectors are in the axes of the base, so neither the robot's position in the world nor its heading is needed.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Number, Scalar, Vector
from covariant.geometry.lie import SO3
from covariant.models.robots._space import RobotSpace
from scalargraph.errors import InputError


class Legs(Functional):
    """Motion of a base with an IMU relative to its standing feet, in the axes of the base: `x' = f(t, x, u)`.

    The state x is the velocity of the base, gravity, the position of each standing foot, and the biases of gyro and
    accelerometer; the input u is the reading of gyro and accelerometer. The model is linear in the state, except for
    products with the gyro bias, and does not use the dynamics of the robot.

    Attributes:
        space: Configuration space of the robot, whose base is free.
        radius: Radius () of spherical feet [m], which roll; 0 for points.
        places: Position (F, 3) of the centre of each foot in the frame of its link [m].
        links: Link of each of the F feet.
        carrying: Joints that carry each foot.
    """

    space: RobotSpace
    radius: Scalar
    places: Float[Array, "F 3"]
    links: tuple[str, ...] = eqx.field(static=True)
    carrying: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, t: Scalar, x: Vector, u: Float[Array, "6"]) -> Vector:
        start = jnp.zeros((), x.dtype)
        return jax.jvp(lambda dt: self.step(x, u, dt), (start,), (jnp.ones_like(start),))[1]

    def step(self, x: Vector, u: Float[Array, "6"], dt: Scalar) -> Vector:
        """The state dt later for constant IMU readings, accurate to third order in the rotation of the base."""
        velocity, gravity, feet = x[:3], x[3:6], x[6:-6].reshape(-1, 3)
        spin, force = u[:3] - x[-6:-3], u[3:] - x[-3:]
        turn = spin * dt
        # Means over dt, plain and weighted by the earlier times, of a force that turns with the base, in the axes at
        # the start.
        once = jnp.cross(turn, force)
        mean, weighted = force + once / 2 + jnp.cross(turn, once) / 6, force + once / 3
        # The centre of a rolling ball moves by its spin about the contact point, one radius below the centre.
        change = jnp.cross(turn, self.up(gravity)) - dt * velocity - dt**2 / 2 * (gravity + weighted)
        back = SO3.exp(-turn)
        vectors = jnp.concatenate([(velocity + dt * (gravity + mean))[None], gravity[None], feet + change[None]])
        return jnp.concatenate([(vectors @ back.T).ravel(), x[-6:]])

    def up(self, gravity: Float[Array, "3"]) -> Float[Array, "3"]:
        """Vector from the ground to the centre of a standing foot, in the axes of the base [m]."""
        return -self.radius.astype(gravity.dtype) / jnp.sqrt(gravity @ gravity) * gravity

    def feet(self, q: Float[Array, "n"]) -> tuple[Float[Array, "F 3"], Float[Array, "F 3 3"], Float[Array, "F 3 n"]]:
        """Feet at positions q of the joints, in the axes of the base.

        Returns:
            Centres of the feet, rotations of their links, and derivatives of the centres by q.
        """
        tree, joints = self.space.tree, self.space.joints(jnp.concatenate([jnp.eye(4, dtype=q.dtype).ravel(), q]))
        turn, slide, rates = (part.astype(q.dtype) for part in (tree.turn, tree.slide, tree.coordinates))
        every = []
        for link, place in zip(self.links, self.places.astype(q.dtype), strict=True):
            body, rotation, origin = self.space.links.of(link)
            path: list[int] = []
            while body >= 0:
                path, body = [body, *path], tree.parents[body]
            attitude, at, axes = jnp.eye(3, dtype=q.dtype), jnp.zeros(3, q.dtype), []
            for body in path:
                at, attitude = at + attitude @ joints.place[body], attitude @ joints.rotation[body]
                axes.append((attitude @ turn[body], attitude @ slide[body], at, rates[body]))
            rotation, origin = rotation.astype(q.dtype), origin.astype(q.dtype)
            foot = at + attitude @ (origin + rotation @ place)
            slope = sum(jnp.outer(jnp.cross(axis, foot - hinge) + along, rate) for axis, along, hinge, rate in axes)
            every.append((foot, attitude @ rotation, slope))
        centres, rotations, slopes = (jnp.stack(part) for part in zip(*every, strict=True))
        return centres, rotations, slopes

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.space.tree.coordinates.shape[1]


def legs(space: Any, feet: Mapping[str, Sequence[Number]], radius: Number) -> Legs:
    """The legs of a robot with a free base and feet at `{link: (x, y, z)}`; raises `ValueError` for other robots."""
    if not (space.floating and len(space.tree.balls) == 0):
        raise InputError("legged_base: the base must be free, and no joint a ball joint")
    if not feet or any(len(place) != 3 for place in feet.values()):
        raise InputError("legged_base: feet needs the place of each foot in its link, {LINK: [x, y, z]} in m")
    tree, links = space.tree, tuple(feet)
    carried, rates = tree.carried(), np.asarray(tree.coordinates) != 0
    bodies = [space.links.of(link)[0] for link in links]
    joints = [(carried[:, body] @ rates).nonzero()[0].tolist() if body >= 0 else [] for body in bodies]
    for link, carrying in zip(links, joints, strict=True):
        if len(carrying) < 3:
            raise InputError(f"legged_base: {link} is carried by {len(carrying)} joints; a foot needs three or more")
    places = jnp.asarray(list(map(list, feet.values())), float)
    return Legs(space, jnp.asarray(radius, float), places, links, tuple(map(tuple, joints)))
