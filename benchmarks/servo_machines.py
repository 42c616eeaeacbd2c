"""Servo machines that MuJoCo moves, and what a fit and a velocity are worth on their logs.

Two machines: an arm SO-101, with the inertias of its URDF file, and a quadruped like a Go2 with its trunk held. MuJoCo
has the rigid bodies and solves dry friction; the servos are here, in NumPy, at each of its steps. Nothing of the
library's own models or simulation is used for a log, so that the numbers of a fit have an independent judge. The
numbers of the servos are drawn for each run from the ranges `SO101` and `LEGS`.

Run `COVARIANT_DATA=... python benchmarks/servo_machines.py [runs]`.
"""

import os
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

TICK = 2 * np.pi / 4096
"""Resolution of encoders and commands [rad]."""


class Servo(NamedTuple):
    """Numbers of the servos of a machine, each (n,), by the names of the tables `[servo.NAME]` of model files."""

    stiffness: np.ndarray
    damping: np.ndarray
    delay: np.ndarray
    offset: np.ndarray
    limit: np.ndarray
    armature: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray
    stribeck: np.ndarray
    stribeck_velocity: np.ndarray
    load: np.ndarray
    load_external: np.ndarray

    @classmethod
    def of(cls, n: int, **numbers: Any) -> "Servo":
        """Servos of n joints: what is not stated is zero, an infinite limit, or a Stribeck velocity of 0.1."""
        usual = {"limit": np.inf, "stribeck_velocity": 0.1}
        return cls(*(np.broadcast_to(numbers.get(key, usual.get(key, 0.0)), n).astype(float) for key in cls._fields))


class Machine(NamedTuple):
    """A machine: its URDF, the middle and the size of its motions (n,) [rad], and the place of a payload.

    Attributes:
        urdf: Text of the file.
        joints: Names of the joints, in the order of the coordinates of MuJoCo.
        middle: Middle of the motions (n,) [rad].
        size: Largest distance from it (n,) [rad].
        hand: Link with a payload, and the place of the payload in its frame [m].
        step: Step of the simulation [s].
    """

    urdf: str
    joints: tuple[str, ...]
    middle: np.ndarray
    size: np.ndarray
    hand: tuple[str, tuple[float, float, float]]
    step: float


class Log(NamedTuple):
    """A log with T rows, and what only a simulation knows.

    Attributes:
        t: Stamps (T,) [s].
        command: Commands (T, n) [rad], in ticks; each acts from its stamp and the delay of the servo on.
        q: Encoders (T, n) [rad], in ticks.
        velocity: True velocities (T, n) [rad/s].
        torque: True torques of the motors (T, n) [N m].
        external: True torques (T, n) of the payload [N m], its inertia included.
        position: True positions (T, n) [rad].
    """

    t: np.ndarray
    command: np.ndarray
    q: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    external: np.ndarray
    position: np.ndarray


SO101 = {
    "stiffness": (8.0, 25.0),
    "damping": (0.3, 1.2),
    "delay": (0.002, 0.1),
    "offset": (-0.05, 0.05),
    "limit": (1.6, 3.0),
    "armature": (0.01, 0.04),
    "viscous": (0.02, 0.1),
    "coulomb": (0.02, 0.1),
    "stribeck": (0.0, 0.05),
    "stribeck_velocity": (0.05, 0.2),
    "load": (0.05, 0.25),
}
"""Ranges of the servos of the arm; delays are drawn evenly in their logarithm."""
LEGS = {
    "stiffness": (20.0, 40.0),
    "damping": (0.5, 1.5),
    "delay": (0.002, 0.03),
    "offset": (-0.03, 0.03),
    "limit": (15.0, 24.0),
    "armature": (0.005, 0.02),
    "viscous": (0.01, 0.1),
    "coulomb": (0.1, 0.4),
    "stribeck": (0.0, 0.2),
    "stribeck_velocity": (0.05, 0.2),
    "load": (0.02, 0.12),
}
"""Ranges of the servos of the legs."""
RATES = {"so101": (50, 100, 200), "quadruped": (100, 200, 500)}
"""Rows a second, of which one is drawn."""


