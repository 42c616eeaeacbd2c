"""Computes the forces in a robot: weight and springs, motors with their servos, and friction of its joints."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Scalar
from covariant.geometry.lie import SO3
from covariant.models._parameters import Parametric, known
from covariant.models.robots._axes import Axis, Freedom
from covariant.models.robots._description import Description, FrictionLaw, Joint, Motor, numbers
from covariant.models.robots._servos import Driven, Servos, servo_of, servos_of
from covariant.models.robots._space import RobotSpace
from scalargraph.errors import InputError

COULOMB_STEEPNESS = 100.0
"""Slope at rest of the smoothed Coulomb friction `friction (2/π) atan(100 v)` [s/rad or s/m]."""


class Potential(Functional):
    """Potential energy `q -> ()` [J] of the weight and of the springs of the joints.

    Attributes:
        space: Configuration space of the robot.
        gravity: Gravity (3,) in the frame of the world [m/s²].
        stiffness: Stiffness of the springs (k,) [N m/rad or N/m].
        rest: Positions at which the springs rest (k,) [rad or m].
        sprung: Indices of the ball joints with a spring, which pulls the short way back to the identity.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import robots
        >>> hanging = robots.load("double_pendulum").potential
        >>> bool(hanging(jnp.zeros(2)) < hanging(jnp.array([0.5, 0.0])))
        True
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
        # The energy of the weight is −g · ∫ρ r.
        return jnp.sum(stiffness * stretched**2) / 2 - gravity @ self.space.first_moment(q, self.space.joints(q))


def force(t, q, u, motors: Float[Array, "n m"], base: Float[Array, "b"]):
    """Generalised force of the motors."""
    return jnp.concatenate([base, motors @ u])


def resistance(
    q,
    v,
    coordinates: Float[Array, "k n"],
    damping: Float[Array, "k"],
    friction: Float[Array, "k"],
    base: Float[Array, "b"],
):
    """Generalised force of the friction in k joints, whose rates are `coordinates` (k, n) times the coordinate rates.

    `base` are the zeros for a floating base. Coulomb friction [N m or N] is smoothed as `(2/π) atan(100 v)`.
    """
    rates = coordinates @ v[base.shape[0] :]
    torque = _plain_friction(rates, damping, friction)
    # By virtual work coordinatesᵀ converts torques; the power is −torque · rates ≤ 0.
    return jnp.concatenate([base, -coordinates.T @ torque])


def floating_friction(q, v, joints: dict[str, Any], damping: Scalar, friction: Scalar, law: dict[str, Scalar]):
    """Generalised force of the friction in a floating joint and in the others, whose parameters are `joints`.

    It acts on each component of the velocity: on the linear ones in the world, on the angular ones in the body.
    """
    rotation = q.reshape(-1)[:16].reshape(4, 4)[:3, :3]
    rates = jnp.concatenate([rotation @ v[:3], v[3:6]])
    torque = _plain_friction(rates, damping, friction) + _friction_of_law(rates, law)
    return _of_joints(q, v, joints) - jnp.concatenate([torque[:3] @ rotation, torque[3:], jnp.zeros_like(v[6:])])


def floating_damping(q, v, joints: dict[str, Any], damping: Scalar):
    """`floating_friction` without dry friction: six equal dampers have the same effect in the world and in the body."""
    return _of_joints(q, v, joints) - jnp.concatenate([damping * v[:6], jnp.zeros_like(v[6:])])


def _of_joints(q, v, joints: dict[str, Any]):
    return joint_friction(q, v, **joints) if "law" in joints else resistance(q, v, **joints)


def joint_friction(
    q,
    v,
    coordinates: Float[Array, "k n"],
    damping: Float[Array, "k"],
    friction: Float[Array, "k"],
    base: Float[Array, "b"],
    law: dict[str, Float[Array, "k"]],
):
    """Generalised force of the friction in joints, some of which have a `FrictionLaw`."""
    torque = _friction_of_law(coordinates @ v[base.shape[0] :], law)
    return resistance(q, v, coordinates, damping, friction, base) + jnp.concatenate([base, -coordinates.T @ torque])


def _plain_friction(rates, damping, friction):
    # atan tends to π/2, so with this factor the torque at high speed is `friction`.
    return damping * rates + friction * (2 / jnp.pi) * jnp.arctan(COULOMB_STEEPNESS * rates)


def _friction_of_law(rates, law):
    sign = jnp.tanh(rates / law["smoothing"])
    return law["viscous"] * rates + dry_friction(rates, law) * sign + law["asymmetry"] * sign**2


def dry_friction(rates, law):
    """Size of the dry friction without the contribution of a load; `law` holds arrays by name."""
    return law["coulomb"] + law["stribeck"] * jnp.exp(-((rates / law["stribeck_velocity"]) ** 2))


def dissipation(
    joints: list[Joint], coordinates: np.ndarray, base: np.ndarray, free_joint: Joint | None = None
) -> Parametric:
    """Friction of the joints; the law of a joint, if it has one, replaces its damping and dry friction."""
    of_joints = _dissipation_of_joints(joints, coordinates, base)
    if free_joint is None or not (free_joint.law or free_joint.damping or free_joint.friction):
        return of_joints
    law = free_joint.law or FrictionLaw()
    damping, friction = (0.0, 0.0) if free_joint.law else (free_joint.damping, free_joint.friction)
    joints_friction = of_joints.parameters
    if not (free_joint.law or friction):
        return Parametric(floating_damping, joints=joints_friction, damping=damping)
    given = {"damping": damping, "friction": friction, "law": law._asdict()}
    return Parametric(floating_friction, joints=joints_friction, **given)


