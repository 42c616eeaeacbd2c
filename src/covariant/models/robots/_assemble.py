"""Mechanical systems from descriptions of robots: links that do not move apart become one body."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant.geometry import AbstractManifold, AbstractSpace, Coordinates, ProductManifold
from covariant.geometry.lie import SE3, SO3
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import Parametric, known, namespace
from covariant.models.robots._description import (
    NO_INERTIA,
    BodyInertia,
    Description,
    Joint,
    turn_about,
)
from covariant.models.robots._forces import Potential, force
from covariant.models.robots._joint_forces import dissipation, inputs, numbers, with_motors
from covariant.models.robots._space import RobotSpace
from covariant.models.robots._tree import KinematicTree, Links

TWIST = ("v1", "v2", "v3", "w1", "w2", "w3")
"""Names of the components of the twist of the base."""
TWIST_UNITS = ("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s")
SMALLEST_INERTIA = 1e-12
"""Smallest eigenvalue of the inertia matrix, relative to the largest, with which it counts as positive definite."""


class _Axis(NamedTuple):
    """A joint of one axis, one of the three of a planar or ball joint, or a frame that one moves."""

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
        return self.joint.kind == "ball"


def assemble(
    robot: Description,
    *,
    floating: bool = False,
    lock: Mapping[str, float] | None = None,
    actuated: Sequence[str] | None = None,
    payload: Mapping[str, Any] | None = None,
) -> MechanicalSystem:
    """Build the mechanical system of a described robot; see `load`.

    Args:
        robot: Description of the robot.
        floating: Whether the root link moves freely.
        lock: Joints that stand still, with their position [rad or m].
        actuated: Names of the joints with an input, in the order of the joints; all, or the file's motors, by default.
        payload: Point masses, `{link: (mass, x, y, z)}` [kg, m in the frame of the link].

    Returns:
        The system, with its configuration space as a `RobotSpace`.

    Raises:
        ValueError: A name does not exist, no joint moves, or a joint moves no mass.

    Example:
        >>> from covariant.models import robots
        >>> robots.assemble(robots.read("double_pendulum"), lock={"elbow": 0.0}).coordinates
        ('shoulder',)
    """
    loads = _checked_payload(payload or {})
    # `_check_inertia` needs the numbers of the inertia, also inside a compiled function.
    traced = not known(jnp.zeros(()))
    with jax.ensure_compile_time_eval() if traced and known((loads, robot)) else contextlib.nullcontext():
        return _assemble(robot, floating, dict(lock or {}), actuated, loads)


def _assemble(
    robot: Description, floating: bool, locked: dict[str, float], actuated: Sequence[str] | None, loads: dict[str, Any]
) -> MechanicalSystem:
    named = {joint.name: joint for joint in robot.joints}
    for name in [*locked, *(actuated or ())]:
        if name not in named:
            raise ValueError(f"there is no joint {name!r}; there are {', '.join(named)}")
    for joint in robot.joints:
        follows = joint.follows
        if follows is not None and follows.joint not in (*named, ""):
            raise ValueError(f"joint {joint.name!r} follows {follows.joint!r}, and there is no such joint")
    locked = _with_followers(robot, locked)
    robot, free_base = _on_its_base(robot, locked)
    floating = floating or free_base
    axes, bodies, base, frames = _bodies(robot, locked)
    for link, (mass, place) in loads.items():
        if link not in frames:
            raise ValueError(f"payload: there is no link {link!r}; there are {', '.join(frames)}")
        body, rotation, origin = frames[link]
        if body < 0:
            base = base.with_mass(mass, rotation @ place + origin)
        else:
            bodies[body] = bodies[body].with_mass(mass, rotation @ place + origin)
    if not axes and not floating:
        raise ValueError("no joint moves; a robot needs one that is not fixed or locked")
    names = [axis.name for axis in axes]
    in_balls = [i for i, axis in enumerate(axes) if axis.ball]
    free = [i for i, axis in enumerate(axes) if axis.joint.follows is None and not axis.ball]
    coordinates, offset = _follow(axes, names, in_balls + free)
    motors = robot.motors if actuated is None else ()
    springs = [with_motors(axis.joint, motors) for axis in axes]
    bodies, base = _regrouped(axes, bodies, base)
    xnp = namespace(loads, robot)

    def stacked(parts: list, shape: tuple[int, ...]) -> Array:
        return jnp.asarray(xnp.stack([xnp.asarray(part, float) for part in parts])) if parts else jnp.zeros((0, *shape))

    tree = KinematicTree(
        tuple(axis.parent for axis in axes),
        stacked([axis.turn for axis in axes], (3,)),
        stacked([axis.slide for axis in axes], (3,)),
        stacked([axis.rotation for axis in axes], (3, 3)),
        stacked([axis.place for axis in axes], (3,)),
        stacked([body.mass for body in bodies], ()),
        stacked([body.first for body in bodies], (3,)),
        stacked([body.second for body in bodies], (3, 3)),
        jnp.asarray(base.mass, float),
        jnp.asarray(base.first, float),
        jnp.asarray(base.second, float),
        jnp.asarray(coordinates),
        jnp.asarray(offset + coordinates @ numbers(axes[i].joint.encoder_offset for i in in_balls + free)),
        # Each joint depends on one coordinate, so that the inertia of the rotors is diagonal: ratio² times each.
        jnp.asarray(coordinates.T**2 @ numbers(axis.joint.armature for axis in axes)),
        tuple(in_balls[::3]),
    )
    of_joints = Coordinates(tuple(k for k, i in enumerate(free) if axes[i].circle), len(free))
    manifold = _product(floating, len(tree.balls), of_joints)
    placements = list(frames.values())
    links = Links(
        tuple(frames),
        tuple(body for body, _, _ in placements),
        jnp.asarray(np.array([rotation for _, rotation, _ in placements])),
        jnp.asarray(np.array([place for _, _, place in placements])),
    )
    space = RobotSpace(tree, links, manifold=manifold, floating=floating)
    motor_forces = inputs(robot, axes, coordinates, in_balls + free, motors, actuated)
    units = tuple("rad" if axes[i].turn.any() else "m" for i in free)
    spins = tuple(f"w{k + 1}_{axes[i].joint.name}" for i in tree.balls for k in range(3))
    velocities = (*TWIST * floating, *spins, *(f"rate_{names[i]}" for i in free))
    velocity_units = (*TWIST_UNITS * floating, *("rad/s" for _ in spins), *(f"{unit}/s" for unit in units))
    model = MechanicalSystem(
        space,
        potential=Potential(
            space,
            jnp.asarray(robot.gravity),
            jnp.array([spring.stiffness for spring in springs], float),
            jnp.array([spring.rest for spring in springs], float),
            tuple(ball for ball, i in enumerate(tree.balls) if springs[i].stiffness),
        ),
        force=Parametric(force, motors=motor_forces, base=np.zeros(6 * floating)),
        dissipation=dissipation(springs, coordinates, np.zeros(6 * floating)),
        coordinates=tuple(names[i] for i in free),
        units=units,
        velocities=velocities if floating or in_balls else (),
        velocity_units=velocity_units if floating or in_balls else (),
        inputs=motor_forces.shape[1],
    )
    if known((loads, robot)):
        _check_inertia(model, [axes[i].joint.name for i in in_balls + free])
    return model


def _product(floating: bool, balls: int, joints: Coordinates) -> AbstractManifold:
    """The manifold of a base, ball joints and coordinates; one of them alone is no product."""
    factors = [SE3] * floating + [SO3] * balls + [joints] * bool(joints.dimension)
    return ProductManifold(tuple(factors)) if len(factors) > 1 else factors[0]


def _checked_payload(payload: Mapping[str, Any]) -> dict[str, Any]:
    """Mass and place (3,) of the load on each link."""
    loads = {}
    for link, load in payload.items():
        if len(load) != 4:
            raise ValueError(f"payload of {link!r}: give mass, x, y, z; got {len(load)} numbers")
        numbers = namespace(list(load)).asarray(load)
        if known(numbers) and not (np.isfinite(numbers).all() and numbers[0] >= 0):
            raise ValueError(f"payload of {link!r}: the mass must not be negative, and all be finite; got {list(load)}")
        loads[link] = numbers[0], numbers[1:]
    return loads


def _on_its_base(robot: Description, locked: dict[str, float]) -> tuple[Description, bool]:
    """The part of a robot that a floating joint carries, and whether there is such a joint."""
    loose = [joint for joint in robot.joints if joint.kind == "floating" and joint.name not in locked]
    if not loose:
        return robot, False
    base = loose[0].child
    carried = {base}
    for joint in robot.joints:  # each after the one that carries it
        carried |= {joint.child} if joint.parent in carried else set()
    beside = [j for j in robot.joints if j.child not in carried and j.name not in locked]
    if len(loose) > 1 or beside:
        other = (loose[1:] + beside)[0]
        raise ValueError(
            f"joint {other.name!r}: one floating joint is supported, and it must carry all that moves; "
            f"{loose[0].name!r} is another; load one robot at a time, or lock the others"
        )
    joints = tuple(joint for joint in robot.joints if joint.parent in carried)
    return robot._replace(root=base, joints=joints), True


def _with_followers(robot: Description, locked: dict[str, float]) -> dict[str, float]:
    """The locked joints, and those that follow one of them."""
    still = locked | {joint.name: 0.0 for joint in robot.joints if joint.kind == "fixed"}
    still |= {j.name: j.follows.offset for j in robot.joints if j.follows is not None and not j.follows.joint}
    while True:
        more = {
            joint.name: joint.follows.ratio * still[joint.follows.joint] + joint.follows.offset
            for joint in robot.joints
            if joint.follows is not None and joint.name not in still and joint.follows.joint in still
        }
        if not more:
            return still
        still |= more


def _bodies(
    robot: Description, locked: dict[str, float]
) -> tuple[list[_Axis], list[BodyInertia], BodyInertia, dict[str, Any]]:
    """The axes, the body behind each, the base, and the frame of each link in its body.

    Fixed and locked links become part of the body that carries them.
    """
    axes: list[_Axis] = []
    bodies: list[BodyInertia] = []
    base = robot.links[robot.root]
    frames = {robot.root: (-1, np.eye(3), np.zeros(3))}  # body of each link, and where the link's frame is in it

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
            inner, shift = _locked(joint, locked[joint.name])
            rotation, place = rotation @ inner, place + rotation @ shift
            frames[joint.child] = body, rotation, place
            add(body, robot.links[joint.child].moved(rotation, place))
            continue
        # Where the frame of the link is that of its carrier but for quarter turns, that of the body makes none: they
        # would cost an observer a change of sign at every joint in every sweep.
        quarters = np.isin(rotation, (-1.0, 0.0, 1.0)).all() and joint.kind != "ball"
        turned = rotation if quarters else np.eye(3)
        for name, turn, slide, circle in _motions(joint):
            axes.append(_Axis(name, joint, body, rotation @ turned.T, place, turned @ turn, turned @ slide, circle))
            bodies.append(NO_INERTIA)
            body, rotation, place = len(bodies) - 1, turned, np.zeros(3)
        bodies[body] = robot.links[joint.child].moved(turned, place)
        frames[joint.child] = body, turned, place
    return axes, bodies, base, frames


def _regrouped(
    axes: list[_Axis], bodies: list[BodyInertia], base: BodyInertia
) -> tuple[list[BodyInertia], BodyInertia]:
    """Regroup the inertial parameters: what a joint does not move differently becomes part of what carries the joint.

    A mass on the axis of a turning joint moves with the carrier, and a sliding joint turns its body as the carrier. So
    bodies have no mass, no first and no second moment along an axis that they turn about, no second moment where they
    slide, and behind a ball joint no mass, since its centre moves with the carrier. Source: Khalil & Dombre 2002,
    Modeling, Identification and Control of Robots, section 9.4.
    """
    regrouped, carried = list(bodies), [*bodies, base]  # the base is last: index −1 is its number as a parent
    for i in reversed(range(len(axes))):  # leaves first: a body passes on what it received
        turn, body = axes[i].turn, carried[i]
        if axes[i].ball:
            moved = BodyInertia(body.mass, np.zeros(3), np.zeros((3, 3)))
        elif turn.any():
            projection = np.outer(turn, turn)
            moved = BodyInertia(body.mass, projection @ body.first, projection @ body.second @ projection)
        else:
            moved = BodyInertia(0.0, np.zeros(3), body.second)
        regrouped[i] = BodyInertia(body.mass - moved.mass, body.first - moved.first, body.second - moved.second)
        carried[axes[i].parent] = carried[axes[i].parent].joined(moved.moved(axes[i].rotation, axes[i].place))
    return regrouped, carried[-1]


def _motions(joint: Joint) -> list[tuple[str, np.ndarray, np.ndarray, bool]]:
    """Name, turning axis, sliding axis of each motion of a joint, and whether it is an angle on a full circle."""
    none = np.zeros(3)
    if joint.kind == "prismatic":
        return [(joint.name, none, joint.axis, False)]
    if joint.kind in ("revolute", "continuous"):
        return [(joint.name, joint.axis, none, joint.kind == "continuous")]
    if joint.kind == "ball":
        return [(f"{joint.name}_{x}", axis, none, False) for x, axis in zip("xyz", np.eye(3), strict=True)]
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
    """Rotation and place of a locked joint."""
    if not np.isfinite(value):
        raise ValueError(f"joint {joint.name!r}: it must be locked at a finite number; got {value}")
    if joint.kind == "prismatic":
        return np.eye(3), joint.axis * value
    if joint.kind in ("fixed", "planar", "floating", "ball"):
        if value:
            raise ValueError(f"joint {joint.name!r}: a {joint.kind} joint is locked at 0; got {value}")
        return np.eye(3), np.zeros(3)
    return turn_about(joint.axis, value), np.zeros(3)


def _follow(axes: list[_Axis], names: list[str], free: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The joints as linear functions of the free ones: matrix (k, n) and offset (k,)."""
    matrix, offset = np.zeros((len(axes), len(free))), np.zeros(len(axes))
    for column, i in enumerate(free):
        matrix[i, column] = 1.0
    pending = [i for i in range(len(axes)) if i not in free]
    done = set(free)
    while pending:
        ready = [i for i in pending if _leader(axes[i], names) in done]
        if not ready:
            raise ValueError(f"joint {axes[pending[0]].name!r} follows itself")
        for i in ready:
            follows, leader = axes[i].joint.follows, _leader(axes[i], names)
            assert follows is not None
            matrix[i], offset[i] = follows.ratio * matrix[leader], follows.ratio * offset[leader] + follows.offset
        done |= set(ready)
        pending = [i for i in pending if i not in ready]
    return matrix, offset


