"""Assembles mechanical systems from descriptions of robots; links that cannot move apart become one body."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._names import refuse_unknown
from covariant._typing import Number
from covariant.geometry import AbstractManifold, Coordinates, ProductManifold
from covariant.geometry.lie import SE3, SO3
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import Parametric, known, namespace
from covariant.models.robots._axes import Axis, Freedom, bodies_of, freedom_of, regrouped
from covariant.models.robots._description import NO_INERTIA, BodyInertia, Description, Joint, negative_inertia, numbers
from covariant.models.robots._forces import Potential, dissipation, force, inputs_of, with_motors
from covariant.models.robots._loops import close_loops
from covariant.models.robots._servos import ServoForce, loss, servo_of
from covariant.models.robots._space import RobotSpace
from covariant.models.robots._tree import KinematicTree, Links
from scalargraph import evaluate_batch
from scalargraph.errors import InputError

TWIST = ("v1", "v2", "v3", "w1", "w2", "w3")
"""Names of the components of the twist of the base."""
TWIST_UNITS = ("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s")
SMALLEST_INERTIA = 1e-12
"""Smallest eigenvalue of the inertia matrix, relative to the largest, with which it counts as positive definite."""
TAKES_PART = 1e-3
"""Smallest component of the velocity without energy, relative to the largest, at which a joint counts as involved."""


class Moved(NamedTuple):
    """The mass that a component of the velocity moves.

    The joint is empty for a base without one; the mass is in kg; the axis is None for a base.
    """

    joint: str
    mass: Number
    axis: np.ndarray | None = None


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
        lock: Locked joints, with their position [rad or m].
        actuated: Names of the joints with an input, in the order of the joints; all, or the file's motors, by default.
        payload: Point masses, `{link: (mass, x, y, z)}` [kg, m in the frame of the link].

    Returns:
        The system; its configuration space is a `RobotSpace`, or a `Leaf` of one if there are closed loops.

    Raises:
        ValueError: A name does not exist, a loop does not close, no joint moves, or a joint moves no mass.

    Example:
        >>> from covariant.models import robots
        >>> robots.assemble(robots.read("double_pendulum"), lock={"elbow": 0.0}).coordinates
        ('shoulder',)
    """
    loads = _check_payload(payload or {})
    # `_check_inertia` needs numerical values of the inertia, even in a compiled function.
    numbers, traced = known((loads, robot)), not known(jnp.zeros(()))
    with jax.ensure_compile_time_eval() if traced and numbers else contextlib.nullcontext():
        model, moved = _assemble(robot, floating, dict(lock or {}), actuated, loads)
        if numbers:
            _check_inertia(model, moved)
    if not robot.loops:
        return model
    return close_loops(model, robot, geometry_of(robot, floating, lock))


def _assemble(
    robot: Description, floating: bool, locked: dict[str, float], actuated: Sequence[str] | None, loads: dict[str, Any]
) -> tuple[MechanicalSystem, list[Moved]]:
    """The system of a robot, with its inertia matrix not yet checked, and the mass that each velocity moves."""
    _check_names(robot, [*locked, *(actuated or ())])
    locked = still_joints(robot, locked)
    robot, free_joint = _on_its_base(robot, locked)
    floating = floating or free_joint is not None
    axes, bodies, base, frames = bodies_of(robot, locked)
    base = _with_payload(bodies, base, frames, loads)
    if not axes and not floating:
        raise InputError("no joint moves; a robot needs one that is not fixed or locked")
    _check_moments(robot, frames, bodies, base if floating else None)
    freedom = freedom_of(axes)
    moved = _moved(axes, freedom, bodies, base, free_joint.name if free_joint else "", 6 * floating)
    bodies, base = regrouped(axes, bodies, base)
    weightless = 0.0 if free_joint is None else free_joint.armature
    # Six equal rotors of a floating joint act like a sphere at its origin, with mass but without weight.
    base = base.joined(BodyInertia(weightless, np.zeros(3), weightless / 2 * np.eye(3)))
    tree = _tree(axes, freedom, bodies, base, weightless, namespace(loads, robot))
    of_joints = Coordinates(tuple(k for k, i in enumerate(freedom.free) if axes[i].circle), len(freedom.free))
    manifold = _product(floating, len(tree.balls), of_joints)
    space = RobotSpace(tree, _links(frames), manifold=manifold, floating=floating, limits=tuple(map(_limits, axes)))
    return _system(robot, axes, freedom, space, actuated, free_joint), moved