def so101(folder: Path) -> Machine:
    """The arm with its jaw closed: five joints from the base to the hand."""
    text = (folder / "so101.urdf").read_text(encoding="utf-8")
    text = text.replace('<joint name="gripper" type="revolute">', '<joint name="gripper" type="fixed">')
    return Machine(
        text,
        ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
        np.array([0.0, -0.3, 0.5, 0.3, 0.0]),
        np.array([0.8, 0.6, 0.6, 0.7, 0.9]),
        ("gripper_link", (-0.0079, -0.000218, -0.0981)),
        5e-4,
    )


def _link(name: str, parent: str, place, axis: str, mass: float, centre, moments) -> str:
    """A link of a URDF, and the joint that carries it."""

    def listed(numbers) -> str:
        return " ".join(map(str, numbers))

    ixx, iyy, izz = moments
    return f"""<link name="{name}"><inertial><origin xyz="{listed(centre)}"/><mass value="{mass}"/>
<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}_joint" type="revolute"><parent link="{parent}"/><child link="{name}"/>
<origin xyz="{listed(place)}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="50" velocity="50"/></joint>
"""


def quadruped(legs: int = 4) -> Machine:
    """Legs with the masses and lengths of a Go2, of three joints each, on a trunk that is held."""
    text, names = '<robot name="quadruped"><link name="base"/>\n', []
    for leg, fore, side in (("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1))[:legs]:
        hip, thigh, calf = (f"{leg}_{part}" for part in ("hip", "thigh", "calf"))
        centre, moments = (-0.0054 * fore, 0.0019 * side, -1e-4), (4.8e-4, 8.84e-4, 5.96e-4)
        text += _link(hip, "base", (0.1934 * fore, 0.0465 * side, 0), "1 0 0", 0.678, centre, moments)
        centre, moments = (-0.0037, -0.0223 * side, -0.0327), (5.84e-3, 5.8e-3, 1.03e-3)
        text += _link(thigh, hip, (0, 0.0955 * side, 0), "0 1 0", 1.152, centre, moments)
        text += _link(calf, thigh, (0, 0, -0.213), "0 1 0", 0.194, (0.0044, 0, -0.135), (1.4e-3, 1.4e-3, 4e-5))
        names += [f"{link}_joint" for link in (hip, thigh, calf)]
    middle, size = np.tile([0.0, 0.8, -1.5], legs), np.tile([0.4, 0.6, 0.7], legs)
    return Machine(text + "</robot>", tuple(names), middle, size, ("FL_calf", (0.0, 0.0, -0.213)), 2.5e-4)


def two_joints() -> Machine:
    """A shoulder that carries an elbow, both in the same plane, for tests."""
    text = '<robot name="two"><link name="base"/>\n'
    text += _link("upper", "base", (0, 0, 0), "0 1 0", 0.12, (0, 0, -0.06), (2e-4, 2e-4, 3e-5))
    text += _link("lower", "upper", (0, 0, -0.12), "0 1 0", 0.1, (0, 0, -0.05), (1.5e-4, 1.5e-4, 2e-5))
    middle, size = np.array([0.9, 0.4]), np.array([0.6, 0.8])
    names = ("upper_joint", "lower_joint")
    return Machine(text + "</robot>", names, middle, size, ("lower", (0, 0, -0.1)), 5e-4)


def draw_servo(machine: Machine, ranges: dict[str, tuple[float, float]], rng: np.random.Generator) -> Servo:
    """Servos of a machine, each number drawn from its range."""
    n = len(machine.joints)
    numbers = {key: rng.uniform(*limits, n) for key, limits in ranges.items()}
    numbers["delay"] = np.exp(rng.uniform(*np.log(ranges["delay"]), n))
    return Servo.of(n, **numbers)


def with_payload(machine: Machine, mass: float) -> str:
    """The URDF with a point mass [kg] in the hand; without one, the text of the machine."""
    if not mass:
        return machine.urdf
    link, place = machine.hand
    body = (
        f'<link name="payload"><inertial><mass value="{mass}"/>'
        '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="payload" type="fixed"><parent link="{link}"/><child link="payload"/>'
        f'<origin xyz="{" ".join(map(str, place))}"/></joint>'
    )
    return machine.urdf.replace("</robot>", body + "</robot>")


def compile_machine(machine: Machine, servo: Servo, mass: float = 0.0, step: float | None = None):
    """MuJoCo's model of a machine without servos: its bodies, rotors, and dry friction that stops within a step."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(with_payload(machine, mass))
    assert tuple(model.joint(i).name for i in range(model.njnt)) == machine.joints
    options, flags = model.opt, mujoco.mjtDisableBit
    options.timestep = step or machine.step
    options.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    options.solver, options.iterations, options.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 100, 1e-14
    options.disableflags |= int(flags.mjDSBL_LIMIT) | int(flags.mjDSBL_CONTACT)
    model.dof_armature[:], model.dof_damping[:] = servo.armature, 0
    mujoco.mj_setConst(model, mujoco.MjData(model))  # the weights of friction follow from the inertia with the rotors
    # With this time constant MuJoCo asks friction to stop a joint in one step, −v/dt; it does so as far as its bound
    # allows, and at these impedances with a creep of less than 1e-6 rad/s.
    model.dof_solref[:], model.dof_solimp[:] = (2 * options.timestep, 1), (0.9999, 0.9999, 1e-3, 0.5, 2)
    return model


class Acting(NamedTuple):
    """Commands as they act over steps of the simulation, each (count, n): one before an edge, and one after it."""

    before: np.ndarray
    after: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, command: np.ndarray, delay: np.ndarray, step: float, count: int) -> "Acting":
        """Held commands (T, n) as they act after their delays; no step, centred at its instant, has two edges."""
        ends = (np.arange(count) + 0.5) * step
        place = ends[:, None] - delay
        # Before the first command the first one holds.
        row = np.maximum(np.searchsorted(t, place, side="right") - 1, 0)
        share = np.minimum((place - t[row]) / step, 1.0)
        columns = np.arange(len(delay))
        after = command[row, columns]
        before = command[np.maximum(row - 1, 0), columns]
        inside = (share >= 0) & (share < 1) & (row > 0)
        return cls(np.where(inside, before, after), after, np.where(inside, share, 1.0))


def simulate(
    machine: Machine,
    servo: Servo,
    t: np.ndarray,
    command: np.ndarray,
    mass: float = 0.0,
    q0: np.ndarray | None = None,
    ticks: bool = True,
    step: float | None = None,
) -> Log:
    """Move a machine by commands (T, n), each held from its stamp on.

    The velocities of MuJoCo are those half a step before its positions, so that what depends on positions is of second
    order; half of a damper acts explicitly and half implicitly, which is the midpoint rule.
    """
    import mujoco

    model = compile_machine(machine, servo, mass, step)
    data, still = mujoco.MjData(model), mujoco.MjData(model)
    h, n = model.opt.timestep, len(machine.joints)
    rows = np.round((t - t[0]) / h).astype(int)
    sent = np.round(command / TICK) * TICK if ticks else command
    wanted = Acting.of(t - t[0], sent + servo.offset, servo.delay, h, rows[-1] + 2)
    edges = np.any(wanted.before != wanted.after, axis=1)
    data.qpos[:] = sent[0] if q0 is None else q0
    q, v, torques = np.empty((rows[-1] + 2, n)), np.empty((rows[-1] + 2, n)), np.empty((rows[-1] + 2, n))
    weight = np.zeros(n)
    bound, damper, applied = model.dof_frictionloss, model.dof_damping, data.qfrc_applied
    dry = bool(np.any(servo.coulomb + servo.stribeck + servo.load + servo.load_external))
    external = bool(np.any(servo.load_external))
    for k in range(len(q)):
        q[k], v[k] = data.qpos, data.qvel
        seen = np.round(q[k] / TICK) * TICK if ticks else q[k]
        # Velocities at the instant, by extrapolation, decide on what is no damper.
        now = v[k] + (v[k] - v[max(k - 1, 0)]) / 2
        spring, inner, free = _inner(servo, wanted.after[k] - seen, now)
        if edges[k]:
            # The torque, not the command, is averaged over a step in which a command begins to act: limits cut it.
            share, old = wanted.share[k], _inner(servo, wanted.before[k] - seen, now)
            both = zip((spring, inner, free), old, strict=True)
            spring, inner, free = (share * new + (1 - share) * was for new, was in both)
        torques[k] = inner
        damping = free * servo.damping + servo.viscous
        damper[:] = damping / 2
        # The passive damper takes half of the damping, and the other half is applied with the torque.
        applied[:] = spring - damping * v[k] / 2
        if dry:
            if external:
                still.qpos[:] = q[k]
                mujoco.mj_kinematics(model, still)
                mujoco.mj_comPos(model, still)
                mujoco.mj_rne(model, still, 0, weight)
            loaded = np.abs(-servo.load_external * weight - servo.load * inner)
            bound[:] = servo.coulomb + servo.stribeck * np.exp(-((now / servo.stribeck_velocity) ** 2)) + loaded
        mujoco.mj_step(model, data)
    # The mean of the velocities before and after an instant.
    middle, force = (v[rows] + v[rows + 1]) / 2, torques[rows]
    external_torque = payload_torque(machine, model, q, rows, mass) if mass else np.zeros_like(middle)
    read = np.round(q[rows] / TICK) * TICK if ticks else q[rows]
    return Log(t, sent, read, middle, force, external_torque, q[rows])


def _inner(servo: Servo, error: np.ndarray, v: np.ndarray):
    """Torque (n,) without what is a damper, the torque within its limits, and where these do not act (1 or 0)."""
    spring = servo.stiffness * error
    asked = spring - servo.damping * v
    inner = np.minimum(np.maximum(asked, -servo.limit), servo.limit)
    free = np.abs(asked) < servo.limit
    return np.where(free, spring, inner), inner, free


def payload_torque(machine: Machine, model, q: np.ndarray, rows: np.ndarray, mass: float) -> np.ndarray:
    """Torques (T, n) [N m] by which weight and inertia of the payload act on the joints."""
    import mujoco

    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    link, place = machine.hand
    body = model.body(link).id

    def point(k: int) -> np.ndarray:
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(place)

    torques, h = [], model.opt.timestep
    for k in rows:
        before, after, now = point(max(k - 1, 0)), point(k + 1), point(k)
        mujoco.mj_jac(model, data, jacobian, None, now, body)
        torques.append(jacobian.T @ (mass * (model.opt.gravity - (before - 2 * now + after) / h**2)))
    return np.array(torques)


def commands(machine: Machine, seconds: float, rate: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (T,) and commands (T, n): sines up to 3 Hz, then steps, then slow ramps."""
    t = np.arange(int(seconds * rate)) / rate
    n, third = len(machine.joints), seconds / 3
    moves = np.empty((len(t), n))
    for j in range(n):
        frequency = rng.uniform(0.1, 1.0, 6) * np.array([0.4, 0.7, 1.0, 1.5, 2.2, 3.0])
        sizes = rng.uniform(0.5, 1.0, 6) / np.maximum(frequency, 0.3)
        phases = rng.uniform(0, 2 * np.pi, 6)
        sines = (sizes * np.sin(2 * np.pi * frequency * t[:, None] + phases)).sum(axis=1)
        # Each step lasts for .6 to 1.8 s, so that the joints do not step together.
        edges = np.cumsum(rng.uniform(0.6, 1.8, int(third) + 2))
        steps = rng.uniform(-1, 1, len(edges) + 1)[np.searchsorted(edges, t - third)]
        corners = np.append(0.0, np.cumsum(rng.uniform(2.0, 4.0, int(third) + 2)))
        ramps = np.interp(t - 2 * third, corners, rng.uniform(-1, 1, len(corners)))
        moves[:, j] = np.where(t < third, sines / np.abs(sines).max(), np.where(t < 2 * third, steps, ramps))
    return t, machine.middle + machine.size * moves


def write_model(folder: Path, machine: Machine, servo: Servo) -> Path:
    """A model file of a machine with servos of these numbers, and its URDF beside it; without a payload."""
    (folder / "machine.urdf").write_text(machine.urdf, encoding="utf-8")
    lines = ['system = "robot"', "", "[parameters]", 'path = "machine.urdf"', "", "[inputs]", 'between = "held"', ""]
    lines += ["[measurement]", f"quantum = {TICK!r}", ""]
    for j, joint in enumerate(machine.joints):
        lines.append(f"[servo.{joint}]")
        lines += [f"{key} = {float(value[j])!r}" for key, value in servo._asdict().items() if np.isfinite(value[j])]
        lines.append("")
    path = folder / "machine.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def record_of(log: Log):
    """A log as the library takes it: commands as inputs, and encoders."""
    from covariant.signals import Record

    return Record(log.t, log.command, log.q)


class Numbers(NamedTuple):
    """Numbers of servos as a fit found them.

    Attributes:
        names: Names (p,) of the numbers.
        found: Their values (p,).
        error: Errors of these (p,), over their standard errors.
        determined: Whether the log determines each (p,).
        servo: The servos with these numbers.
    """

    names: tuple[str, ...]
    found: np.ndarray
    error: np.ndarray
    determined: np.ndarray
    servo: Servo

    @property
    def within(self) -> np.ndarray:
        """Whether each determined number is within four of its standard errors of the true one."""
        return np.abs(self.error[self.determined]) <= 4


def usual_servo(machine: Machine, ranges: dict[str, tuple[float, float]]) -> Servo:
    """First values for a fit: the middle of the ranges, which are as good as a data sheet, and 20 ms."""
    middle = {key: sum(limits) / 2 for key, limits in ranges.items()} | {"delay": 0.02}
    return Servo.of(len(machine.joints), **middle)


def fit_servo(folder: Path, machine: Machine, first: Servo, log: Log, true: Servo, keys: Iterable[str]) -> Numbers:
    """Fit servos to a log of commands and encoders."""
    from covariant import models
    from covariant.calibration.identification import fit_servos

    names = [f"servo.{joint}.{key}" for joint in machine.joints for key in keys]
    family = models.robot_family(str(write_model(folder, machine, first)), names)
    fit = fit_servos([family], [record_of(log)])
    found = {key: np.array(value) for key, value in first._asdict().items()}
    errors = []
    for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True):
        _, joint, key = name.split(".")
        j = machine.joints.index(joint)
        found[key][j] = value
        errors.append((value - getattr(true, key)[j]) / error)
    return Numbers(
        tuple(fit.names), np.asarray(fit.values), np.array(errors), np.asarray(fit.determined), Servo(**found)
    )


LAGS = (0.0, 0.005, 0.01, 0.02, 0.04)
"""Ages [s] of the velocity that is asked for at each row."""
SETTLED = 1.0
"""Time [s] at the start of a log that does not count."""


def model_free(t: np.ndarray, q: np.ndarray) -> dict[str, np.ndarray]:
    """Velocities (T, n) of causal filters that know no model, by name, over a grid of their numbers.

    Filtered derivatives of first to third order, steady Kalman filters of constant velocity and of constant
    acceleration, and least-squares polynomials over the last rows, at their end.
    """
    from scipy.linalg import solve_discrete_are
    from scipy.signal import cont2discrete, lfilter

    h, velocities = float(t[1] - t[0]), {}
    start = q - q[0]
    for order in (1, 2, 3):
        for w in np.geomspace(3.0, 3.0 / h, 16):
            system = ([w**order, 0.0], np.poly(np.full(order, -w)))
            numerator, denominator, _ = cont2discrete(system, h, "bilinear")
            name = f"filtered derivative, order {order}, {w:.3g} rad/s"
            velocities[name] = lfilter(numerator.ravel(), denominator, start, axis=0)
    for order in (2, 3):
        powers = np.arange(order)
        factorials = np.cumprod(np.maximum(powers, 1))
        raised = np.subtract.outer(-powers, -powers)  # column − row
        step = np.where(raised >= 0, h ** np.maximum(raised, 0) / factorials[np.maximum(raised, 0)], 0.0)
        noise = h ** np.arange(order, 0, -1) / np.cumprod(np.arange(1.0, order + 1))[::-1]
        for ratio in np.geomspace(1e-2, 1e7, 28):
            read = np.eye(order)[:1]
            spread = solve_discrete_are(
                step.T,
                read.T,
                np.outer(noise, noise) * (ratio * TICK / h**order) ** 2 * h**order + 1e-24 * np.eye(order),
                np.eye(1) * TICK**2,
            )
            gain = spread @ read.T / (spread[0, 0] + TICK**2)
            closed, state = (np.eye(order) - gain @ read) @ step, np.zeros((order, q.shape[1]))
            path = np.empty_like(q)
            for k, y in enumerate(start):
                state = closed @ state + gain * y
                path[k] = state[1]
            velocities[f"Kalman filter of order {order}, ratio {ratio:.3g}"] = path
    for degree in (1, 2, 3):
        for window in np.unique(np.round(np.geomspace(degree + 1, 60, 20)).astype(int)):
            fitted = np.linalg.pinv(np.vander(h * np.arange(0, -window, -1), degree + 1, increasing=True))[1]
            velocities[f"polynomial of degree {degree} over {window} rows"] = lfilter(fitted, 1.0, start, axis=0)
    return velocities


def lagged_errors(t: np.ndarray, velocity: np.ndarray, true: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Root mean square errors (lags, n) [rad/s] of velocities as those of `LAGS` ago, over some rows."""
    errors = []
    for lag in LAGS:
        wanted = np.stack([np.interp(t - lag, t, column) for column in true.T], axis=1)
        errors.append(np.sqrt(np.mean((velocity - wanted)[rows] ** 2, axis=0)))
    return np.array(errors)


def best_without_model(log: Log) -> tuple[np.ndarray, list[list[str]]]:
    """Errors (lags, n) of the best filters without a model, and their names.

    Each joint and lag has the filter that is best for the true velocities of the first half; the second half is judged.
    """
    first = (log.t > log.t[0] + SETTLED) & (log.t < (log.t[0] + log.t[-1]) / 2)
    second = log.t >= (log.t[0] + log.t[-1]) / 2
    tried = model_free(log.t, log.q)
    names = list(tried)
    sought = np.array([lagged_errors(log.t, v, log.velocity, first) for v in tried.values()])
    judged = np.array([lagged_errors(log.t, v, log.velocity, second) for v in tried.values()])
    best = np.argmin(sought, axis=0)
    return np.take_along_axis(judged, best[None], axis=0)[0], [[names[i] for i in row] for row in best]


class Case(NamedTuple):
    """A machine with servos drawn from their ranges, a log for the fit, and stamps and commands for judging it."""

    machine: Machine
    ranges: dict[str, tuple[float, float]]
    servo: Servo
    log: Log
    held_out: tuple[np.ndarray, np.ndarray]


def draw_case(kind: str, seed: int, seconds: float = 60.0) -> Case:
    """A machine of a kind, `so101`, `leg`, `quadruped` or `two`, and its motions."""
    rng = np.random.default_rng(seed)
    arm = kind in ("so101", "two")
    if kind == "so101":
        machine = so101(Path(os.environ["COVARIANT_DATA"]) / "so101")
    else:
        machine = two_joints() if kind == "two" else quadruped(1 if kind == "leg" else 4)
    ranges, rate = SO101 if arm else LEGS, float(rng.choice(RATES["so101" if arm else "quadruped"]))
    servo = draw_servo(machine, ranges, rng)
    log = simulate(machine, servo, *commands(machine, seconds, rate, rng))
    return Case(machine, ranges, servo, log, commands(machine, 20.0, rate, rng))


ACCELERATIONS = (0.3, 1.0, 3.0, 10.0)
"""Accelerations [rad/s²] that the model does not explain, of which the first half of a log has the best one."""


def velocity_ratio(folder: Path, case: Case, servo: Servo, mass: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n,) [rad/s] of velocities by the model, and of the best filters without one, both now, on a held-out log.

    Both are searched on the first half and judged on the second.
    """
    import covariant

    log = simulate(case.machine, case.servo, *case.held_out, mass=mass)
    half = (log.t[0] + log.t[-1]) / 2
    path, tried = str(write_model(folder, case.machine, servo)), []
    for size in ACCELERATIONS:
        velocity = covariant.estimate(path, record_of(log), overrides={"uncertainty.acceleration": size}).velocity
        first = lagged_errors(log.t, velocity, log.velocity, (log.t > SETTLED) & (log.t < half))[0]
        tried.append((float(np.sum(np.log(first))), lagged_errors(log.t, velocity, log.velocity, log.t >= half)[0]))
    return min(tried, key=lambda each: each[0])[1], best_without_model(log)[0][0]


def payload_force(folder: Path, case: Case, servo: Servo, mass: float) -> tuple[float, float]:
    """Mean force of a payload [kg] on a held-out log, over its weight, and the part of rows in the band of two errors.

    The model file states a vertical force of up to a few newtons in the hand that hardly changes, and friction of the
    joints that it does not know. The first quarter of the log, in which the filter settles, does not count.
    """
    import covariant

    log = simulate(case.machine, case.servo, *case.held_out, mass=mass)
    path, (link, place) = write_model(folder, case.machine, servo), case.machine.hand
    wrench = f'[wrench.hand]\nlink = "{link}"\nframe = "world"\nforce_std = [0.0, 0.0, 2.0]\n'
    wrench += f"time = 20.0\npoint = {list(map(float, place))}\n"
    path.write_text(path.read_text(encoding="utf-8") + wrench, encoding="utf-8")
    noise = {"acceleration": 0.3, "external_force_std": 0.05, "external_force_time": 0.3}
    overrides = {f"uncertainty.{key}": value for key, value in noise.items()}
    result = covariant.estimate(
        str(path), record_of(log), observer="intrinsic-kalman", overrides=overrides, anyway=True
    )
    settled = log.t > log.t[0] + (log.t[-1] - log.t[0]) / 4
    force, std = (np.asarray(result.columns[name])[settled] for name in ("fz_hand", "fz_hand_std"))
    weight = -9.81 * mass
    return float(force.mean() / weight), float(np.mean(np.abs(force - weight) < 2 * std))


WRITTEN_RATE = 1000.0
"""Steps a second of the MJCF file that is written after a fit."""


def open_loop_errors(folder: Path, machine: Machine, servo: Servo, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n,) [rad] of positions from the first row and the commands: by the MJCF file in MuJoCo, and by ours."""
    import mujoco

    import covariant
    from covariant import models
    from covariant.calibration.identification import predict_servos

    path = write_model(folder, machine, servo)
    covariant.export(str(path), folder / "machine.xml", rate=WRITTEN_RATE, overwrite=True)
    model = mujoco.MjModel.from_xml_path(str(folder / "machine.xml"))
    data, first = mujoco.MjData(model), log.command[0]
    for i in np.flatnonzero(model.actuator_history[:, 0]):
        mujoco.mj_initCtrlHistory(model, data, i, None, np.full(model.actuator_history[i, 0], first[i]))
    data.qpos[:] = log.q[0]
    steps = np.round((log.t - log.t[0]) / model.opt.timestep).astype(int)
    theirs = np.empty_like(log.q)
    for row, (count, command) in enumerate(zip(np.diff(steps, append=steps[-1]), log.command, strict=True)):
        theirs[row], data.ctrl[:] = data.qpos, command
        mujoco.mj_step(model, data, int(count))
    names = [f"servo.{machine.joints[0]}.stiffness"]
    ours = predict_servos(models.robot_family(str(path), names), np.zeros(1), record_of(log))
    settled = log.t > log.t[0] + SETTLED
    return tuple(np.sqrt(np.mean((q - log.q)[settled] ** 2, axis=0)) for q in (theirs, np.asarray(ours)))


def print_numbers(runs: int) -> None:
    """Print how many determined numbers are within four standard errors, and what their velocities are worth."""
    within, kinds = {}, ("so101", "leg")
    for seed in range(runs):
        kind = kinds[seed % len(kinds)]
        case, start = draw_case(kind, seed), time.process_time()
        with tempfile.TemporaryDirectory() as name:
            first = usual_servo(case.machine, case.ranges)
            numbers = fit_servo(Path(name), case.machine, first, case.log, case.servo, case.ranges)
            spent = time.process_time() - start
            ours, theirs = velocity_ratio(Path(name), case, numbers.servo)
        within.setdefault(kind, []).append(numbers.within)
        far = [
            f"{name} {error:.1f}"
            for name, error in zip(numbers.names, numbers.error, strict=True)
            if abs(error) > 4 and numbers.determined[numbers.names.index(name)]
        ]
        rate = 1 / (case.log.t[1] - case.log.t[0])
        print(
            f"{kind} {seed}: {rate:.0f} Hz, delays {np.round(1e3 * case.servo.delay, 1)} ms, {spent:.0f} s; "
            f"{numbers.within.sum()} of {len(numbers.within)} determined, {len(numbers.names)} asked; "
            f"velocity {np.round(ours / theirs, 2)} of the best without a model, {np.round(1e3 * ours, 1)} mrad/s; "
            f"beyond: {', '.join(far) or 'none'}",
            flush=True,
        )
    for kind, each in within.items():
        every = np.concatenate(each)
        whole = sum(bool(one.all()) for one in each)
        print(f"{kind}: {every.mean():.1%} of {len(every)} numbers, all of them in {whole} of {len(each)} runs")


if __name__ == "__main__":
    print_numbers(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
