"""Closes the loops of robots: couplings of links or joints in addition to the tree become constraints on its space.

A gap is measured in the frame of the first of two links, and only through the joints between them. So rows that a
planar loop does not need are zero for every pose of an arm that carries it, and joints before the loop do not matter.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._names import refuse_unknown
from covariant._typing import Vector
from covariant.geometry import AbstractSpace, Leaf
from covariant.geometry.lie import rotation_from_quaternion
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import known
from covariant.models.robots._description import Coincide, Coupled, Description, rows, turn_about
from covariant.models.robots._space import RobotSpace
from scalargraph.errors import InputError

FARTHEST = 0.1
"""Largest distance [rad or m] from the stated positions to closed loops: it allows for rounding, not for guesses."""
KEYS = {"links": 2, "points": 2, "rpy": 3, "joints": 2, "polynomial": None}
"""Keys of the table of a loop, and the number of their entries."""
KINDS = ({"links", "points"}, {"links", "points", "rpy"}, {"joints", "polynomial"})
"""The sets of keys that may occur together."""


class Closure(Functional):
    """The constraint `x -> (m,)` of the loops of a robot: gaps [m or rad], which are zero if the loops are closed."""

    space: RobotSpace
    loops: tuple[Coincide | Coupled, ...] = eqx.field(static=True)

    def __call__(self, x: Array) -> Vector:
        return jnp.concatenate([gap(self.space, loop, x) for loop in self.loops])


def robot_space(space: AbstractSpace | None) -> RobotSpace | None:
    """The space of a robot with links and joints by name; for closed loops the space of its tree; else None."""
    tree = space.space if isinstance(space, Leaf) else space
    return tree if isinstance(tree, RobotSpace) else None


def loops_of(tables: Mapping[str, Mapping[str, Any]]) -> tuple[Coincide | Coupled, ...]:
    """The loops that the tables `[loop.NAME]` of a model file describe."""
    return tuple(_loop(name, table) for name, table in tables.items())


def close_loops(model: MechanicalSystem, robot: Description, geometry: RobotSpace) -> MechanicalSystem:
    """The robot with closed loops: its space is a leaf of the tree's space, whose numbers are known in `geometry`."""
    for loop in robot.loops:
        _check_names(geometry, robot, loop)
    if not known(geometry.tree.offset):
        raise InputError("encoder offsets of a robot with closed loops cannot be fitted; leave offsets out")
    # Inertias may be traced, but the closing of loops does not depend on them.
    with jax.ensure_compile_time_eval():
        near = _assembled(model, geometry, robot)
        try:
            leaf = Leaf.closing(geometry, Closure(geometry, robot.loops), near)
        except InputError as error:
            raise InputError(f"loop {', '.join(repr(loop.name) for loop in robot.loops)}: {error}") from error
        for loop in robot.loops:
            # The rows of a weld are sines, which also vanish at half a turn.
            if isinstance(loop, Coincide) and loop.rotation is not None:
                turned = np.asarray(loop.rotation).T @ np.asarray(geometry.relative(leaf.assembly, *loop.links)[0])
                if np.trace(turned) < 1:
                    raise InputError(
                        f"loop {loop.name!r} closes only with its frames turned against each other; mend rpy"
                    )
        _refuse_far(model, geometry, near, leaf.assembly, robot.assembly is not None)
    return eqx.tree_at(lambda each: each.space, model, Leaf(model.space, leaf.constraint, leaf.assembly))


def _check_names(space: RobotSpace, robot: Description, loop: Coincide | Coupled) -> None:
    if isinstance(loop, Coincide):
        for link in loop.links:
            refuse_unknown(f"link of loop {loop.name!r}", link, robot.links)
            if link not in space.links.names:
                raise InputError(
                    f"loop {loop.name!r} holds link {link!r}, which does not float with the robot; a loop is between "
                    "links of the robot: let its base stand, or remove the loop"
                )
        return
    for joint in loop.joints:
        refuse_unknown(f"joint of loop {loop.name!r}", joint, [each.name for each in robot.joints])
        if [name for name, _, _ in space.limits].count(joint) != 1:
            raise InputError(f"loop {loop.name!r}: joint {joint!r} is locked, or has several axes; remove the loop")


