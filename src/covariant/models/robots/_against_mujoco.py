"""Compares the description of a robot with MuJoCo's model of its file, so that no entry of an MJCF file gets lost.

The description is written back as a plain MuJoCo model of links, joints with springs, dampers and rotors, and weight.
At random states and inputs both models must need the same generalised forces; an entry that the description lacks shows
at the joint on which it acts. MuJoCo evaluates both, which takes milliseconds. Contacts, limits, loops and dry friction
are constraints in MuJoCo and are switched off here. Its constraints of closed loops are soft, so motions would differ
with its time step; instead, the gap of each loop is compared at random positions.
"""

import copy
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from covariant._optional import load_optional
from covariant.models.robots._assemble import geometry_of
from covariant.models.robots._description import BodyInertia, Description, Joint, Motor
from covariant.models.robots._forces import with_motors
from covariant.models.robots._loops import gap
from covariant.models.robots._mjcf import names_of
from covariant.models.robots._write_mjcf import gathered, mjcf_text
from scalargraph import evaluate_batch
from scalargraph.errors import InputError

SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Sizes of the random states and inputs; an effect that begins at some state, such as a yielding spring, shows at the
large ones."""
TOLERANCE = 1e-9
"""Largest difference of a generalised force, relative to the sum of the sizes of its terms."""
ANY_INERTIA = BodyInertia.of(
    1.0, np.array([0.1, 0.2, 0.3]), np.array([[1.0, 0.1, 0.2], [0.1, 1.1, 0.3], [0.2, 0.3, 1.2]])
)
"""Inertia of all bodies while MuJoCo compiles them, since it refuses bodies without mass and treats some others
differently."""
STEP = 1e-3
QUATERNIONS = {"floating": slice(3, 7), "ball": slice(0, 4)}
"""Slice of the position of a joint that is a unit quaternion, by kind of joint."""


class _Dynamics(NamedTuple):
    """Inertia matrix, smooth force without inertia, and the sum of the sizes of the terms of the acceleration."""

    matrix: Float[np.ndarray, "n n"]
    force: Float[np.ndarray, "n"]
    size: Float[np.ndarray, "n"]


def refuse_difference(engine: Any, robot: Description, actuated: Sequence[str] | None) -> None:
    """Raise `ValueError` if a described robot moves differently from MuJoCo's compiled model of its file."""
    mujoco = load_optional("mujoco", use="MJCF files are read with", extra="robots")
    # Unsupported motors are refused when the robot is assembled; here robots are then compared without motor forces.
    if robot.loops:
        with jax.ensure_compile_time_eval():  # the file's numbers are known even if those of the model are traced
            _refuse_other_gaps(mujoco, engine, robot)
    motors = () if actuated is not None or any(motor.unsupported for motor in robot.motors) else robot.motors
    joints = [joint for joint in robot.joints if joint.kind != "fixed"]
    if not joints:
        return
    theirs, ours = _smooth(mujoco, engine, bool(motors)), _written_back(mujoco, robot, motors)
    rng = np.random.default_rng(0)
    for scale in SCALES:
        q, v, rate, u = _random_state(rng, scale, joints, len(motors))
        file = _dynamics(mujoco, theirs, joints, q, v, rate, dict(zip((m.name for m in motors), u, strict=True)), {})
        plain = _dynamics(mujoco, ours, joints, q, v, rate, {}, _motor_forces(motors, u))
        missing = (plain.matrix - file.matrix) @ rate - (plain.force - file.force)
        relative = np.abs(missing) / np.maximum(file.size, np.finfo(float).tiny)
        worst = int(np.argmax(relative))
        if not relative[worst] <= TOLERANCE:  # NaN is refused
            raise InputError(_difference(worst, joints, plain, file))


