"""Forces and accelerations of a robot against MuJoCo's, so that no entry of an MJCF file is dropped unseen.

At random configurations, velocities, accelerations and inputs both need the same generalised force: an entry that one
of them does not know shows at the joint on which it acts. Contacts, limits, loops and dry friction are constraints in
MuJoCo, and none of them acts here; loops are refused where the file is read.
"""

import copy
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._optional import load_optional
from covariant.geometry.lie import SO3
from covariant.lowering import evaluate_batch
from covariant.models._mechanical import MechanicalSystem, applied_force, resistance
from covariant.models.robots._assemble import build, computed_now, without_what_stands_still
from covariant.models.robots._axes import Axis, bodies_of, freedom_of
from covariant.models.robots._description import Description
from covariant.models.robots._mjcf import names_of

SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Sizes of the random states and inputs; what acts from some state on, like a spring that yields, shows at the large
ones."""
TOLERANCE = 1e-9
"""Largest difference of a generalised force, relative to the sum of the sizes of its terms."""

_agreeing: set[str] = set()
"""Digests of the compiled models, with their locked and actuated joints, that agree with MuJoCo."""


class _States(NamedTuple):
    """Random states of a robot, each part with the number of the state as the first axis."""

    pose: Float[np.ndarray, "s 4 4"]
    turns: Float[np.ndarray, "s b 3 3"]
    q: Float[np.ndarray, "s n"]
    v: Float[np.ndarray, "s k"]
    rate: Float[np.ndarray, "s k"]
    u: Float[np.ndarray, "s m"]


def refuse_difference(
    engine: Any, robot: Description, lock: Mapping[str, float], actuated: Sequence[str] | None
) -> None:
    """Raise `ValueError` where the motion of a described robot is not that of MuJoCo's compiled model of its file."""
    mujoco = load_optional("mujoco", use="MJCF files are read with", extra="robots")
    buffer = np.zeros(mujoco.mj_sizeModel(engine), np.uint8)
    mujoco.mj_saveModel(engine, None, buffer)
    key = hashlib.sha256(buffer.tobytes() + repr((sorted(lock.items()), actuated)).encode()).hexdigest()
    if key in _agreeing:
        return
    # In MuJoCo dry friction is a constraint, and all constraints are off.
    robot = robot._replace(joints=tuple(joint._replace(friction=0.0) for joint in robot.joints))
    moving, free_joint, locked = without_what_stands_still(robot, dict(lock))
    axes = bodies_of(moving, locked)[0]
    if axes or free_joint:
        with computed_now():
            model, _ = build(robot, False, dict(lock), actuated, {})
            _compare(model, _Engine(mujoco, engine, robot, axes, locked, actuated))
    _agreeing.add(key)


