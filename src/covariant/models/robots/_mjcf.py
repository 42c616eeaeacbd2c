"""Reads MJCF files, the robot descriptions of MuJoCo, through its compiler. Source: MuJoCo's XML reference.

The compiled model resolves defaults, units, included files and the inertia of shapes; here it becomes a `Description`.
Unsupported entries that would change the motion are refused by name; entries that change nothing, or matter only in
contact, are counted as ignored. Afterwards `_against_mujoco` compares the forces of both models, to detect missed ones.
"""

import re
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from covariant._optional import load_optional
from covariant.models.robots._description import (
    NO_INERTIA,
    BodyInertia,
    Description,
    Joint,
    Motor,
    doubts_on,
    exact,
    in_order,
    limits_in_doubt,
    turn_about,
)
from covariant.models.robots._mjcf_compile import compiled_model
from covariant.models.robots._mjcf_equalities import anchor_of, assembly_of, couple_joints, kind_of, rotation_of
from scalargraph.errors import InputError

IGNORED = {
    "ngeom": "geom (contacts, shapes)",
    "nsite": "site",
    "nsensor": "sensor",
    "ncam": "camera",
    "nlight": "light",
    "nkey": "keyframe",
    "npair": "contact/pair",
    "nexclude": "contact/exclude",
    "nmesh": "asset/mesh",
    "nhfield": "asset/hfield",
    "nmocap": "body/mocap (stands still)",
    "ntex": "asset/texture",
    "nmat": "asset/material",
    "nskin": "skin",
}
"""Entries that have no meaning here: sizes of the compiled model, with the names under which they are reported."""

MOTOR_LIMITS = {
    "actuator_ctrllimited": "actuator/ctrlrange",
    "actuator_forcelimited": "actuator/forcerange",
    "jnt_actfrclimited": "joint/actuatorfrcrange",
}
"""Limits of motors other than servos; they have no meaning here, since forces and inputs of a log are within them.
"""


