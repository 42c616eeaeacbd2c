"""Motion of a robot with servos, simulated from its commands: the prediction in a fit of servos.

The rigid body is evaluated once along the measured path, with the slope of its weight, so that the integration needs
only the servos and the friction. In each step dry friction is the impulse, up to its size, that stops the joint. So a
joint sticks exactly, and no smoothing speed is needed.

Source: Hairer, Lubich & Wanner 2003, Geometric numerical integration illustrated by the Störmer–Verlet method, Acta
Numerica 12, for leapfrog; Moreau 1988, Unilateral contact and dry friction, for friction as an impulse within a step,
solved by projected Gauss–Seidel sweeps.
"""

import functools
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import scoring
from covariant.calibration.identification._robot_torques import batched, flattened
from covariant.calibration.identification._rows import filled
from covariant.models import RobotFamily
from covariant.models.robots import Servos, dry_friction
from covariant.signals import Record

MAX_STEP = 4e-3
"""Longest step of the integration [s]: a servo's natural frequency is seldom above 60 rad/s."""
SWEEPS = 3
"""Gauss–Seidel sweeps over the joints in a step; they start from the velocity change of the step before."""
STICK_ROUNDS = 50
"""Rounds in which the friction at rest follows the torque that it carries."""
RIGID_BODY_GROUPS = ("payload", "inertia", "gravity", "offsets")
"""Groups of open numbers that change the rigid body."""
SMOOTHING_ROWS = 3.5
"""Half width, in rows, of the smoothing windows for the path of the rigid body."""


class Drive(NamedTuple):
    """Servos, motors, friction and armature of a robot: all that acts on its rigid body.

    Attributes:
        servos: The servos.
        motors: Generalised force (n, m) per unit of each input that is a torque.
        joints: Rate (k, n) of each joint with friction, per rate of each coordinate.
        viscous: Viscous friction (k,).
        coulomb: Coulomb friction (k,) of joints without a friction law.
        law: Numbers (k,) of the friction laws, by name.
        armature: Inertia (n,) of the rotors.
    """

    servos: Servos
    motors: Float[Array, "n m"]
    joints: Float[Array, "k n"]
    viscous: Float[Array, "k"]
    coulomb: Float[Array, "k"]
    law: dict[str, Float[Array, "k"]]
    armature: Float[Array, "n"]

    @classmethod
    def of(cls, model: Any) -> "Drive":
        """The drive of a robot with servos."""
        known = model.dissipation.friction.parameters
        none = jnp.zeros_like(known["damping"])
        law = known.get("law") or {
            **dict.fromkeys(("viscous", "coulomb", "stribeck", "asymmetry"), none),
            "stribeck_velocity": none + 1.0,
        }
        viscous = known["damping"] + law["viscous"]
        friction = (known["coordinates"], viscous, known["friction"], law)
        force = model.force
        return cls(force.servos, force.motors, *friction, model.space.tree.armature)


class RigidBody(NamedTuple):
    """The rigid body along a path of R rows: inertia without armature, Coriolis force, weight and its derivative."""

    inertia: Float[np.ndarray, "R n n"]
    coriolis: Float[np.ndarray, "R n"]
    slope: Float[np.ndarray, "R n"]
    bend: Float[np.ndarray, "R n n"]


class Cut(NamedTuple):
    """W windows of R rows each: initial positions and velocities, steps, inputs and the measured path.

    `inputs` (W, R, N, 5, m) has, for each of N substeps: the mean input, its derivative with respect to the delay, the
    rate of the input, the derivative of that rate with respect to the delay, and the input at the beginning.
    """

    q: Float[np.ndarray, "W n"]
    v: Float[np.ndarray, "W n"]
    step: Float[np.ndarray, "W R"]
    inputs: Float[np.ndarray, "W R N 5 m"]
    path: Float[np.ndarray, "W R n"]


