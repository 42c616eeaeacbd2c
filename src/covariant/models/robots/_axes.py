"""Splits a robot's joints into single axes, with the bodies that they move, and finds the independent axes."""

from typing import Any, NamedTuple

import numpy as np

from covariant.models.robots._description import NO_INERTIA, BodyInertia, Description, Joint, turn_about
from scalargraph.errors import InputError


class Axis(NamedTuple):
    """A joint of one axis, one of the three axes of a planar or ball joint, or a frame moved by one.

    Attributes:
        name: Name of its coordinate.
        joint: The joint.
        parent: Number of the body that carries it, −1 for the base.
        rotation: Rotation (3, 3) of its frame in that of the parent.
        place: Origin (3,) of its frame in that of the parent [m].
        turn: Axis (3,) about which it turns; zero if it slides.
        slide: Axis (3,) along which it slides; zero if it turns.
        circle: Whether it is an angle on a full circle.
    """

    name: str
    joint: Joint
    parent: int
    rotation: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    slide: np.ndarray
    circle: bool

    @property
    def ball(self) -> bool:
        """Whether it is one of the three of a ball joint."""
        return self.joint.kind == "ball"


class Freedom(NamedTuple):
    """The axes that move independently, those of ball joints and the free ones, and all axes as functions of them.

    Attributes:
        balls: Numbers of the axes of ball joints, three for each.
        free: Numbers of the axes that are coordinates.
        matrix: The axes as linear functions (k, n) of the independent ones.
        offset: Positions (k,) of all axes if the independent ones are zero [rad or m].
    """

    balls: list[int]
    free: list[int]
    matrix: np.ndarray
    offset: np.ndarray

    @property
    def moving(self) -> list[int]:
        """All independent axes, in the order of the velocities."""
        return self.balls + self.free


def freedom_of(axes: list[Axis]) -> Freedom:
    """Find the axes that move independently, and how the others follow them."""
    balls = [i for i, axis in enumerate(axes) if axis.ball]
    free = [i for i, axis in enumerate(axes) if axis.joint.follows is None and not axis.ball]
    return Freedom(balls, free, *_follow(axes, [axis.name for axis in axes], balls + free))


def bodies_of(
    robot: Description, locked: dict[str, float]
) -> tuple[list[Axis], list[BodyInertia], BodyInertia, dict[str, Any]]:
    """The axes, the body behind each, the base, and the frame of each link within its body.

    Fixed and locked links become part of the body that carries them.
    """
    axes: list[Axis] = []
    bodies: list[BodyInertia] = []
    base = robot.links[robot.root]
    frames = {robot.root: (-1, np.eye(3), np.zeros(3))}  # body of each link, and the link's frame in it

    def add(body: int, inertia: BodyInertia) -> None:
        nonlocal base
        if body < 0:
            base = base.joined(inertia)
        else:
            bodies[body] = bodies[body].joined(inertia)

    for joint in robot.joints:
        body, turned, shifted = frames[joint.parent]
        rotation, place = turned @ joint.rotation, shifted + turned @ joint.place
        if joint.name in locked:
            inner, shift = locked_pose(joint, locked[joint.name])
            rotation, place = rotation @ inner, place + rotation @ shift
            frames[joint.child] = body, rotation, place
            add(body, robot.links[joint.child].moved(rotation, place))
            continue
        # If a link is mounted by quarter turns only, its body gets no rotation at all; in every sweep of an observer, a
        # quarter turn would cost a permutation with changes of sign.
        quarters = np.isin(rotation, (-1.0, 0.0, 1.0)).all() and joint.kind != "ball"
        turned = rotation if quarters else np.eye(3)
        for name, turn, slide, circle in _motions(joint):
            axes.append(Axis(name, joint, body, rotation @ turned.T, place, turned @ turn, turned @ slide, circle))
            bodies.append(NO_INERTIA)
            body, rotation, place = len(bodies) - 1, turned, np.zeros(3)
        bodies[body] = robot.links[joint.child].moved(turned, place)
        frames[joint.child] = body, turned, place
    return axes, bodies, base, frames