def _leader(axis: _Axis, names: list[str]) -> int:
    assert axis.joint.follows is not None
    if axis.joint.follows.joint not in names:
        raise ValueError(f"joint {axis.name!r} follows {axis.joint.follows.joint!r}, which has more than one axis")
    return names.index(axis.joint.follows.joint)


@eqx.filter_jit  # operation by operation a first robot would take several times as long
def _matrix(space: AbstractSpace, x: Array) -> Array:
    return space(x)


def _check_inertia(model: MechanicalSystem, names: list[str]) -> None:
    """Raise `ValueError` where a velocity has no kinetic energy; `names` are the joints of its last components."""
    x = model.manifold.origin()
    values, vectors = np.linalg.eigh(np.asarray(_matrix(model.space, x)))
    if values[0] <= SMALLEST_INERTIA * values[-1]:
        participation = np.abs(vectors[:, 0])[-len(names) :]
        # The velocity without energy is the eigenvector of the smallest eigenvalue: its largest entry names the joint.
        worst = names[int(np.argmax(participation))] if names else "of the base"
        raise ValueError(
            f"joint {worst!r} moves no mass: the inertia matrix has the eigenvalue {values[0]:.2g} beside "
            f"{values[-1]:.2g}; give the links beyond it an <inertial>, or lock it"
        )
