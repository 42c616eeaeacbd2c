"""Writes one servo of a robot as a parameter file of BAM, whose friction grows with the load of the gear.

BAM's motor gives `kt vin/R clip(kp error_gain e, ±max_pwm) − kt²/R v` for the error e between command and position; the
offset of the encoder acts on the weight alone. Friction stops the joint, by at most `friction_base + friction_viscous
|v| + |load_friction_external τ_e − load_friction_motor τ_m| + s friction_stribeck` with `s = exp(−|v/dtheta_stribeck|^
alpha)`, for the torque τ_m of the motor and τ_e of the weight.

Source: Duclusaud et al. 2025, Extended Friction Models for the Physics Simulation of Servo Actuators, section III. BAM
takes the constants of the drive from its classes of servos; Isaac Lab reads them from the same file.
"""

import json
import math
from collections.abc import Sequence

from covariant.models.robots._description import Description, FrictionLaw
from covariant.models.robots._servos import drive_limit
from covariant.models.robots._write_mjcf import lasting_delay, plain_friction
from scalargraph.errors import InputError

NOMINAL_SUPPLY = 12.0
"""Voltage in the file if the servo states none [V]. Torques do not depend on it: kt is proportional to it, R to its
square."""


def bam_text(robot: Description, about: Sequence[str] = (), left_out: Sequence[str] = ()) -> str:
    """Text of the parameter file of the only joint of `robot`, as JSON."""
    (joint,) = robot.joints
    servo, law = joint.servo, joint.law or FrictionLaw()
    assert servo is not None
    (limit, back_emf), (viscous, coulomb) = drive_limit(servo), plain_friction(joint._replace(servo=None))
    # Below the torque limit damping acts as the back-EMF does, also in the friction that grows with the motor's torque.
    braking, supply = float(servo.damping + back_emf), float(servo.supply) or NOMINAL_SUPPLY
    if not (math.isfinite(limit) and braking):
        raise InputError(
            f"the motor of BAM follows from its largest torque and its damping; state limit, and damping or back_emf, "
            f"of [servo.{joint.name}]"
        )
    torque_per_volt = float(limit) / (supply * float(servo.pwm_limit))
    table = {
        "kt": braking / torque_per_volt,
        "R": braking / torque_per_volt**2,
        "armature": float(joint.armature),
        "q_offset": float(joint.encoder_offset),
        "command_delay": lasting_delay(servo),
        "friction_base": float(coulomb),
        "friction_viscous": float(viscous),
        "friction_stribeck": float(law.stribeck),
        "dtheta_stribeck": float(law.stribeck_velocity),
        "alpha": 2.0,
        "load_friction_motor": float(law.load),
        "load_friction_external": float(law.load_external),
        # Without these entries BAM has values of its own.
        "load_friction_motor_stribeck": 0.0,
        "load_friction_external_stribeck": 0.0,
        "model": "m5" if law.load or law.load_external else "m2" if law.stribeck else "m1",
        "actuator": joint.name,
        "vin": supply,
        "kp": float(servo.gain),
        "error_gain": float(servo.stiffness) / (supply * torque_per_volt),
        "max_pwm": float(servo.pwm_limit),
        "max_current": None,
        "about": list(about),
        "left_out": list(left_out),
    }
    return json.dumps(table, indent=2, allow_nan=False) + "\n"