def _refuse_other_gaps(mujoco: ModuleType, engine: Any, robot: Description) -> None:
    """Raise `ValueError` if the gap of a loop differs from the one in MuJoCo's model of the file."""
    space, data = geometry_of(robot), mujoco.MjData(engine)
    names, joints = names_of(mujoco, engine, "EQUALITY", engine.neq), names_of(mujoco, engine, "JOINT", engine.njnt)
    balls = [space.limits[first][0] for first in space.tree.balls]
    origin, rng = np.array(space.manifold.origin()), np.random.default_rng(0)
    poses = np.repeat(origin[None], len(SCALES), axis=0)
    q = poses.reshape(len(SCALES), -1)[:, 16 * space.floating + 9 * len(balls) :]
    q[:] = np.array(SCALES)[:, None] * rng.normal(size=q.shape)

    def at_pose(x):
        return [space.joint_angles(x), *(gap(space, each, x) for each in robot.loops)]

    angles, *gaps = evaluate_batch(at_pose, poses)
    for k, positions in enumerate(angles):
        data.qpos[:] = engine.qpos0
        for (name, _, _), position in zip(space.limits, positions, strict=True):
            if name not in balls:
                data.qpos[engine.jnt_qposadr[joints.index(name)]] = position
        mujoco.mj_forward(engine, data)
        for loop, open_by in zip(robot.loops, gaps, strict=True):
            i = names.index(loop.name)
            rows = (data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)) & (data.efc_id == i)
            theirs = _sizes(data.efc_pos[rows], float(engine.eq_data[i, 10]))
            ours = _sizes(open_by[k])
            if not np.allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE):
                raise InputError(
                    f"equality {loop.name!r} is open by {ours[0]:.4g} at random positions, and by {theirs[0]:.4g} in "
                    "MuJoCo; an entry of it is not supported: make it inactive, or write it with sites"
                )


