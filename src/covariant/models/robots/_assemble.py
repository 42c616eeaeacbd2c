"""A mechanical system from the description of a robot: links that do not move apart become one body."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Scalar
from covariant.geometry import AbstractManifold, Coordinates, ProductManifold
from covariant.geometry.lie import SE3
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import Parametric
from covariant.models.robots._description import NO_INERTIA, BodyInertia, Description, Joint
from covariant.models.robots._space import KinematicTree, RobotSpace

COULOMB_STEEPNESS = 100.0
"""Slope at rest of the smoothed Coulomb friction `friction (2/π) atan(100 v)` [s/rad or s/m]."""
TWIST = ("v1", "v2", "v3", "w1", "w2", "w3")
"""Names of the components of the twist of the base."""
SMALLEST_INERTIA = 1e-12
"""Smallest eigenvalue of the inertia matrix, relative to the largest, with which it counts as positive definite."""


class _Axis(NamedTuple):
    """A joint of one axis, one of the three of a planar joint, or a frame that one moves."""

    name: str
    joint: Joint
    parent: int
    rotation: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    slide: np.ndarray
    circle: bool


@jax.ensure_compile_time_eval()  # its inertia is looked at, also inside a compiled function
def assemble(
    robot: Description,
    *,
    floating: bool = False,
    lock: Mapping[str, float] | None = None,
    actuated: Sequence[str] | None = None,
) -> MechanicalSystem:
    """The mechanical system of a robot; see `load`."""
    locked = dict(lock or {})
    known = {joint.name: joint for joint in robot.joints}
    for name in [*locked, *(actuated or ())]:
        if name not in known:
            raise ValueError(f"there is no joint {name!r}; there are {', '.join(known)}")
    for joint in robot.joints:
        follows = joint.follows
        if follows is not None and follows.joint not in known:
            raise ValueError(f"joint {joint.name!r} follows {follows.joint!r}, and there is no such joint")
    axes, bodies, base = _bodies(robot, _with_followers(robot, locked))
    if not axes:
        raise ValueError("no joint moves; a robot needs one that is not fixed or locked")
    names = [axis.name for axis in axes]
    free = [i for i, axis in enumerate(axes) if axis.joint.follows is None]
    coordinates, offset = _follow(axes, names, free)
    bodies, base = _regrouped(axes, bodies, base)
    tree = KinematicTree(
        tuple(axis.parent for axis in axes),
        *(
            jnp.asarray(np.array(part, float))
            for part in (
                [axis.turn for axis in axes],
                [axis.slide for axis in axes],
                [axis.rotation for axis in axes],
                [axis.place for axis in axes],
                [body.mass for body in bodies],
                [body.first for body in bodies],
                [body.second for body in bodies],
                base.mass if floating else 0.0,
                base.first if floating else np.zeros(3),
                base.second if floating else np.zeros((3, 3)),
                coordinates,
                offset,
                coordinates.T**2 @ np.array([axis.joint.armature for axis in axes]),
            )
        ),
    )
    circles, n = tuple(k for k, i in enumerate(free) if axes[i].circle), len(free)
    of_joints = Coordinates(circles, n)
    manifold: AbstractManifold = ProductManifold((SE3, of_joints)) if floating else of_joints
    space = RobotSpace(tree, manifold=manifold, floating=floating)
    driven = [k for k, i in enumerate(free) if actuated is None or axes[i].joint.name in actuated]
    joints = [axis.joint for axis in axes]
    units = tuple("rad" if axes[i].turn.any() else "m" for i in free)
    made = MechanicalSystem(
        space,
        potential=Potential(
            space,
            jnp.asarray(robot.gravity),
            jnp.array([joint.stiffness for joint in joints]),
            jnp.array([joint.rest for joint in joints]),
        ),
        force=Parametric(_force, motors=np.eye(n)[:, driven], base=np.zeros(6 * floating)),
        dissipation=Parametric(
            _friction,
            coordinates=coordinates,
            damping=np.array([joint.damping for joint in joints]),
            friction=np.array([joint.friction for joint in joints]),
            base=np.zeros(6 * floating),
        ),
        coordinates=tuple(names[i] for i in free),
        units=units,
        velocities=(*TWIST, *(f"rate_{names[i]}" for i in free)) if floating else (),
        velocity_units=(*("m/s",) * 3, *("rad/s",) * 3, *(f"{unit}/s" for unit in units)) if floating else (),
        inputs=len(driven),
    )
    _check_inertia(made, names, free)
    return made


def _with_followers(robot: Description, locked: dict[str, float]) -> dict[str, float]:
    """The locked joints, and those that follow one of them."""
    still = locked | {joint.name: 0.0 for joint in robot.joints if joint.kind == "fixed"}
    while True:
        more = {
            joint.name: joint.follows.ratio * still[joint.follows.joint] + joint.follows.offset
            for joint in robot.joints
            if joint.follows is not None and joint.name not in still and joint.follows.joint in still
        }
        if not more:
            return still
        still |= more


def _bodies(robot: Description, locked: dict[str, float]) -> tuple[list[_Axis], list[BodyInertia], BodyInertia]:
    """The axes, the body that each moves, and the base, with fixed and locked links made part of what carries them."""
    axes: list[_Axis] = []
    bodies: list[BodyInertia] = []
    base = robot.links[robot.root]
    at = {robot.root: (-1, np.eye(3), np.zeros(3))}  # body of each link, and where the link's frame is in it

    def add(body: int, inertia: BodyInertia) -> None:
        nonlocal base
        if body < 0:
            base = base.joined(inertia)
        else:
            bodies[body] = bodies[body].joined(inertia)

    for joint in robot.joints:
        body, turned, shifted = at[joint.parent]
        rotation, place = turned @ joint.rotation, shifted + turned @ joint.place
        if joint.name in locked:
            inner, along = _locked(joint, locked[joint.name])
            rotation, place = rotation @ inner, place + rotation @ along
            at[joint.child] = body, rotation, place
            add(body, robot.links[joint.child].moved(rotation, place))
            continue
        if joint.kind == "floating":
            raise ValueError(
                f"joint {joint.name!r}: a floating joint is supported as floating=True, for the whole robot"
            )
        # Where the frame of the link is that of its carrier but for quarter turns, that of the body makes none: they
        # would cost an observer a change of sign at every joint in every sweep.
        turned = rotation if np.isin(rotation, (-1.0, 0.0, 1.0)).all() else np.eye(3)
        for name, turn, slide, circle in _motions(joint):
            axes.append(_Axis(name, joint, body, rotation @ turned.T, place, turned @ turn, turned @ slide, circle))
            bodies.append(NO_INERTIA)
            body, rotation, place = len(bodies) - 1, turned, np.zeros(3)
        bodies[body] = robot.links[joint.child].moved(turned, place)
        at[joint.child] = body, turned, place
    return axes, bodies, base


def _regrouped(
    axes: list[_Axis], bodies: list[BodyInertia], base: BodyInertia
) -> tuple[list[BodyInertia], BodyInertia]:
    """The same mechanics with fewer numbers: what a joint does not move differently is made part of what carries it.

    A mass on the axis of a turning joint moves with the carrier, and a sliding joint turns its body as the carrier. So
    bodies keep no mass, no first and no second moment along an axis that they turn about, and no second moment where
    they slide. Source: Khalil & Dombre 2002, Modeling, Identification and Control of Robots, section 9.4.
    """
    kept, carried = list(bodies), [*bodies, base]
    for i in reversed(range(len(axes))):
        turn, body = axes[i].turn, carried[i]
        if turn.any():
            along = np.outer(turn, turn)
            moved = BodyInertia(body.mass, along @ body.first, along @ body.second @ along)
        else:
            moved = BodyInertia(0.0, np.zeros(3), body.second)
        kept[i] = BodyInertia(body.mass - moved.mass, body.first - moved.first, body.second - moved.second)
        carried[axes[i].parent] = carried[axes[i].parent].joined(moved.moved(axes[i].rotation, axes[i].place))
    return kept, carried[-1]


def _motions(joint: Joint) -> list[tuple[str, np.ndarray, np.ndarray, bool]]:
    """Name, turning axis, sliding axis of each motion of a joint, and whether it goes round a full circle."""
    none = np.zeros(3)
    if joint.kind == "prismatic":
        return [(joint.name, none, joint.axis, False)]
    if joint.kind in ("revolute", "continuous"):
        return [(joint.name, joint.axis, none, joint.kind == "continuous")]
    first = np.eye(3)[np.argmin(np.abs(joint.axis))]
    first = first - joint.axis * (first @ joint.axis)
    first = first / np.linalg.norm(first)
    second = np.cross(joint.axis, first)
    return [
        (f"{joint.name}_x", none, first, False),
        (f"{joint.name}_y", none, second, False),
        (f"{joint.name}_turn", joint.axis, none, True),
    ]


def _locked(joint: Joint, value: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of a joint that stands at a value."""
    if not np.isfinite(value):
        raise ValueError(f"joint {joint.name!r}: it must be locked at a finite number; got {value}")
    if joint.kind == "prismatic":
        return np.eye(3), joint.axis * value
    if joint.kind in ("fixed", "planar", "floating"):
        return np.eye(3), np.zeros(3)
    along = np.outer(joint.axis, joint.axis)
    hat = np.cross(joint.axis, np.eye(3)).T
    return along + np.cos(value) * (np.eye(3) - along) + np.sin(value) * hat, np.zeros(3)


