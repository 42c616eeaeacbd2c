"""What acts in the joints of a robot that is assembled: its motors with their servos, and its friction."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from covariant.models._parameters import Parametric, namespace
from covariant.models.robots._description import Description, FrictionLaw, Joint, Motor
from covariant.models.robots._forces import joint_friction, resistance


def numbers(values: Iterable[Any]) -> Any:
    """An array of numbers some of which may be traced."""
    listed = list(values)
    return namespace(listed).asarray(listed, float)


def dissipation(joints: list[Joint], coordinates: np.ndarray, base: np.ndarray) -> Parametric:
    """Friction of the joints; where one has a law it takes the place of its damping and dry friction."""
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
    # Springs in parallel: stiffnesses add, and so do the torques at θ = 0, each stiffness · rest.
    torque = joint.stiffness * joint.rest + sum(motor.constant for motor in drives)
    if torque and not stiffness:
        raise ValueError(f"joint {joint.name!r}: a motor with a constant bias is not supported; add it to the input")
    return joint._replace(
        stiffness=stiffness,
        rest=torque / stiffness if stiffness else 0.0,
        damping=joint.damping + sum(motor.damping for motor in drives),
    )


def inputs(
    robot: Description,
    axes: Sequence[Any],
    coordinates: np.ndarray,
    free: list[int],
    motors: Sequence[Motor],
    actuated: Sequence[str] | None,
) -> Any:
    """Generalised force (n, m) of each input; traced where a torque constant is."""
    if not motors:
        driven = [i for i in free if actuated is None or axes[i].joint.name in actuated]
        # By virtual work the transpose of coordinates ↦ joint positions takes torques to generalised forces.
        factors = numbers(
            axes[i].joint.torque_constant * (_reduction(axes[i].joint) if robot.motor_torques else 1.0) for i in driven
        )
        return coordinates[driven].T * factors[None, :]
    columns = []
    for motor in motors:
        if motor.unsupported:
            raise ValueError(
                f"actuator {motor.name!r} {motor.unsupported}, which is not supported; give actuated=[...], the joints "
                "whose torques are logged, or remove it"
            )
        driven = [coordinates[i] for i, axis in enumerate(axes) if axis.joint.name == motor.joint]
        if driven:
            constant = next(axis.joint.torque_constant for axis in axes if axis.joint.name == motor.joint)
            columns.append(motor.gain * constant * (np.array(motor.direction) @ np.array(driven)))
    return numbers(columns).reshape(len(columns), coordinates.shape[1]).T


def _reduction(joint: Joint) -> float:
    if len(joint.reductions) != 1:
        stated = f"{len(joint.reductions)} transmissions with a reduction" if joint.reductions else "no reduction"
        raise ValueError(
            f"motor_torques: joint {joint.name!r} has {stated}; give it one <transmission> with a "
            "<mechanicalReduction>, 1 where the motor turns as the joint does, or leave the joint out by actuated=[...]"
        )
    return joint.reductions[0]