def _assembled(model: MechanicalSystem, space: RobotSpace, robot: Description) -> Array:
    """The configuration near which the loops are closed."""
    assembly = robot.assembly or {}
    for name in assembly:
        refuse_unknown("joint of assembly", name, [joint.name for joint in robot.joints])
    x, balls = np.array(space.manifold.origin()), len(space.tree.balls)
    flat, start = x.reshape(-1), 16 * space.floating
    for ball, first in enumerate(space.tree.balls):
        pose = assembly.get(space.limits[first][0])
        if pose is not None:
            flat[start + 9 * ball : start + 9 * ball + 9] = np.ravel(rotation_from_quaternion(jnp.asarray(pose, float)))
    for i, name in enumerate(model.coordinates):
        flat[start + 9 * balls + i] = float(assembly.get(name, 0.0))
    return jnp.asarray(x)


def _refuse_far(model: MechanicalSystem, space: RobotSpace, near: Array, closed: Array, stated: bool) -> None:
    """Raise `ValueError` if the loops close only far from the stated positions, which suggests another assembly."""
    if float(jnp.max(jnp.abs(space.manifold.local(near, closed)))) <= FARTHEST:
        return
    count = len(model.coordinates)
    positions = np.asarray(closed).reshape(-1)[len(np.ravel(closed)) - count :].round(3) + 0.0
    pairs = ", ".join(f"{name} = {value:g}" for name, value in zip(model.coordinates, positions, strict=True))
    raise InputError(
        f"the loops do not close where {'assembly says' if stated else 'all joints are at 0'}, and may be assembled in "
        f"several ways; the closest is assembly = {{{pairs}}}: give this, or the one that is built, to a few digits"
    )


def _loop(name: str, table: object) -> Coincide | Coupled:
    where = f"[loop.{name}]"
    if not isinstance(table, Mapping):
        raise InputError(f"loop.{name} must be a table, {where}; got {table!r}")
    for key in table:
        refuse_unknown(f"key of {where}", key, KEYS)
    if set(table) not in KINDS:
        raise InputError(
            f"{where} needs links and points, for a point of each link that coincide; also rpy, for frames that "
            f"coincide; or joints and polynomial; got {', '.join(table) or 'nothing'}"
        )
    for key, count in KEYS.items():
        if key in table and (not isinstance(table[key], Sequence) or count not in (None, len(table[key]))):
            raise InputError(f"{where}: {key} must be a list of {count or 'numbers'}; got {table[key]!r}")
    if "joints" in table:
        return Coupled(name, tuple(table["joints"]), tuple(map(float, table["polynomial"])))
    points = np.asarray(table["points"], float)
    if points.shape != (2, 3) or not np.isfinite(points).all():
        raise InputError(f"{where}: points must be two of three numbers [m]; got {table['points']!r}")
    roll, pitch, yaw = map(float, table.get("rpy", (0.0, 0.0, 0.0)))
    x, y, z = np.eye(3)
    turned = turn_about(z, yaw) @ turn_about(y, pitch) @ turn_about(x, roll)
    return Coincide(name, tuple(table["links"]), rows(points), rows(turned) if "rpy" in table else None)


def gap(space: RobotSpace, loop: Coincide | Coupled, x: Array) -> Vector:
    """The gap (m,) of a loop [m or rad]; zero if it is closed."""
    return _apart(space, loop, x) if isinstance(loop, Coincide) else _off_curve(space, loop, x)


def _apart(space: RobotSpace, loop: Coincide, x: Array) -> Vector:
    """Distance (3,) of the points, and the rotation (3,) of the second frame relative to the first."""
    rotation, place = space.relative(x, *loop.links)
    first, second = (jnp.asarray(point, x.dtype) for point in loop.points)
    moved = place + rotation @ second - first
    if loop.rotation is None:
        return moved
    turned = jnp.asarray(loop.rotation, x.dtype).T @ rotation
    sines = [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    return jnp.concatenate([moved, jnp.stack(sines) / 2])


def _off_curve(space: RobotSpace, loop: Coupled, x: Array) -> Float[Array, "1"]:
    names, angles = [name for name, _, _ in space.limits], space.joint_angles(x)
    one, other = (angles[names.index(name)] for name in loop.joints)
    value = jnp.zeros_like(other)
    for coefficient in reversed(loop.polynomial):
        value = value * other + coefficient
    return (one - value)[None]