def _follow(axes: list[_Axis], names: list[str], free: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The joints as linear functions of the free ones: matrix (k, n) and offset (k,)."""
    matrix, offset = np.zeros((len(axes), len(free))), np.zeros(len(axes))
    for column, i in enumerate(free):
        matrix[i, column] = 1.0
    waiting = [i for i in range(len(axes)) if i not in free]
    done = set(free)
    while waiting:
        ready = [i for i in waiting if _leader(axes[i], names) in done]
        if not ready:
            raise ValueError(f"joint {axes[waiting[0]].name!r} follows itself")
        for i in ready:
            follows, leader = axes[i].joint.follows, _leader(axes[i], names)
            assert follows is not None
            matrix[i], offset[i] = follows.ratio * matrix[leader], follows.ratio * offset[leader] + follows.offset
        done |= set(ready)
        waiting = [i for i in waiting if i not in ready]
    return matrix, offset


def _leader(axis: _Axis, names: list[str]) -> int:
    assert axis.joint.follows is not None
    if axis.joint.follows.joint not in names:
        raise ValueError(f"joint {axis.name!r} follows {axis.joint.follows.joint!r}, which has more than one axis")
    return names.index(axis.joint.follows.joint)


def _check_inertia(model: MechanicalSystem, names: list[str], free: list[int]) -> None:
    """Raise `ValueError` where a velocity has no kinetic energy."""
    x = model.manifold.origin()
    values, vectors = np.linalg.eigh(np.asarray(model.space(x)))
    if values[0] <= SMALLEST_INERTIA * values[-1]:
        part = np.abs(vectors[:, 0])[-len(free) :]
        worst = names[free[int(np.argmax(part))]]
        raise ValueError(
            f"joint {worst!r} moves no mass: the inertia matrix has the eigenvalue {values[0]:.2g} beside "
            f"{values[-1]:.2g}; give the links beyond it an <inertial>, or lock it"
        )


class Potential(Functional):
    """Potential energy `q -> ()` [J] of the weight and of the springs of the joints.

    - `gravity` (3,) [m/s²]; `stiffness` (k,) [N m/rad or N/m] and `rest` (k,) [rad or m] of the springs.
    """

    space: RobotSpace
    gravity: Float[Array, "3"]
    stiffness: Float[Array, "k"]
    rest: Float[Array, "k"]

    def __call__(self, q: Array) -> Scalar:
        gravity, stiffness, rest = (part.astype(q.dtype) for part in (self.gravity, self.stiffness, self.rest))
        stretched = self.space.joint_angles(q) - rest
        return jnp.sum(stiffness * stretched**2) / 2 - gravity @ self.space.first_moment(q, self.space.joints(q))


def _force(t, q, u, motors: Float[Array, "n m"], base: Float[Array, "b"]):
    return jnp.concatenate([base, motors @ u])


def _friction(
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