def _sizes(gap: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Lengths of the distance and, for six rows, of the sine of the angle; MuJoCo has the scaled sine of its half."""
    if scale is None or len(gap) < 6:
        return np.linalg.norm(gap.reshape(-1, min(3, len(gap))), axis=1)
    half = np.linalg.norm(gap[3:]) / scale
    return np.array([np.linalg.norm(gap[:3]), 2 * half * np.sqrt(max(1 - half**2, 0.0))])


def _smooth(mujoco: ModuleType, engine: Any, actuated: bool) -> Any:
    """MuJoCo's model of the file without constraints, and without motor forces if motors are not inputs."""
    model, flags = copy.copy(engine), mujoco.mjtDisableBit
    if hasattr(model, "actuator_delay"):  # earlier versions have no delays
        model.actuator_delay[:] = 0
    model.opt.disableflags |= int(flags.mjDSBL_CONSTRAINT) | int(flags.mjDSBL_CLAMPCTRL)
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", None)  # earlier versions do not let bodies sleep
    model.opt.enableflags &= ~(0 if sleep is None else int(sleep))
    for field in ("actuator_forcelimited", "actuator_actlimited", "jnt_actfrclimited"):
        getattr(model, field)[:] = 0
    if not actuated:
        # Rotors and dampers of motors stay in effect; the flag that disables actuation would remove them.
        model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0
    return model


def _written_back(mujoco: ModuleType, robot: Description, motors: Sequence[Motor]) -> Any:
    """A plain MuJoCo model of a description, with the springs and dampers of motors at their joints."""
    robot = gathered(robot)
    joints = tuple(with_motors(joint, motors)._replace(friction=0.0, follows=None) for joint in robot.joints)
    links = robot.links | {joint.child: ANY_INERTIA for joint in robot.joints if joint.kind != "fixed"}
    text = mjcf_text(robot._replace(joints=joints, links=links, motors=(), loops=()), STEP)
    model = mujoco.MjModel.from_xml_string(text)
    for joint in robot.joints:
        if joint.kind != "fixed":
            _set_inertia(mujoco, model, model.body(joint.child).id, robot.links[joint.child])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _set_inertia(mujoco: ModuleType, model: Any, body: int, inertia: BodyInertia) -> None:
    moments, axes = np.linalg.eigh(inertia.about_centre)
    axes[:, 0] *= np.linalg.det(axes)
    model.body_mass[body], model.body_inertia[body] = inertia.mass, moments
    model.body_ipos[body] = inertia.first / inertia.mass if inertia.mass else 0.0
    mujoco.mju_mat2Quat(model.body_iquat[body], np.ascontiguousarray(axes, float).ravel())


def _random_state(
    rng: np.random.Generator, scale: float, joints: list[Joint], inputs: int
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray, np.ndarray]:
    """Position and velocity of each joint, all rates of change of the velocity, and the inputs."""
    q = [scale * rng.normal(size={"floating": 7, "ball": 4}.get(joint.kind, 1)) for joint in joints]
    for joint, position in zip(joints, q, strict=True):
        if joint.kind in QUATERNIONS:
            position[QUATERNIONS[joint.kind]] /= np.linalg.norm(position[QUATERNIONS[joint.kind]])
    v = [scale * rng.normal(size={"floating": 6, "ball": 3}.get(joint.kind, 1)) for joint in joints]
    return q, v, scale * rng.normal(size=sum(map(len, v))), scale * rng.normal(size=inputs)


def _motor_forces(motors: Sequence[Motor], u: np.ndarray) -> dict[str, np.ndarray]:
    """Generalised force of the motors at each driven joint."""
    forces = {}
    for motor, value in zip(motors, u, strict=True):
        forces[motor.joint] = forces.get(motor.joint, 0.0) + motor.gain * value * np.array(motor.direction)
    return forces


def _dynamics(
    mujoco: ModuleType,
    model: Any,
    joints: list[Joint],
    q: list[np.ndarray],
    v: list[np.ndarray],
    rate: np.ndarray,
    controls: dict[str, float],
    applied: dict[str, np.ndarray],
) -> _Dynamics:
    """Dynamics of a model at a state, for the velocities in the order of the joints."""
    data, names = mujoco.MjData(model), names_of(mujoco, model, "JOINT", model.njnt)
    dofs = []
    for joint, position, velocity in zip(joints, q, v, strict=True):
        k = names.index(joint.name)
        place, dof = int(model.jnt_qposadr[k]), int(model.jnt_dofadr[k])
        data.qpos[place : place + len(position)] = position
        data.qvel[dof : dof + len(velocity)] = velocity
        data.qfrc_applied[dof : dof + len(velocity)] = applied.get(joint.name, 0.0)
        dofs += range(dof, dof + len(velocity))
    actuators = names_of(mujoco, model, "ACTUATOR", len(model.actuator_trntype))
    address = getattr(model, "actuator_ctrladr", np.arange(model.nu))
    for name, value in controls.items():
        data.ctrl[address[actuators.index(name)]] = value
    data.time = 1.0
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    for row, unit in zip(full, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    matrix = full[np.ix_(dofs, dofs)]
    terms = (data.qfrc_bias, data.qfrc_passive, data.qfrc_actuator, data.qfrc_applied)
    size = np.abs(matrix) @ np.abs(rate) + np.sum(np.abs(terms), axis=0)[dofs]
    return _Dynamics(matrix, data.qfrc_smooth[dofs], size)


def _difference(worst: int, joints: list[Joint], plain: _Dynamics, file: _Dynamics) -> str:
    here, there = (np.linalg.lstsq(one.matrix, one.force)[0][worst] for one in (plain, file))
    units = {"floating": ["m/s²"] * 3 + ["rad/s²"] * 3, "ball": ["rad/s²"] * 3, "prismatic": ["m/s²"]}
    name, unit = [(joint.name, unit) for joint in joints for unit in units.get(joint.kind, ["rad/s²"])][worst]
    return (
        f"joint {name!r} does not move as in MuJoCo: at a random state it accelerates at {here:.4g} {unit} instead of "
        f"{there:.4g} ({abs(here - there) / max(abs(there), 1e-300):.2%} off); an entry of the file that acts on this "
        "joint is not supported: remove it, or set it to 0"
    )