class _Reader:
    """A compiled model, with the entries read from it so far."""

    def __init__(self, mujoco: ModuleType, model: Any):
        self.mujoco, self.model = mujoco, model
        self.used, self.ignored, self.doubts = Counter(), Counter(), []
        self.bodies = names_of(mujoco, model, "BODY", model.nbody)
        self.names = names_of(mujoco, model, "JOINT", model.njnt)
        self.actuators = names_of(mujoco, model, "ACTUATOR", len(model.actuator_trntype))

    def name(self, kind: str, index: int) -> str:
        return names_of(self.mujoco, self.model, kind, index + 1)[index]

    def entry(self, field: str, index: int) -> np.ndarray:
        """An entry of a field; 0 if an earlier version of MuJoCo does not have the field."""
        return np.asarray(getattr(self.model, field, np.zeros(index + 1))[index], float)

    def off(self, flag: str) -> bool:
        """Whether the file disables a kind of force."""
        return bool(self.model.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{flag}")))


def names_of(mujoco: ModuleType, model: Any, kind: str, count: int) -> list[str]:
    """Names of the first entries of a kind, such as "JOINT"; entries without a name get numbers."""
    kind_number = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
    return [mujoco.mj_id2name(model, kind_number, i) or f"{kind.lower()}{i}" for i in range(count)]


def read_mjcf(path: Path) -> tuple[Description, Any]:
    """Read the robot that an MJCF file describes, and MuJoCo's compiled model of it."""
    mujoco = load_optional("mujoco", use="MJCF files are read with", extra="robots")
    model, missing = compiled_model(mujoco, path)
    read = _Reader(mujoco, model)
    read.ignored.update(missing)
    _refuse(read)
    links: dict[str, BodyInertia] = {read.bodies[0]: NO_INERTIA}
    joints: list[Joint] = []
    for i in range(1, model.nbody):
        _body(read, i, links, joints)
    joints, loops = couple_joints(read, joints)
    joints = _with_actuators(read, joints)
    motors = _motors(read)  # first, since the counts below are complete only then
    for size, what in IGNORED.items():
        if getattr(model, size):
            read.ignored[what] += int(getattr(model, size))
    for field, what in MOTOR_LIMITS.items():
        count = int(getattr(model, field).sum()) - read.used[what]
        if count > 0:
            read.ignored[what] += count
    root, ordered = in_order(links, joints)
    gravity = np.zeros(3) if read.off("GRAVITY") else np.array(model.opt.gravity)
    robot = Description(
        bytes(model.names).split(b"\0")[0].decode() or path.stem,
        links,
        ordered,
        root,
        gravity,
        dict(read.used),
        dict(read.ignored),
        tuple(read.doubts),
        motors,
        loops=tuple(loops),
        assembly=assembly_of(read, loops),
    )
    return robot, model


def _refuse(read: _Reader) -> None:
    """Raise `ValueError` for the first entry that is unsupported but changes the motion, or is not finite."""
    model = read.model
    for field in filter(re.compile("(body|jnt|dof|actuator|eq)_|qpos").match, dir(model)):
        if not np.isfinite(np.asarray(getattr(model, field), float)).all():
            raise InputError(f"a number of {field.replace('_', ' ', 1)} is not finite; write finite numbers")
    if not np.isfinite(model.opt.gravity).all():
        raise InputError("gravity is not finite; write finite numbers")
    if model.opt.density or model.opt.viscosity:
        raise InputError("<option> has a fluid (density, viscosity), which is not supported; set both to 0")
    if model.nflex:
        raise InputError("<flex>: soft bodies are not supported; remove them")
    if model.nplugin:
        raise InputError("<plugin>: plugins are not supported; remove them")
    for i in np.flatnonzero(model.body_gravcomp):
        raise InputError(f"body {read.bodies[i]!r}: gravcomp is not supported; set it to 0 and log the torque it makes")
    for i in range(model.ntendon):
        properties = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature)
        not_linear = (read.entry(f"tendon_{field}poly", i).any() for field in ("stiffness", "damping"))
        if any(part[i] for part in properties) or any(not_linear):
            raise InputError(
                f"tendon {read.name('TENDON', i)!r}: springs, damping, friction and armature of tendons are not "
                "supported; put them into the joints"
            )
        read.ignored["tendon"] += 1
    for i in range(model.neq):
        if not model.eq_active0[i] or read.off("EQUALITY"):
            read.ignored["equality (inactive)"] += 1
        elif (kind := kind_of(read, i)) not in ("connect", "weld", "joint"):
            raise InputError(
                f"equality {read.name('EQUALITY', i)!r}: coupled {kind}s are not supported; couple the joints by "
                "equality/joint, the bodies by connect or weld, or make it inactive"
            )


def _body(read: _Reader, i: int, links: dict[str, BodyInertia], joints: list[Joint]) -> None:
    """Add a body, its joints, and a link without mass between any two of them."""
    model = read.model
    axes = rotation_of(model.body_iquat[i])
    # The compiler gives moments along principal axes (`iquat`), about the centre of mass (`ipos`).
    moments = axes @ np.diag(model.body_inertia[i]) @ axes.T
    inertia = BodyInertia.of(float(model.body_mass[i]), np.array(model.body_ipos[i]), moments)
    read.doubts += doubts_on(read.bodies[i], inertia)
    read.used["body"] += 1
    parent = int(model.body_parentid[i])
    # The frame of a link is that of its body, moved to the anchor of its last joint.
    above, rotation = read.bodies[parent], rotation_of(model.body_quat[i])
    place = np.array(model.body_pos[i]) - anchor_of(read, parent)
    first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
    if not count:
        links[read.bodies[i]] = inertia
        name = f"weld of {read.bodies[i]}"
        joints.append(Joint(name, "fixed", above, read.bodies[i], exact(rotation), place, np.eye(3)[2]))
        return
    origin = np.zeros(3)
    for k in range(first, first + count):
        last = k == first + count - 1
        below = read.bodies[i] if last else f"{read.bodies[i]} before {read.names[k + 1]}"
        anchor = np.array(model.jnt_pos[k])
        joints.append(_joint(read, k, above, below, rotation, place + rotation @ (anchor - origin)))
        links[below] = inertia.moved(np.eye(3), -anchor) if last else NO_INERTIA
        # Further joints of a body are in its frame, each at an anchor of its own.
        above, rotation, place, origin = below, np.eye(3), np.zeros(3), anchor