class _Engine:
    """MuJoCo's model of a robot, in the velocities of the robot here."""

    def __init__(
        self,
        mujoco: Any,
        engine: Any,
        robot: Description,
        axes: list[Axis],
        locked: Mapping[str, float],
        actuated: Sequence[str] | None,
    ):
        self.mujoco, self.model = mujoco, copy.copy(engine)
        self.axes, self.freedom = axes, freedom_of(axes)
        names = names_of(mujoco, engine, "JOINT", engine.njnt)
        place = {name: int(engine.jnt_qposadr[i]) for i, name in enumerate(names)}
        dof = {name: int(engine.jnt_dofadr[i]) for i, name in enumerate(names)}
        self.free_joint = next((j.name for j in robot.joints if j.kind == "floating" and j.name not in locked), None)
        self.base = None if self.free_joint is None else (place[self.free_joint], dof[self.free_joint])
        self.places = [place[axis.joint.name] for axis in axes]
        # The three axes of a ball joint follow one another.
        self.dofs = [dof[axis.joint.name] + ("xyz".index(axis.name[-1]) if axis.ball else 0) for axis in axes]
        self.rest = np.array(engine.qpos0)
        for name, value in locked.items():
            if name in place and engine.jnt_type[names.index(name)] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
                self.rest[place[name]] = value
        self._leave_out_constraints()
        self._choose_inputs(robot, actuated)

    def _leave_out_constraints(self) -> None:
        model, flags = self.model, self.mujoco.mjtDisableBit
        model.opt.disableflags |= int(flags.mjDSBL_CONSTRAINT) | int(flags.mjDSBL_CLAMPCTRL)
        model.opt.enableflags = 0  # above all, nothing sleeps
        for field in ("actuator_forcelimited", "actuator_actlimited", "jnt_actfrclimited"):
            getattr(model, field)[:] = 0

    def _choose_inputs(self, robot: Description, actuated: Sequence[str] | None) -> None:
        """The inputs are those of the motors, or forces at the joints where these are named or there are no motors."""
        model, names = self.model, [axis.joint.name for axis in self.axes]
        self.controls, self.driven = [], []
        if actuated is None and robot.motors:
            actuators = names_of(self.mujoco, model, "ACTUATOR", len(model.actuator_trntype))
            address = getattr(model, "actuator_ctrladr", np.arange(model.nu))
            self.controls = [int(address[actuators.index(m.name)]) for m in robot.motors if m.joint in names]
        else:
            model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0
            moving = self.freedom.moving
            self.driven = [self.dofs[i] for i in moving if actuated is None or names[i] in actuated]

    @property
    def joints(self) -> list[tuple[str, str]]:
        """Joint and unit of the acceleration of each component of the velocity."""
        base = [(self.free_joint or "", unit) for unit in ("m/s²",) * 3 + ("rad/s²",) * 3] if self.base else []
        turns = [(self.axes[i].joint.name, bool(self.axes[i].turn.any())) for i in self.freedom.moving]
        return base + [(name, "rad/s²" if turn else "m/s²") for name, turn in turns]

    def random_states(self, inputs: int) -> tuple[np.ndarray, _States]:
        """Configurations and states, the same ones for the same robot."""
        rng, s, b = np.random.default_rng(0), len(SCALES), len(self.freedom.balls) // 3
        n = len(self.freedom.free)
        sizes = np.array(SCALES)[:, None]
        turns = np.array([[SO3.exp(jnp.asarray(w)) for w in each] for each in rng.normal(size=(s, b + 1, 3))])
        pose = np.tile(np.eye(4), (s, 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = turns[:, 0], sizes * rng.normal(size=(s, 3))
        q = sizes * rng.normal(size=(s, n))
        v, rate = (sizes * rng.normal(size=(s, 6 * bool(self.base) + 3 * b + n)) for _ in range(2))
        states = _States(pose, turns[:, 1:], q, v, rate, sizes * rng.normal(size=(s, inputs)))
        parts = [pose.reshape(s, -1)] * bool(self.base) + [states.turns.reshape(s, -1), q]
        return np.concatenate(parts, axis=1), states

    def dynamics(self, states: _States, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inertia matrix (n, n), force (n,), and the sum of the sizes of all terms of the force that the rate needs.

        They belong to the state with number k. The Jacobian takes the velocity here to that of MuJoCo.
        """
        mujoco, model, data = self.mujoco, self.model, self.mujoco.MjData(self.model)
        base, balls = 6 * bool(self.base), len(self.freedom.balls)
        jacobian, bent = np.zeros((model.nv, len(states.v[k]))), np.zeros(model.nv)
        jacobian[self.dofs, base:] = self.freedom.matrix
        angles = self.freedom.matrix[:, balls:] @ states.q[k] + self.freedom.offset
        data.qpos[:] = self.rest
        for i, (axis, place) in enumerate(zip(self.axes, self.places, strict=True)):
            if not axis.ball:
                data.qpos[place] = angles[i]
        for ball, i in enumerate(self.freedom.balls[::3]):
            self._set_quaternion(data, self.places[i], states.turns[k, ball])
        if self.base:
            place, dof = self.base
            rotation = states.pose[k, :3, :3]
            data.qpos[place : place + 3] = states.pose[k, :3, 3]
            self._set_quaternion(data, place + 3, rotation)
            jacobian[dof : dof + 3, :3], jacobian[dof + 3 : dof + 6, 3:6] = rotation, np.eye(3)
            # MuJoCo has the velocity of the base in the world, and its components here turn with the base.
            bent[dof : dof + 3] = rotation @ np.cross(states.v[k, 3:6], states.v[k, :3])
        data.qvel[:] = jacobian @ states.v[k]
        if self.controls:
            data.ctrl[self.controls] = states.u[k]
        data.qfrc_applied[self.driven] = states.u[k, : len(self.driven)]
        data.time = 1.0
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for row, unit in zip(full, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        force = jacobian.T @ (data.qfrc_smooth - full @ bent)
        terms = (data.qfrc_bias, data.qfrc_passive, data.qfrc_actuator, data.qfrc_applied)
        size = np.abs(full) @ np.abs(jacobian @ states.rate[k] + bent) + sum(map(np.abs, terms))
        return jacobian.T @ full @ jacobian, force, np.abs(jacobian).T @ size

    def _set_quaternion(self, data: Any, place: int, rotation: np.ndarray) -> None:
        self.mujoco.mju_mat2Quat(data.qpos[place : place + 4], rotation.ravel())


def _compare(model: MechanicalSystem, engine: _Engine) -> None:
    x, states = engine.random_states(model.inputs or 0)
    x = x.reshape(len(x), *model.manifold.origin().shape)

    def dynamics(x, v, u):
        t = jnp.zeros(())
        force = applied_force(model, t, x, u) + resistance(model, t, x, v, u)
        return model.space(x), force - model.space.connection_force(x, v, v)

    ours = evaluate_batch(dynamics, x, states.v, states.u)
    for k in range(len(SCALES)):
        matrix, force = (np.asarray(part[k]) for part in ours)
        their_matrix, their_force, size = engine.dynamics(states, k)
        missing = (matrix - their_matrix) @ states.rate[k] - (force - their_force)
        relative = np.abs(missing) / np.maximum(size, np.finfo(float).tiny)
        worst = int(np.argmax(relative))
        if not relative[worst] <= TOLERANCE:  # NaN is refused
            here, there = (np.linalg.lstsq(m, f)[0][worst] for m, f in ((matrix, force), (their_matrix, their_force)))
            name, unit = engine.joints[worst]
            raise ValueError(
                f"joint {name!r} does not move as in MuJoCo: at a random state it accelerates at {here:.4g} {unit} "
                f"instead of {there:.4g} ({abs(here - there) / max(abs(there), 1e-300):.2%} off); an entry of the file "
                "that acts on this joint is not supported: remove it, or set it to 0"
            )