def geometry_of(robot: Description, floating: bool = False, lock: Mapping[str, float] | None = None) -> RobotSpace:
    """The space of a robot's tree without inertias, in known numbers, even if other numbers of the robot are traced."""
    none = {"armature": 0.0, "damping": 0.0, "friction": 0.0, "law": None, "servo": None, "torque_constant": 1.0}
    joints = tuple(joint._replace(**none) for joint in robot.joints)
    links = dict.fromkeys(robot.links, NO_INERTIA)
    bare = robot._replace(joints=joints, links=links, motors=(), motor_torques=False, gravity=np.zeros(3))
    with jax.ensure_compile_time_eval():
        return _assemble(bare, floating, dict(lock or {}), None, {})[0].space  # pyright: ignore[reportReturnType]


def _moved(
    axes: list[Axis], freedom: Freedom, bodies: list[BodyInertia], base: BodyInertia, base_joint: str, of_base: int
) -> list[Moved]:
    mass = [body.mass for body in bodies]
    for i in reversed(range(len(axes))):  # from the leaves on: a body passes on what it received
        if axes[i].parent >= 0:
            mass[axes[i].parent] = mass[axes[i].parent] + mass[i]
    whole = base.mass + sum(body.mass for body in bodies)
    by_joint = [
        Moved(
            axes[i].joint.name,
            sum(mass[k] for k in np.flatnonzero(freedom.matrix[:, column])),
            axes[i].turn if axes[i].ball else axes[i].joint.axis,
        )
        for column, i in enumerate(freedom.moving)
    ]
    return [Moved(base_joint, whole)] * of_base + by_joint


def _check_names(robot: Description, names: Sequence[str]) -> None:
    """Raise `ValueError` if a joint does not exist, or a joint that others follow does not."""
    present = [joint.name for joint in robot.joints]
    for name in names:
        refuse_unknown("joint", name, present)
    for joint in robot.joints:
        follows = joint.follows
        if follows is not None and follows.joint not in (*present, ""):
            raise InputError(f"joint {joint.name!r} follows {follows.joint!r}, and there is no such joint")


def _with_payload(
    bodies: list[BodyInertia], base: BodyInertia, frames: dict[str, Any], loads: dict[str, Any]
) -> BodyInertia:
    """Add the payload to the bodies that carry it; returns the base with its share."""
    for link, (mass, place) in loads.items():
        refuse_unknown("link of payload", link, frames)
        body, rotation, origin = frames[link]
        if body < 0:
            base = base.with_mass(mass, rotation @ place + origin)
        else:
            bodies[body] = bodies[body].with_mass(mass, rotation @ place + origin)
    return base


def _tree(
    axes: list[Axis], freedom: Freedom, bodies: list[BodyInertia], base: BodyInertia, weightless: Number, xnp: Any
) -> KinematicTree:
    """The arrays of the robot space; `xnp` is JAX's NumPy if a number is traced, else NumPy."""

    def stacked(parts: list, shape: tuple[int, ...]) -> Array:
        return jnp.asarray(xnp.stack([xnp.asarray(part, float) for part in parts])) if parts else jnp.zeros((0, *shape))

    return KinematicTree(
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
        jnp.asarray(freedom.matrix),
        jnp.asarray(freedom.offset + freedom.matrix @ numbers(axes[i].joint.encoder_offset for i in freedom.moving)),
        # Each joint depends on one coordinate, so the rotors' inertia is diagonal: ratio² times each armature.
        jnp.asarray(freedom.matrix.T**2 @ numbers(axis.joint.armature for axis in axes)),
        tuple(freedom.balls[::3]),
        jnp.asarray(weightless, float),
    )