def predict_servos(
    family: RobotFamily, x: Float[np.ndarray, "p"], record: Record, between: str = "held", late: float = 0.0
) -> Float[np.ndarray, "T n"]:
    """Predict the positions of a whole log from its first row and its commands alone."""
    log = ServoLog.of(family, record, between, late)
    rows = np.arange(len(log.t))[None]
    return simulate([log], [log.drive(x)], x, [rows], np.zeros((1, 0)), ())[0, 0]


def stick_bands(family: RobotFamily, x: Float[np.ndarray, "p"], record: Record) -> Float[np.ndarray, "T n"]:
    """Half the width [rad or m] of the positions at which dry friction may hold each joint, for the rows of a log.

    At rest the torque of a servo is anywhere between weight minus friction and weight plus friction, which may grow
    with that torque.
    """
    log = ServoLog.of(family, record, "held", 0.0)
    drive, slope = jax.tree.map(np.asarray, log.drive(x)), log.evaluate(x, log.q, np.zeros_like(log.q)).slope
    servos, square = drive.servos, np.sum(drive.servos.rows**2, axis=1)
    hold, size = slope @ servos.rows.T / square, np.abs(servos.rows)
    law = drive.law["coulomb"] + drive.law["stribeck"]
    dry, ends = size @ np.abs(drive.joints).T @ (drive.coulomb + law) / square, []
    for side in (1.0, -1.0):
        torque = hold
        for _ in range(STICK_ROUNDS):
            friction = dry + np.abs(servos.load_external * hold + servos.load * torque)
            torque = np.clip(hold + side * friction, -servos.limit, servos.limit)
        ends.append(torque)
    return ((ends[0] - ends[1]) / 2 / servos.stiffness + servos.dead_band) / square @ size