def _joint(read: _Reader, k: int, parent: str, child: str, rotation: np.ndarray, place: np.ndarray) -> Joint:
    model, where = read.model, f"joint {read.names[k]!r}"
    kind = read.mujoco.mjtJoint(int(model.jnt_type[k])).name.removeprefix("mjJNT_").lower()
    read.used[f"joint/{kind}"] += 1
    d, axis = int(model.jnt_dofadr[k]), exact(np.array(model.jnt_axis[k]))
    not_linear = (("jnt_stiffnesspoly", k), ("dof_dampingpoly", d), ("jnt_springyield", k))
    if any(read.entry(*field).any() for field in not_linear):
        raise InputError(f"{where}: springs and dampers that are not linear are not supported; give one number each")
    forces = {
        "damping": 0.0 if read.off("DAMPER") else float(model.dof_damping[d]),
        "friction": 0.0 if read.off("FRICTIONLOSS") else float(model.dof_frictionloss[d]),
        "armature": float(model.dof_armature[d]),
        "stiffness": 0.0 if read.off("SPRING") else float(model.jnt_stiffness[k]),
    }
    for key, value in forces.items():
        if value:
            read.used[f"joint/{key}"] += 1
    if kind == "free":
        if forces["stiffness"]:
            raise InputError(f"{where}: the stiffness of a free joint is not supported; set it to 0")
        return Joint(read.names[k], "floating", parent, child, exact(rotation), place, axis)._replace(**forces)
    address, ball, slide = int(model.jnt_qposadr[k]), kind == "ball", kind == "slide"
    # The configuration of a ball joint is a quaternion, and its spring rests at the pose in the file.
    start, rest = (0.0, 0.0) if ball else (float(model.qpos0[address]), float(model.qpos_spring[address]))
    limited = bool(model.jnt_limited[k]) and not ball
    lower, upper = model.jnt_range[k] if limited else (-np.inf, np.inf)
    if ball and model.jnt_limited[k]:
        read.ignored["joint/range of a ball"] += 1
    # The file states the pose of the body at q = ref.
    if slide:
        place = place - rotation @ axis * start
    else:
        rotation = rotation @ turn_about(axis, -start)
    joint = Joint(
        read.names[k],
        "ball" if ball else "prismatic" if slide else "revolute" if limited else "continuous",
        parent,
        child,
        exact(rotation),
        place,
        axis,
        rest=rest,
        lower=float(lower),
        upper=float(upper),
    )._replace(**forces)
    read.doubts += limits_in_doubt(joint)
    return joint


def _with_actuators(read: _Reader, joints: list[Joint]) -> list[Joint]:
    """The joints with rotors and dampers of their actuators, which act even if the motors are not inputs."""
    by_name, hinges = {joint.name: joint for joint in joints}, ("revolute", "continuous", "prismatic")
    for i, name in enumerate(read.actuators):
        where = f"actuator {name!r}"
        if read.entry("actuator_dampingpoly", i).any():
            raise InputError(f"{where}: a damper that is not linear is not supported; give one number")
        losses = {"armature": float(read.entry("actuator_armature", i))}
        losses["damping"] = 0.0 if read.off("DAMPER") else float(read.entry("actuator_damping", i))
        if not any(losses.values()):
            continue
        driven = by_name[read.names[int(read.model.actuator_trnid[i, 0])]] if _drives_joint(read, i) else None
        if driven is None or driven.kind not in hinges:
            raise InputError(
                f"{where}: armature and damping are supported only where it drives a hinge or a slide; set them to 0, "
                "and give the joints theirs"
            )
        # A gear scales force and position, so inertia and damping at the joint have the factor gear².
        squared = float(read.model.actuator_gear[i, 0]) ** 2
        for key, value in losses.items():
            if value:
                read.used[f"actuator/{key}"] += 1
        added = {key: getattr(driven, key) + squared * losses[key] for key in ("armature", "damping")}
        by_name[driven.name] = driven._replace(**added)
    return list(by_name.values())