def _limits(axis: Axis) -> tuple[str, float, float]:
    # In many files, limits 0 and 0 mean that they are not known.
    limited = axis.joint.kind in ("revolute", "prismatic") and axis.joint.lower < axis.joint.upper
    return (axis.joint.name, *((axis.joint.lower, axis.joint.upper) if limited else (-np.inf, np.inf)))


def _links(frames: dict[str, Any]) -> Links:
    placements = list(frames.values())
    return Links(
        tuple(frames),
        tuple(body for body, _, _ in placements),
        jnp.asarray(np.array([rotation for _, rotation, _ in placements])),
        jnp.asarray(np.array([place for _, _, place in placements])),
    )


def _system(
    robot: Description,
    axes: list[Axis],
    freedom: Freedom,
    space: RobotSpace,
    actuated: Sequence[str] | None,
    free_joint: Joint | None,
) -> MechanicalSystem:
    """The system on the space, with the springs, dampers and motors of the joints, and names and units."""
    motors = robot.motors if actuated is None else ()
    springs = [with_motors(axis.joint, [motor for motor in motors if servo_of(motor) is None]) for axis in axes]
    motor_forces, servos = inputs_of(robot, axes, freedom, motors, actuated)
    floating, balls, free = space.floating, space.tree.balls, freedom.free
    units = tuple("rad" if axes[i].turn.any() else "m" for i in free)
    spins = tuple(f"w{k + 1}_{axes[i].joint.name}" for i in balls for k in range(3))
    velocities = (*TWIST * floating, *spins, *(f"rate_{axes[i].name}" for i in free))
    velocity_units = (*TWIST_UNITS * floating, *("rad/s" for _ in spins), *(f"{unit}/s" for unit in units))
    potential = Potential(
        space,
        jnp.asarray(robot.gravity),
        jnp.array([spring.stiffness for spring in springs], float),
        jnp.array([spring.rest for spring in springs], float),
        tuple(ball for ball, i in enumerate(balls) if springs[i].stiffness),
    )
    base = np.zeros(6 * floating)
    friction: Any = dissipation(springs, freedom.matrix, base, free_joint)
    motor_force: Any = Parametric(force, motors=motor_forces, base=base)
    if servos is not None:
        motor_force = ServoForce(servos, jnp.asarray(motor_forces), jnp.asarray(base))
        friction = loss(servos, friction, potential)
    return MechanicalSystem(
        space,
        potential=potential,
        force=motor_force,
        dissipation=friction,
        coordinates=tuple(axes[i].name for i in free),
        units=units,
        velocities=velocities if floating or balls else (),
        velocity_units=velocity_units if floating or balls else (),
        inputs=motor_forces.shape[1],
    )


def _product(floating: bool, balls: int, joints: Coordinates) -> AbstractManifold:
    """The manifold of a base, ball joints and coordinates; a single one of them is returned without a product."""
    factors = [SE3] * floating + [SO3] * balls + [joints] * bool(joints.dimension)
    return ProductManifold(tuple(factors)) if len(factors) > 1 else factors[0]


def _check_payload(payload: Mapping[str, Any]) -> dict[str, Any]:
    """Mass and position (3,) of the load on each link."""
    loads = {}
    for link, load in payload.items():
        if len(load) != 4:
            raise InputError(f"payload of {link!r}: give mass, x, y, z; got {len(load)} numbers")
        numbers = namespace(list(load)).asarray(load)
        if known(numbers) and not (np.isfinite(numbers).all() and numbers[0] >= 0):
            raise InputError(f"payload of {link!r}: the mass must not be negative, and all be finite; got {list(load)}")
        loads[link] = numbers[0], numbers[1:]
    return loads


