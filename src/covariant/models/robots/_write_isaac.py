"""Writes servos of a robot as one table for the actuators of Isaac Lab and of simulators with the same names.

An entry has the arguments of an explicit actuator with a delay for one joint, such as `DelayedPDActuatorCfg`:
`stiffness` and `damping` belong to the drive, within `effort_limit`; `friction` holds the joint at rest,
`dynamic_friction` brakes it in motion, and `viscous_friction` grows with the speed. Delays are counted in physics
steps.
"""

import json
import math
from collections.abc import Sequence
from typing import Any

from covariant.models.robots._description import Description, FrictionLaw, Joint
from covariant.models.robots._servos import drive_limit
from covariant.models.robots._write_mjcf import ROUNDING, lasting_delay, plain_friction
from scalargraph.errors import InputError


def isaac_text(robot: Description, step: float, about: Sequence[str] = (), left_out: Sequence[str] = ()) -> str:
    """Text of the table as JSON; `step` is the time step of the physics [s]."""
    driven = [joint for joint in robot.joints if joint.servo is not None]
    if not driven:
        raise InputError("no joint has a servo, of which the table would be; give the model file [servo.JOINT] tables")
    table = {
        "about": list(about),
        "step": step,
        "actuators": {joint.name: _actuator(joint, step) for joint in driven},
        "command_offsets": {joint.name: float(joint.servo.offset) for joint in driven if joint.servo},
        "left_out": list(left_out),
    }
    return json.dumps(table, indent=2, allow_nan=False) + "\n"


def _actuator(joint: Joint, step: float) -> dict[str, Any]:
    servo = joint.servo
    assert servo is not None
    (limit, _), (viscous, coulomb) = drive_limit(servo), plain_friction(joint)
    steps = lasting_delay(servo) / step
    stribeck = (joint.law or FrictionLaw()).stribeck
    limits = {"effort_limit": limit, "velocity_limit": joint.velocity}
    return {
        "stiffness": float(servo.gain * servo.stiffness),
        "damping": float(servo.damping),
        # JSON has no infinity; without a limit the configuration leaves the entry out.
        **{key: float(value) for key, value in limits.items() if math.isfinite(value)},
        "armature": float(joint.armature),
        "friction": float(coulomb + stribeck),
        "dynamic_friction": float(coulomb),
        "viscous_friction": float(viscous),
        "min_delay": math.floor(steps + ROUNDING),
        "max_delay": math.ceil(steps - ROUNDING),
    }