def _dissipation_of_joints(joints: list[Joint], coordinates: np.ndarray, base: np.ndarray) -> Parametric:
    plain = {
        "coordinates": coordinates,
        "damping": numbers(0.0 if joint.law else joint.damping for joint in joints),
        "friction": numbers(0.0 if joint.law else joint.friction for joint in joints),
        "base": base,
    }
    if not any(joint.law for joint in joints):
        return Parametric(resistance, **plain)
    none = FrictionLaw()
    laws = [joint.law or none for joint in joints]
    law = {field: numbers(getattr(one, field) for one in laws) for field in none._fields}
    return Parametric(joint_friction, **plain, law=law)


def with_motors(joint: Joint, motors: Sequence[Motor]) -> Joint:
    """The joint with the springs and dampers of the servos that drive it."""
    drives = [motor for motor in motors if motor.joint == joint.name]
    stiffness = joint.stiffness + sum(motor.stiffness for motor in drives)
    # For springs in parallel, stiffnesses add up, and so do the torques at θ = 0, stiffness · rest each.
    torque = joint.stiffness * joint.rest + sum(motor.constant for motor in drives)
    if torque and not stiffness:
        raise InputError(f"joint {joint.name!r}: a motor with a constant bias is not supported; add it to the input")
    return joint._replace(
        stiffness=stiffness,
        rest=torque / stiffness if stiffness else 0.0,
        damping=joint.damping + sum(motor.damping for motor in drives),
    )


def inputs_of(
    robot: Description,
    axes: Sequence[Axis],
    freedom: Freedom,
    motors: Sequence[Motor],
    actuated: Sequence[str] | None,
) -> tuple[Any, Servos | None]:
    """Generalised force (n, m) of each input that is a torque, traced if a constant is, and the servos."""
    if motors:
        chosen = [_of_motor(motor, axes, freedom) for motor in motors if _drives(motor, axes)]
    else:
        chosen = [
            _of_joint(robot, axes[i].joint, i, freedom)
            for i in freedom.free
            if actuated is None or axes[i].joint.name in actuated
        ]
    without = [axes[i].joint.name for i in freedom.free if axes[i].joint.servo is not None]
    without = [name for name in without if name not in {axes[each.axis].joint.name for each, _ in chosen}]
    if without:
        raise InputError(f"servo {without[0]!r}: the joint has no input; name it in actuated, or remove its table")
    served = {axes[each.axis].joint.name for each, _ in chosen if each.servo is not None}
    for joint in (axes[i].joint for i in freedom.free):
        law = joint.law
        if law is not None and joint.name not in served and any(known(x) and x for x in (law.load, law.load_external)):
            raise InputError(
                f"friction of {joint.name!r}: load and load_external need a servo, whose torque is the load"
            )
    servos = servos_of(axes, freedom, [each for each, _ in chosen])
    more = 0 if servos is None else len(servos.input_names) - len(chosen)
    columns = [column for _, column in chosen] + [np.zeros(freedom.matrix.shape[1])] * more
    return numbers(columns).reshape(len(columns), freedom.matrix.shape[1]).T, servos


def _drives(motor: Motor, axes: Sequence[Axis]) -> bool:
    if motor.unsupported:
        raise InputError(
            f"actuator {motor.name!r} {motor.unsupported}, which is not supported; give actuated=[...], the joints "
            "whose torques are logged, or remove it"
        )
    return any(axis.joint.name == motor.joint for axis in axes)


def _of_motor(motor: Motor, axes: Sequence[Axis], freedom: Freedom) -> tuple[Driven, Any]:
    """The input of a motor in the file, and its generalised force (n,) if it is a torque."""
    at = [i for i, axis in enumerate(axes) if axis.joint.name == motor.joint]
    joint = axes[at[0]].joint
    servo = joint.servo or servo_of(motor)
    if servo is not None:
        servo = servo._replace(command_scale=servo.command_scale * joint.torque_constant)
        return Driven(at[0], servo, joint.servo is not None), np.zeros(freedom.matrix.shape[1])
    # By virtual work, the transpose of the map from coordinates to joint positions converts torques.
    column = motor.gain * joint.torque_constant * (np.array(motor.direction) @ freedom.matrix[at])
    return Driven(at[0], None), column


def _of_joint(robot: Description, joint: Joint, axis: int, freedom: Freedom) -> tuple[Driven, Any]:
    """The input of a joint without a motor in the file, and its generalised force (n,) if it is a torque."""
    if joint.servo is not None:
        return Driven(axis, joint.servo, True), np.zeros(freedom.matrix.shape[1])
    factor = joint.torque_constant * (reduction_of(joint) if robot.motor_torques else 1.0)
    return Driven(axis, None), freedom.matrix[axis] * factor


def reduction_of(joint: Joint) -> float:
    if len(joint.reductions) != 1:
        stated = f"{len(joint.reductions)} transmissions with a reduction" if joint.reductions else "no reduction"
        raise InputError(
            f"motor_torques: joint {joint.name!r} has {stated}; give it one <transmission> with a "
            "<mechanicalReduction>, 1 where the motor turns as the joint does, or leave the joint out by actuated=[...]"
        )
    return joint.reductions[0]