def _on_its_base(robot: Description, locked: dict[str, float]) -> tuple[Description, Joint | None]:
    """The part of a robot that a floating joint carries, and this joint, if there is one."""
    loose = [joint for joint in robot.joints if joint.kind == "floating" and joint.name not in locked]
    if not loose:
        return robot, None
    base = loose[0].child
    carried = {base}
    for joint in robot.joints:  # each joint comes after the one that carries it
        carried |= {joint.child} if joint.parent in carried else set()
    beside = [j for j in robot.joints if j.child not in carried and j.name not in locked]
    if len(loose) > 1 or beside:
        other = (loose[1:] + beside)[0]
        raise InputError(
            f"joint {other.name!r}: one floating joint is supported, and it must carry all that moves; "
            f"{loose[0].name!r} is another; load one robot at a time, or lock the others"
        )
    joints = tuple(joint for joint in robot.joints if joint.parent in carried)
    return robot._replace(root=base, joints=joints), loose[0]


def still_joints(robot: Description, locked: dict[str, float]) -> dict[str, float]:
    """The locked joints, and those that follow one of them."""
    still = locked | {joint.name: 0.0 for joint in robot.joints if joint.kind == "fixed"}
    still |= {j.name: j.follows.offset for j in robot.joints if j.follows is not None and not j.follows.joint}
    # Followers may form chains: each pass settles one more link of a chain, so the loop ends.
    while True:
        more = {
            joint.name: joint.follows.ratio * still[joint.follows.joint] + joint.follows.offset
            for joint in robot.joints
            if joint.follows is not None and joint.name not in still and joint.follows.joint in still
        }
        if not more:
            return still
        still |= more


def _check_moments(
    robot: Description, frames: dict[str, Any], bodies: list[BodyInertia], base: BodyInertia | None
) -> None:
    """Raise `ValueError` if a moving body, with all that is fixed to it, has a negative moment of inertia."""
    for body, inertia in [*enumerate(bodies), *([] if base is None else [(-1, base)])]:
        if not (known(inertia) and negative_inertia("", inertia)):
            continue
        links = [name for name, frame in frames.items() if frame[0] == body]
        negative = [sentence for name in links if (sentence := negative_inertia(name, robot.links[name]))]
        together = " with all that is fixed to it" if len(links) > 1 else ""
        raise InputError((negative or [negative_inertia(links[0], inertia)])[0] + together)


def _check_inertia(model: MechanicalSystem, moved: list[Moved]) -> None:
    """Raise `ValueError` if a velocity has no kinetic energy."""
    (matrix,) = evaluate_batch(model.space, jax.tree.map(lambda part: part[None], model.manifold.origin()))
    eigenvalues, vectors = np.linalg.eigh(matrix)
    least = SMALLEST_INERTIA * eigenvalues[-1]
    if eigenvalues[0] > least:
        return
    # The eigenvector of the smallest eigenvalue is the velocity without energy; its largest entry names the joint.
    participation = np.abs(vectors[:, 0])
    worst = int(np.argmax(participation))
    name, mass, axis = moved[worst]
    others = {moved[i].joint for i in np.flatnonzero(participation > TAKES_PART * participation[worst])} - {name}
    why = f"the inertia matrix has the eigenvalue {eigenvalues[0]:.2g} beside {eigenvalues[-1]:.2g}"
    joint = f"joint {name!r}" if name else "the base"
    if not mass:
        raise InputError(f"{joint} moves no mass: {why}; give the links beyond it an <inertial>, or lock it")
    if matrix[worst, worst] > least and others:
        names = ", ".join(sorted(repr(other) if other else "the base" for other in others))
        raise InputError(
            f"{joint} and {names} can move together so that no mass moves: {why}; give the links between them an "
            "<inertial>, or lock one of them"
        )
    if axis is None:
        spin = vectors[3:6, 0]
        axis = spin / spin[np.argmax(np.abs(spin))]
    direction = " ".join(f"{part:.3g}" for part in np.round(axis, 9) + 0.0)
    raise InputError(
        f"{joint} moves {mass:.3g} kg, which have no moment of inertia about its axis {direction}: {why}; give the "
        "links that it moves an <inertia> about this axis, or the joint an armature, or lock it"
    )