class ServoLog(NamedTuple):
    """A log, its smoothed motion, and the drive and rigid body of its robot as functions of the coordinates x."""

    family: RobotFamily
    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T m"]
    q: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]
    a: Float[np.ndarray, "T n"]
    between: str
    late: float
    drive: Callable[[Any], Drive]
    evaluate: Callable[..., RigidBody]

    @classmethod
    def of(cls, family: RobotFamily, record: Record, between: str, late: float) -> "ServoLog":
        model: Any = family.file.model
        t, u = np.asarray(record.t, float), np.asarray(record.u, float)
        y = scoring.unwrap(np.asarray(record.y, float), model.circles)
        half = SMOOTHING_ROWS * float(np.median(np.diff(t)))
        c = scoring.local_polynomials(t, y, t, half, 2)
        q, v, a, u = (filled(t, part) for part in (c[:, 0], c[:, 1], c[:, 2], u))
        drive, evaluate = _compiled(family)
        return cls(family, t, y, u, q, v, 2 * a, between, late, drive, evaluate)

    @property
    def substeps(self) -> int:
        """Steps of the integration between two rows; a hundredth of one more is jitter of the stamps."""
        return max(1, int(np.ceil(float(np.median(np.diff(self.t))) / MAX_STEP - 0.01)))

    def windows(self, length: float) -> list[np.ndarray]:
        """Rows of consecutive windows without gaps, of one length, each starting at a fully measured row."""
        usual = float(np.median(np.diff(self.t)))
        count = max(round(length / usual), 4)
        whole = np.asarray(np.isfinite(self.y).all(axis=1))
        at, windows = 0, []
        while at + count < len(self.t):
            if not whole[at]:
                at += 1
                continue
            rows = np.arange(at, at + count + 1)
            gap = np.flatnonzero(np.diff(self.t[rows]) > 5 * usual)
            if len(gap):
                at += int(gap[-1]) + 1
                continue
            windows.append(rows)
            at += count
        return windows

    def cut(
        self, delays: Float[np.ndarray, "m"], x: Float[np.ndarray, "p"], rows: np.ndarray, steps: Sequence[np.ndarray]
    ) -> tuple[Cut, list[RigidBody]]:
        """Windows with these rows (W, R + 1) under these delays: the rigid body at x, and its changes under steps."""
        first = rows[:, :-1]
        t = self.t[rows]
        step = np.diff(t, axis=1)
        h = step / self.substeps
        middle = t[:, :-1, None] + h[..., None] * np.arange(self.substeps)
        inputs = self.commands(middle, h[..., None], delays + self.late)
        cut = Cut(self.y[rows[:, 0]], self.v[rows[:, 0]], step, inputs, self.q[first])
        body = self.evaluate(x, self.q, self.v)
        changes = [
            RigidBody(*(b - a for a, b in zip(body, self.evaluate(x + one, self.q, self.v), strict=True)))
            for one in steps
        ]
        return cut, [RigidBody(*(part[first] for part in each)) for each in (body, *changes)]

    def commands(self, at: np.ndarray, width: np.ndarray, delays: np.ndarray) -> np.ndarray:
        """Mean inputs and rates around these times, their derivatives by the delay, and first inputs: (…, 5, m)."""
        t, u = self.t, self.u
        step = np.diff(t)[:, None]
        slope = np.diff(u, axis=0) / step
        linear = self.between == "linear"
        mean_rise = np.diff(u, axis=0) / 2 if linear else 0.0
        cumulative = np.concatenate([np.zeros_like(u[:1]), np.cumsum((u[:-1] + mean_rise) * step, axis=0)])
        own = np.arange(u.shape[1])

        def integral(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Integral of the inputs up to times s (…, m), the inputs at s, and their linear interpolation at s."""
            k = np.clip(np.searchsorted(t, s, side="right") - 1, 0, len(t) - 2)
            past = s - t[k]
            # Before the first stamp the first input acts, and after the last stamp the last but one.
            inside = np.clip(past, 0.0, step[k, 0])
            if linear:
                line = u[k, own] + slope[k, own] * inside
                return cumulative[k, own] + u[k, own] * past + slope[k, own] * inside**2 / 2, line, line
            # The rate of a held command is its difference from the command before it.
            before = u[np.maximum(k - 1, 0), own]
            line = before + (u[k, own] - before) * inside / step[k, 0]
            return cumulative[k, own] + u[k, own] * past, u[k, own], line

        ends = at[..., None] - width[..., None] / 2, at[..., None] + width[..., None] / 2
        (first, before, low), (last, after, high) = (integral(end - delays) for end in ends)
        eps = 1e-4
        lower, higher = (integral(end - delays - eps)[2] for end in ends)
        width = width[..., None]
        mean, slope, rate = (last - first) / width, -(after - before) / width, (high - low) / width
        return np.stack([mean, slope, rate, ((higher - lower) / width - rate) / eps, before], axis=-2)


def simulate(
    logs: Sequence[ServoLog],
    drives: Sequence[Drive],
    x: Float[np.ndarray, "p"],
    rows: Sequence[np.ndarray],
    weights: Float[np.ndarray, "P r"],
    steps: Sequence[Float[np.ndarray, "p"]],
    along: bool = False,
) -> Float[np.ndarray, "P W R1 n"]:
    """Positions in windows of logs of one family with these rows, (W, R + 1) in all, for each of P drives.

    Commands are delayed exactly for the first drive, and to first order for the others. The rigid body is that at x
    plus its changes under r steps of x, weighted for each drive. With `along` all drives but the first have positions
    of first order, by the derivative along the motion of the first, in which no joint sticks or slips earlier or later.
    """
    delays = np.asarray(drives[0].servos.delay)
    cuts, bodies = zip(*(log.cut(delays, x, own, steps) for log, own in zip(logs, rows, strict=True)), strict=True)
    cut, first, *changes = (
        type(parts[0])(*(np.concatenate(each) for each in zip(*parts, strict=True)))
        for parts in (cuts, *zip(*bodies, strict=True))
    )
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *drives)
    return np.asarray(_simulate(stacked, weights, delays, cut, first, tuple(changes), along))


_Compiled = tuple[Callable[[Any], Drive], Callable[..., RigidBody]]
_CACHE: dict[int, tuple[RobotFamily, _Compiled]] = {}


def _compiled(family: RobotFamily) -> _Compiled:
    """Functions of x for the drive and for the rigid body along a path, compiled once for a family."""
    if id(family) in _CACHE:
        return _CACHE[id(family)][1]
    at, robot = flattened(family)

    @jax.jit
    def along(flat: Array, q: Array, v: Array) -> tuple[Array, ...]:
        model = robot(flat)

        def one(q: Array, v: Array) -> tuple[Array, ...]:
            weight = jax.grad(model.potential)
            inertia = model.space(q) - jnp.diag(model.space.tree.armature)
            return inertia, model.space.connection_force(q, v, v), weight(q), jax.jacfwd(weight)(q)

        return jax.vmap(one)(q, v)

    rigid = [i for i, number in enumerate(family.numbers) if number.group in RIGID_BODY_GROUPS]
    kept: dict[int, tuple[bytes, RigidBody]] = {}

    def evaluate(x: np.ndarray, q: np.ndarray, v: np.ndarray) -> RigidBody:
        """The rigid body along a path, which is evaluated anew where one of its own numbers changes."""
        if id(q) not in kept:
            weakref.finalize(q, kept.pop, id(q), None)  # what is kept of a log goes with it
        if id(q) not in kept or kept[id(q)][0] != x[rigid].tobytes():
            kept[id(q)] = x[rigid].tobytes(), evaluated(x, q, v)
        return kept[id(q)][1]

    def evaluated(x: np.ndarray, q: np.ndarray, v: np.ndarray) -> RigidBody:
        flat, n = at(x), q.shape[1]

        def rows(q: np.ndarray, v: np.ndarray) -> Array:
            parts = along(flat, q, v)
            return jnp.concatenate([part.reshape(len(q), -1) for part in parts], axis=1)

        every = batched(rows, (q, v))
        inertia, coriolis, slope, bend = np.split(every, np.cumsum([n * n, n, n]), axis=1)
        return RigidBody(inertia.reshape(-1, n, n), coriolis, slope, bend.reshape(-1, n, n))

    _CACHE.clear()
    _CACHE[id(family)] = family, (lambda x: Drive.of(robot(at(x))), evaluate)
    return _CACHE[id(family)][1]


@functools.partial(jax.jit, static_argnames="along")
def _simulate(
    drives: Drive,
    weights: Float[Array, "P r"],
    delays: Float[Array, "m"],
    cut: Cut,
    body: RigidBody,
    changes: tuple[RigidBody, ...],
    along: bool,
) -> Float[Array, "P W R1 n"]:
    """Positions at all rows of all windows, for each of P drives, or to first order along the motion of the first."""

    def window(drive: Drive, weight: Array, cut: Any, body: Any, changes: Any) -> Array:
        late = drive.servos.delay - delays

        def row(state: Any, each: Any) -> Any:
            inputs, path, body, changes, h = each
            for k, change in enumerate(changes):
                body = RigidBody(*(a + weight[k] * b for a, b in zip(body, change, strict=True)))

            def substep(state: Any, inputs: Array) -> Any:
                mean, slope, rate, bend, begin = inputs
                ahead = drive.servos.lead * (rate + late * bend)
                ends = begin + ahead, begin - h * slope + ahead
                return _advance(drive, body, path, mean + late * slope + ahead, ends, h, state), None

            state = jax.lax.scan(substep, state, inputs)[0]
            return state, state[0]

        start = cut.q, cut.v, jnp.zeros_like(cut.v)
        h = cut.step / cut.inputs.shape[1]
        after = jax.lax.scan(row, start, (cut.inputs, cut.path, body, changes, h))[1]
        return jnp.concatenate([cut.q[None], after])

    over_windows = jax.vmap(window, in_axes=(None, None, 0, 0, 0))

    def motion(drive: Drive, weight: Array) -> Array:
        return over_windows(drive, weight, cut, body, changes)

    if not along:
        return jax.vmap(motion)(drives, weights)
    at = jax.tree.map(lambda each: each[0], (drives, weights))
    steps = jax.tree.map(lambda each: each[1:] - each[:1], (drives, weights))
    first = motion(*at)
    changed = jax.vmap(lambda *step: jax.jvp(motion, at, step)[1])(*steps)
    return jnp.concatenate([first[None], first[None] + changed])


def _advance(drive: Drive, body: Any, path: Array, u: Array, ends: tuple[Array, Array], h: Array, state: Any) -> Any:
    """One leapfrog step with mean inputs u and those at its ends: positions at its ends, velocities at its middle,
    damping at the mean velocity."""
    q, v, last = state
    servos = drive.servos
    weight = -body.slope - body.bend @ (q - path)
    # An estimate of the mean of old and new velocity: forces at it are accurate to second order.
    mean = v + last / 2
    torque, torque_slope = jax.jvp(lambda w: _mean_torque(servos, q, w, u, ends), (mean,), (jnp.ones_like(v),))
    # A servo drives one coordinate, at the ratio in its row: damping at the coordinate is damping times ratio².
    squared_rows = servos.rows**2
    braking = squared_rows.T @ (torque_slope / jnp.sum(servos.rows, axis=1))
    rates = drive.joints @ mean
    viscous = (drive.joints**2).T @ drive.viscous
    friction_size = jnp.abs(drive.joints).T @ (drive.coulomb + dry_friction(rates, drive.law))
    if servos.loaded:
        at_servo = (servos.rows @ weight) / jnp.sum(squared_rows, axis=1)
        friction_size = friction_size + jnp.abs(servos.rows).T @ servos.added_friction(torque, at_servo)
    asymmetry = drive.joints.T @ drive.law["asymmetry"]
    inertia = body.inertia + jnp.diag(drive.armature)
    driving = weight - body.coriolis + servos.rows.T @ torque + drive.motors @ u
    # Torque at the velocity between old v and new w: τ + braking (θ w + (1 − θ) v − mean) − viscous (θ w + (1 − θ) v).
    diagonal, damping = jnp.diagonal(inertia), viscous - braking
    share = _share_of_new(h * damping / diagonal)
    impulse = inertia @ v + h * (driving - braking * mean - (1 - share) * damping * v)
    effective_inertia = diagonal + h * share * damping
    w = v + last
    for _ in range(SWEEPS):
        for j in range(v.shape[0]):
            net_impulse = impulse[j] - (inertia[j] @ w - diagonal[j] * w[j])
            least, most = h * (asymmetry[j] - friction_size[j]), h * (asymmetry[j] + friction_size[j])
            w = w.at[j].set((net_impulse - jnp.clip(net_impulse, least, most)) / effective_inertia[j])
    return q + h * w, w, w - v


def _share_of_new(z: Array) -> Array:
    """Share of the new velocity in the mean of a step in which damping alone makes it e⁻ᶻ of the old: a half for small
    z, and more for large z, where a half would let the velocity ring (Liniger & Willoughby 1970)."""
    small = jnp.abs(z) < 1e-3
    usual = jnp.where(small, 1.0, z)
    return jnp.where(small, 0.5 + z / 12, -1 / jnp.expm1(-usual) - 1 / usual)


def _mean_torque(servos: Servos, q: Array, w: Array, u: Array, ends: tuple[Array, Array]) -> Array:
    """Torques (k,) averaged over a step in which a command may change; their limit may cut that at either end."""
    if not (servos.limited or servos.banded):
        return servos.torque(q, w, u)
    moved = ends[1] - ends[0]
    share = jnp.where(moved == 0, 1.0, (u - ends[0]) / jnp.where(moved == 0, 1.0, moved))
    of_commands = servos.commands != 0
    first, last = (servos.torque(q, w, jnp.where(of_commands.any(axis=0), each, u)) for each in ends)
    return first + share[jnp.argmax(of_commands, axis=1)] * (last - first)