def regrouped(axes: list[Axis], bodies: list[BodyInertia], base: BodyInertia) -> tuple[list[BodyInertia], BodyInertia]:
    """Regroup the inertial parameters: the part that a joint does not move relative to its carrier joins the carrier.

    A mass on the axis of a turning joint moves with the carrier, and a sliding joint does not turn its body relative to
    the carrier. So bodies keep no mass, no first and no second moment along an axis about which they turn, no second
    moment if they slide, and behind a ball joint no mass, since its centre moves with the carrier. Source: Khalil &
    Dombre 2002, Modeling, Identification and Control of Robots, section 9.4.
    """
    remaining, carried = list(bodies), [*bodies, base]  # the base is last, so that its parent number −1 indexes it
    for i in reversed(range(len(axes))):  # from the leaves on: a body passes on what it received
        turn, body = axes[i].turn, carried[i]
        if axes[i].ball:
            moved = BodyInertia(body.mass, np.zeros(3), np.zeros((3, 3)))
        elif turn.any():
            projection = np.outer(turn, turn)
            moved = BodyInertia(body.mass, projection @ body.first, projection @ body.second @ projection)
        else:
            moved = BodyInertia(0.0, np.zeros(3), body.second)
        remaining[i] = BodyInertia(body.mass - moved.mass, body.first - moved.first, body.second - moved.second)
        carried[axes[i].parent] = carried[axes[i].parent].joined(moved.moved(axes[i].rotation, axes[i].place))
    return remaining, carried[-1]


def _motions(joint: Joint) -> list[tuple[str, np.ndarray, np.ndarray, bool]]:
    """Name, turning axis and sliding axis of each motion of a joint, and whether it is an angle on a full circle."""
    none = np.zeros(3)
    if joint.kind == "prismatic":
        return [(joint.name, none, joint.axis, False)]
    if joint.kind in ("revolute", "continuous"):
        return [(joint.name, joint.axis, none, joint.kind == "continuous")]
    if joint.kind == "ball":
        return [(f"{joint.name}_{x}", axis, none, False) for x, axis in zip("xyz", np.eye(3), strict=True)]
    # The coordinate axis that is least parallel to the normal: its part in the plane is at least √(2/3) long.
    first = np.eye(3)[np.argmin(np.abs(joint.axis))]
    first = first - joint.axis * (first @ joint.axis)
    first = first / np.linalg.norm(first)
    second = np.cross(joint.axis, first)
    return [
        (f"{joint.name}_x", none, first, False),
        (f"{joint.name}_y", none, second, False),
        (f"{joint.name}_turn", joint.axis, none, True),
    ]


def locked_pose(joint: Joint, value: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of a locked joint."""
    if not np.isfinite(value):
        raise InputError(f"joint {joint.name!r}: it must be locked at a finite number; got {value}")
    if joint.kind == "prismatic":
        return np.eye(3), joint.axis * value
    if joint.kind in ("fixed", "planar", "floating", "ball"):
        if value:
            raise InputError(f"joint {joint.name!r}: a {joint.kind} joint is locked at 0; got {value}")
        return np.eye(3), np.zeros(3)
    return turn_about(joint.axis, value), np.zeros(3)


def _follow(axes: list[Axis], names: list[str], free: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The joints as linear functions of the free ones: matrix (k, n) and offset (k,)."""
    matrix, offset = np.zeros((len(axes), len(free))), np.zeros(len(axes))
    for column, i in enumerate(free):
        matrix[i, column] = 1.0
    pending = [i for i in range(len(axes)) if i not in free]
    done = set(free)
    while pending:
        ready = [i for i in pending if _leader(axes[i], names) in done]
        if not ready:
            raise InputError(f"joint {axes[pending[0]].name!r} follows itself")
        for i in ready:
            follows, leader = axes[i].joint.follows, _leader(axes[i], names)
            assert follows is not None
            matrix[i], offset[i] = follows.ratio * matrix[leader], follows.ratio * offset[leader] + follows.offset
        done |= set(ready)
        pending = [i for i in pending if i not in ready]
    return matrix, offset


def _leader(axis: Axis, names: list[str]) -> int:
    assert axis.joint.follows is not None
    if axis.joint.follows.joint not in names:
        raise InputError(f"joint {axis.name!r} follows {axis.joint.follows.joint!r}, which has more than one axis")
    return names.index(axis.joint.follows.joint)