def _drives_joint(read: _Reader, i: int) -> bool:
    kinds = (int(read.mujoco.mjtTrn.mjTRN_JOINT), int(read.mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return int(read.model.actuator_trntype[i]) in kinds


def _motors(read: _Reader) -> tuple[Motor, ...]:
    """The motors of the joints; those with an internal state are refused when they become inputs."""
    model, mujoco, motors = read.model, read.mujoco, []
    if read.off("ACTUATION"):
        read.ignored["actuator"] += len(read.actuators)
        return ()
    for i, name in enumerate(read.actuators):
        group = int(model.actuator_group[i])
        # MuJoCo can disable only the groups 0 to 30.
        if 0 <= group < 31 and model.opt.disableactuator >> group & 1:
            read.ignored["actuator (disabled group)"] += 1
            continue
        unsupported = ""
        gain, bias = float(model.actuator_gainprm[i, 0]), np.array(model.actuator_biasprm[i])
        linear = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
        joint = int(model.actuator_trnid[i, 0])
        # With the bias type none, MuJoCo ignores the numbers in biasprm.
        if int(model.actuator_biastype[i]) == linear[0]:
            bias = bias * 0
        kind = int(model.jnt_type[joint]) if _drives_joint(read, i) else None
        ball = kind == int(mujoco.mjtJoint.mjJNT_BALL)
        if kind is None:
            unsupported = "acts on no joint"
        elif kind == int(mujoco.mjtJoint.mjJNT_FREE):
            unsupported = f"acts on {read.names[joint]!r}, a free joint"
        elif ball and int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            unsupported = f"acts on the ball joint {read.names[joint]!r} along an axis of its parent"
        elif ball and bias[:3].any():
            unsupported = f"is a servo on the ball joint {read.names[joint]!r}"
        elif int(model.actuator_dyntype[i]) != int(mujoco.mjtDyn.mjDYN_NONE):
            unsupported = "has a state of its own"
        elif read.entry("actuator_delay", i) and not bias[1]:
            unsupported = "has a delay"
        elif int(model.actuator_gaintype[i]) != int(mujoco.mjtGain.mjGAIN_FIXED) or (
            int(model.actuator_biastype[i]) not in linear
        ):
            unsupported = "is neither a motor nor a linear servo"
        constant, spring, damper = (float(number) for number in bias[:3])
        read.used["actuator"] += 1
        direction = tuple(float(number) for number in model.actuator_gear[i, :3]) if ball else (1.0,)
        gear = 1.0 if ball else float(model.actuator_gear[i, 0])
        of_joint = "" if unsupported else read.names[joint]
        # A gear scales torque and position, hence springs and dampers by its square. MuJoCo's bias is
        # b₀ + b₁ length + b₂ velocity, hence the signs.
        numbers = gear * gain, -(gear**2) * spring, -(gear**2) * damper, gear * constant
        motor = Motor(name, of_joint, *numbers, unsupported, direction)
        motors.append(_with_limit(read, i, abs(gear), motor) if of_joint and spring else motor)
    return tuple(motors)


def _with_limit(read: _Reader, i: int, gear: float, servo: Motor) -> Motor:
    """A servo with its delay and torque limit, or with the reason why it cannot be an input."""
    model, joint = read.model, int(read.model.actuator_trnid[i, 0])
    ranges = []
    if model.actuator_forcelimited[i]:
        read.used["actuator/forcerange"] += 1
        ranges.append(("forcerange", gear * np.array(model.actuator_forcerange[i])))
    if model.jnt_actfrclimited[joint]:
        if [int(each) for each in model.actuator_trnid[:, 0]].count(joint) > 1:
            return servo._replace(unsupported="shares the actuatorfrcrange of its joint with another one")
        read.used["joint/actuatorfrcrange"] += 1
        ranges.append(("actuatorfrcrange", np.array(model.jnt_actfrcrange[joint])))
    for what, (low, high) in ranges:
        if low != -high:
            return servo._replace(unsupported=f"has a {what} from {low:g} to {high:g}, not the same in both directions")
    limit = min((high for _, (_, high) in ranges), default=np.inf)
    return servo._replace(limit=float(limit), delay=float(read.entry("actuator_delay", i)))
