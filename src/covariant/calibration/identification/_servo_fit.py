"""Numbers of a robot with servos from commands and positions: predictions over windows, by Gauss–Newton steps.

A servo holds its joint so firmly that residual accelerations say little of it: what shows is where the joint goes, and
where it stops. So positions are predicted over windows from the commands alone. The rigid body is evaluated along the
measured path, with the slope of its weight, so that only the servos and the dry friction are integrated. Dry friction is
what stops a joint within a step, at most its size: a joint sticks truly, and no speed smooths it.

Source: Hairer, Lubich & Wanner 2003, Geometric numerical integration illustrated by the Störmer–Verlet method, Acta
Numerica 12, for leapfrog; Moreau 1988, Unilateral contact and dry friction, for friction as an impulse within a step,
solved by projected Gauss–Seidel sweeps; Huber 1981 for weights; White 1982 for the sandwich by blocks.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from covariant import scoring
from covariant.calibration._least_squares import PRIOR, STD_OF_MEDIAN, block_covariance, robust
from covariant.calibration.identification._robot_fit import RobotFit, minimise_above_bounds
from covariant.calibration.identification._robot_torques import Determined, batched
from covariant.models import RobotFamily
from covariant.models.robots import Servos, dry_friction
from covariant.signals import Record

LONGEST_STEP = 4e-3
"""Longest step of the integration [s]: a servo's natural frequency is seldom above 60 rad/s."""
SWEEPS = 3
"""Sweeps over the joints in a step. Each starts from the change in the step before, which differs little."""
WINDOW = 2.0
"""Length of a window [s]: a servo forgets its start within a few tenths."""
SETTLING = 0.2
"""Time at the start of a window [s] that does not count: the initial speed is known roughly."""
FEWEST_WINDOWS = 8
SMOOTHING = 3.5
"""Half width, in rows, of the windows in which positions are smoothed for the rigid body."""
ROUNDS = 25
TOLERANCE = 3e-3
"""A step is the last one when it lowers the loss by less than this fraction of it."""
DIFFERENCE = 1e-4
"""Step of finite differences, in usual sizes: 0.01 µm of a joint's motion is far above rounding."""
LEAST_RATIO = 0.02
"""Least value of a number that must be positive, relative to its first one."""
POSITIVE = ("stiffness", "resistance", "torque_constant", "stribeck_velocity", "limit")
RIGID = ("payload", "inertia", "gravity", "offsets")
"""Groups of numbers that change the rigid body."""
DELAYS, STIFFNESSES = (0.0, 0.02, 0.04, 0.08), (0.5, 1.0, 2.0)
"""First delays [s], and factors of the first stiffness, from which the search may start."""
SHIFTS = 0.015, -0.01
"""Changes of the delay [s] from which the search starts once more."""


class Drive(NamedTuple):
    """What moves and brakes the joints of a robot.

    Attributes:
        servos: The servos.
        motors: Generalised force (n, m) of a unit of each input that is a torque.
        joints: Rate (k, n) of each joint with friction, for a unit of the rate of each coordinate.
        viscous: Viscous friction (k,).
        coulomb: Coulomb friction (k,) of joints without a law.
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
        armature = model.space.tree.armature
        return cls(
            model.force.servos, model.force.motors, known["coordinates"], viscous, known["friction"], law, armature
        )


class Body(NamedTuple):
    """The rigid body along a path of R rows: inertia without rotors, Coriolis force, weight and its slope."""

    inertia: Float[np.ndarray, "R n n"]
    coriolis: Float[np.ndarray, "R n"]
    slope: Float[np.ndarray, "R n"]
    bend: Float[np.ndarray, "R n n"]


class Cut(NamedTuple):
    """W windows of R rows each: the motion at their starts, steps, inputs and the path of the rows.

    `inputs` (W, R, N, 4, m) are the mean of each input over a substep, the derivative of that in the delay, the rate of
    the input, and its derivative.
    """

    q: Float[np.ndarray, "W n"]
    v: Float[np.ndarray, "W n"]
    step: Float[np.ndarray, "W R"]
    inputs: Float[np.ndarray, "W R N 4 m"]
    path: Float[np.ndarray, "W R n"]


def fit_servos(
    families: Sequence[RobotFamily],
    records: Sequence[Record],
    between: str = "held",
    progress: Callable[[int], object] = lambda _: None,
    length: float = WINDOW,
    late: float = 0.0,
) -> RobotFit:
    """Fit open numbers of a robot with servos to logs of commands and positions.

    Args:
        families: The robot as a function of its p open numbers, from `models.robot_family`, one for each log: settings
            that are not open, such as a gain or a known payload, may differ.
        records: The logs, with the commands as they are logged.
        between: Whether a command is "held" to the next stamp, or "linear" between stamps.
        progress: Called with the number of each round.
        length: Length of the windows [s].
        late: Time [s] by which the stamps of positions are ahead of those of the commands.

    Returns:
        Values, standard errors, and the combinations that the logs determine; `torque` are residual positions.

    Raises:
        ValueError: The logs are too short, or no prediction is finite.

    Example:
        >>> from covariant.calibration.identification import fit_servos
        >>> fit_servos([], [])
        Traceback (most recent call last):
        ValueError: give a family and a log for each of the logs
    """
    if not records or len(families) != len(records):
        raise ValueError("give a family and a log for each of the logs")
    search = _Search.of(families, records, between, length, late)
    point, rounds = search.descend(search.started(), progress, 0)
    # A delay and a lead of the command act alike but where it jumps: both sides of a fit are tried.
    for x in search.shifted(point.x):
        other, rounds = search.descend(search.point(x), progress, rounds)
        scale = search.normal(point).scale
        point = min(point, other, key=lambda each: search.loss(each, scale))
    step = search.normal(point)
    family = families[0]
    known = Determined.of(family, point.x, search.sizes, step.information, step.covariance)
    return RobotFit(
        family.names,
        family.first,
        np.asarray(family.values(point.x)),
        known.standard_errors,
        known.determined,
        known.combinations,
        step.scale,
        length / 2,
        rounds,
        point.x,
        step.losses,
    )


def predict_servos(
    family: RobotFamily, x: Float[np.ndarray, "p"], record: Record, between: str = "held", late: float = 0.0
) -> Float[np.ndarray, "T n"]:
    """Predict the positions of a whole log from its first row and its commands alone."""
    log = _Log.of(family, record, between, late)
    rows = np.arange(len(log.t))[None]
    return np.asarray(log.simulate([log.drive(x)], x, rows, np.zeros((1, 0)), ()))[0, 0]


class _Log(NamedTuple):
    """A log, its smoothed motion, and its robot as functions of the coordinates x."""

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
    evaluate: Callable[..., Body]

    @classmethod
    def of(cls, family: RobotFamily, record: Record, between: str, late: float) -> "_Log":
        model: Any = family.file.model
        t, u = np.asarray(record.t, float), np.asarray(record.u, float)
        y = scoring.unwrap(np.asarray(record.y, float), model.circles)
        half = SMOOTHING * float(np.median(np.diff(t)))
        c = scoring.local_polynomials(t, y, t, half, 2)
        for part in (c[:, 0], c[:, 1], c[:, 2]):
            for column in part.T:
                bad = ~np.isfinite(column)
                column[bad] = np.interp(t[bad], t[~bad], column[~bad])
        u = np.stack([np.interp(t, t[ok], each[ok]) for each, ok in zip(u.T, np.isfinite(u).T, strict=True)], axis=1)
        drive, evaluate = _compiled(family)
        return cls(family, t, y, u, c[:, 0], c[:, 1], 2 * c[:, 2], between, late, drive, evaluate)

    def windows(self, length: float) -> list[np.ndarray]:
        """Rows of consecutive windows of one length, each from a row that is measured, without gaps."""
        usual = float(np.median(np.diff(self.t)))
        count = max(int(round(length / usual)), 4)
        whole = np.isfinite(self.y).all(axis=1)
        at, found = 0, []
        while at + count < len(self.t):
            if not whole[at]:
                at += 1
                continue
            rows = np.arange(at, at + count + 1)
            gap = np.flatnonzero(np.diff(self.t[rows]) > 5 * usual)
            if len(gap):
                at += int(gap[-1]) + 1
                continue
            found.append(rows)
            at += count
        return found

    def simulate(
        self,
        drives: Sequence[Drive],
        x: Float[np.ndarray, "p"],
        rows: np.ndarray,
        weights: Float[np.ndarray, "P r"],
        steps: Sequence[Float[np.ndarray, "p"]],
    ) -> Float[np.ndarray, "P W R1 n"]:
        """Positions in windows with these rows (W, R + 1), for each of P drives.

        Commands act with the delays of the first drive, and to first order with those of the others. The rigid body is
        that at x, with its changes by steps (r) of x times the weights of each drive.
        """
        first = rows[:, :-1]
        t = self.t[rows]
        step = np.diff(t, axis=1)
        substeps = max(1, int(np.ceil(float(np.median(step)) / LONGEST_STEP - 1e-6)))
        h = step / substeps
        delays = np.asarray(drives[0].servos.delay)
        middle = t[:, :-1, None] + h[..., None] * np.arange(substeps)
        inputs = self._commands(middle, h[..., None], delays + self.late)
        cut = Cut(self.y[rows[:, 0]], self.v[rows[:, 0]], step, inputs, self.q[first])
        body = self.evaluate(x, self.q, self.v)
        changes = [
            Body(*(b - a for a, b in zip(body, self.evaluate(x + one, self.q, self.v), strict=True))) for one in steps
        ]
        bodies = [Body(*(part[first] for part in each)) for each in (body, *changes)]
        return np.asarray(_simulate(_stacked(drives), weights, delays, cut, bodies[0], tuple(bodies[1:]), SWEEPS))

    def _commands(self, at: np.ndarray, width: np.ndarray, delays: np.ndarray) -> np.ndarray:
        """Mean inputs and rates around times, with their derivatives in the delay: (…, 4, m)."""
        t, u = self.t, self.u
        step = np.diff(t)[:, None]
        slope = np.diff(u, axis=0) / step
        linear = self.between == "linear"
        risen = np.diff(u, axis=0) / 2 if linear else 0.0
        gathered = np.concatenate([np.zeros_like(u[:1]), np.cumsum((u[:-1] + risen) * step, axis=0)])
        own = np.arange(u.shape[1])

        def integral(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """The integral of the inputs to a time s (…, m), the inputs there, and these joined by lines."""
            k = np.clip(np.searchsorted(t, s, side="right") - 1, 0, len(t) - 2)
            past = s - t[k]
            # Before the first stamp the first input acts, and after the last one the one before it.
            inside = np.clip(past, 0.0, step[k, 0])
            line = u[k, own] + slope[k, own] * inside
            if linear:
                return gathered[k, own] + u[k, own] * past + slope[k, own] * inside**2 / 2, line, line
            return gathered[k, own] + u[k, own] * past, u[k, own], line

        ends = at[..., None] - width[..., None] / 2, at[..., None] + width[..., None] / 2
        (first, before, low), (last, after, high) = (integral(end - delays) for end in ends)
        eps = 1e-4
        lower, higher = (integral(end - delays - eps)[2] for end in ends)
        width = width[..., None]
        rate = (high - low) / width
        return np.stack(
            [(last - first) / width, -(after - before) / width, rate, ((higher - lower) / width - rate) / eps], axis=-2
        )


_Compiled = tuple[Callable[[Any], Drive], Callable[..., Body]]
_CACHE: dict[int, tuple[RobotFamily, _Compiled]] = {}


def _compiled(family: RobotFamily) -> _Compiled:
    """The drive at x, and the rigid body at x along a path; compiled once for a family."""
    if id(family) in _CACHE:
        return _CACHE[id(family)][1]
    numbers, static = eqx.partition(family.make(np.zeros(len(family.names))), eqx.is_inexact_array)
    unravel = ravel_pytree(numbers)[1]

    def arrays(x: Array) -> Array:
        return ravel_pytree(eqx.filter(family.make(x), eqx.is_inexact_array))[0]

    at = jax.jit(arrays)

    @jax.jit
    def along(flat: Array, q: Array, v: Array) -> tuple[Array, ...]:
        model: Any = eqx.combine(unravel(flat), static)

        def one(q: Array, v: Array) -> tuple[Array, ...]:
            weight = jax.grad(model.potential)
            inertia = model.space(q) - jnp.diag(model.space.tree.armature)
            return inertia, model.space.connection_force(q, v, v), weight(q), jax.jacfwd(weight)(q)

        return jax.vmap(one)(q, v)

    def evaluate(x: np.ndarray, q: np.ndarray, v: np.ndarray) -> Body:
        flat, n = at(x), q.shape[1]

        def rows(q: Array, v: Array) -> Array:
            parts = along(flat, q, v)
            return jnp.concatenate([part.reshape(len(q), -1) for part in parts], axis=1)

        every = batched(rows, (q, v))
        inertia, coriolis, slope, bend = np.split(every, np.cumsum([n * n, n, n]), axis=1)
        return Body(inertia.reshape(-1, n, n), coriolis, slope, bend.reshape(-1, n, n))

    def drive(x: Any) -> Drive:
        return Drive.of(eqx.combine(unravel(at(x)), static))

    _CACHE.clear()
    _CACHE[id(family)] = family, (drive, evaluate)
    return _CACHE[id(family)][1]


def _stacked(drives: Sequence[Drive]) -> Drive:
    return jax.tree.map(lambda *parts: jnp.stack(parts), *drives)


class _Point(NamedTuple):
    """Coordinates x (p,), residuals (B, R, n) of all windows, and their derivatives (p, B, R, n), in usual sizes."""

    x: Float[np.ndarray, "p"]
    residual: Float[np.ndarray, "B R n"]
    slopes: Float[np.ndarray, "p B R n"]


class _Normal(NamedTuple):
    """The normal equations at a point, in usual sizes, and what the logs say of the numbers."""

    matrix: Float[np.ndarray, "p p"]
    gradient: Float[np.ndarray, "p"]
    least: Float[np.ndarray, "p"]
    sizes: Float[np.ndarray, "p"]
    scale: Float[np.ndarray, "n"]
    information: Float[np.ndarray, "p p"]
    covariance: Float[np.ndarray, "p p"]
    losses: Float[np.ndarray, "B"]

    def to(self, damping: float) -> np.ndarray:
        """The step of the coordinates (p,), above the bounds."""
        damped = self.matrix + damping * np.diag(np.diagonal(self.matrix))
        step = np.clip(minimise_above_bounds(damped, self.gradient, self.least), -1.5, 1.5)
        return step * self.sizes


class _Search(NamedTuple):
    """What a fit works on."""

    logs: tuple[_Log, ...]
    rows: tuple[np.ndarray, ...]
    counts: tuple[int, ...]
    sizes: Float[np.ndarray, "p"]
    least: Float[np.ndarray, "p"]
    rigid: tuple[int, ...]

    @classmethod
    def of(
        cls, families: Sequence[RobotFamily], records: Sequence[Record], between: str, length: float, late: float
    ) -> "_Search":
        family = families[0]
        logs = tuple(_Log.of(each, record, between, late) for each, record in zip(families, records, strict=True))
        # Sixteen windows are few for a covariance by blocks, so short logs are cut into shorter ones.
        total = sum(float(log.t[-1] - log.t[0]) for log in logs)
        length = max(min(length, total / (2 * FEWEST_WINDOWS + 1)), 3 * SETTLING)
        windows = [log.windows(length) for log in logs]
        counts = tuple(len(each) for each in windows)
        if sum(counts) < FEWEST_WINDOWS:
            raise ValueError(
                f"the logs hold {sum(counts)} windows of {length:.3g} s without a gap, and a fit needs "
                f"{FEWEST_WINDOWS}; give longer logs"
            )
        # All logs have the same number of windows, so that one program serves all; copies do not count.
        most = max(counts)
        padded = [each + each[:1] * (most - len(each)) for each in windows if each]
        logs = tuple(log for log, each in zip(logs, windows, strict=True) if each)
        rows = tuple(np.stack(each) for each in padded)
        motion = [np.concatenate([getattr(log, name) for log in logs]) for name in ("q", "v", "a")]
        body = logs[0].evaluate(np.zeros(len(family.names)), motion[0], motion[1])
        armature = np.asarray(logs[0].drive(np.zeros(len(family.names))).armature)
        inertia = body.inertia + np.diag(armature)
        torque = np.einsum("tij,tj->ti", inertia, motion[2]) + body.coriolis + body.slope
        servos = logs[0].drive(np.zeros(len(family.names))).servos
        held = np.concatenate([log.u for log in logs]) @ np.asarray(servos.commands).T - motion[0] @ np.asarray(servos.rows).T
        pulled = (held - np.asarray(servos.zero)) * np.asarray(servos.stiffness) @ np.abs(np.asarray(servos.rows))
        usual = [np.maximum(np.sqrt(np.mean(part**2, axis=0)), 1e-9) for part in (torque, pulled, motion[1], motion[2])]
        sizes = family.sizes(np.maximum(usual[0], usual[1]), usual[2], usual[3])
        # A stiffness, a speed or a limit that the file states is usual by itself.
        own = np.array([number.number in POSITIVE for number in family.numbers])
        sizes = np.where(own & (np.abs(family.first) > 0), np.abs(family.first), sizes)
        least = np.where(own, np.maximum(family.least, -(1 - LEAST_RATIO) * np.abs(family.first)), family.least)
        rigid = tuple(i for i, number in enumerate(family.numbers) if number.group in RIGID)
        return cls(logs, rows, tuple(count for count in counts if count), sizes, least, rigid)

    def started(self) -> _Point:
        """The first values, or those of them with another delay or stiffness that predict better."""
        family = self.logs[0].family
        kinds = [number.number if number.group == "servo" else "" for number in family.numbers]
        late = np.array([kind == "delay" for kind in kinds])
        stiff = np.array([kind == "stiffness" for kind in kinds])
        points = []
        for delay in (None, *DELAYS) if late.any() else (None,):
            x = np.zeros(len(kinds)) if delay is None else np.where(late, delay - family.first, 0.0)
            lanes = [np.where(stiff, (factor - 1) * family.first, x) for factor in STIFFNESSES[: 3 if stiff.any() else 1]]
            lanes = [np.maximum(lane, self.least) for lane in lanes]
            # In batches of the size of a point, so that one program serves both.
            lanes = (lanes * (len(kinds) + 1))[: max(len(kinds) + 1, 1)]
            residuals = self._residuals(lanes, lanes[0], [], np.zeros((len(lanes), len(self.rigid))))
            points += [_Point(lane, each, residuals[:0]) for lane, each in zip(lanes, residuals, strict=True)]
        scale = np.array([_scale(column) for column in points[0].residual.reshape(-1, points[0].residual.shape[2]).T])
        best = min(points, key=lambda point: self.loss(point, scale))
        if not np.isfinite(self.loss(best, scale)):
            raise ValueError("the model predicts no finite motion from these commands; check units and first values")
        return self.point(best.x)

    def descend(self, point: _Point, progress: Callable[[int], object], rounds: int) -> tuple[_Point, int]:
        """The lowest point that Levenberg–Marquardt steps reach, and the number of rounds with these."""
        damping = 1e-3
        for _ in range(ROUNDS):
            progress(rounds)
            rounds += 1
            step = self.normal(point)
            before = lowered = self.loss(point, step.scale)
            while damping < 1e6:
                tried = self.point(point.x + step.to(damping))
                lowered = before - self.loss(tried, step.scale)
                if lowered > 0:
                    point, damping = tried, damping / 5
                    break
                damping = max(8 * damping, 1e-3)
            if lowered <= TOLERANCE * before:
                break
        return point, rounds

    def shifted(self, x: np.ndarray) -> list[np.ndarray]:
        """Coordinates with other delays, and with leads that make up for these."""
        family = self.logs[0].family
        at = {(n.target, n.number): i for i, n in enumerate(family.numbers) if n.group == "servo"}
        leads = [(i, at[target, "delay"], target) for (target, kind), i in at.items() if kind == "feedforward" and (target, "delay") in at]
        if not leads:
            return []
        values, servos = np.asarray(family.values(x)), self.logs[0].drive(x).servos
        stiffness = dict(zip(servos.input_names, np.asarray(servos.stiffness), strict=False))
        others = []
        for shift in SHIFTS:
            other = x.copy()
            for i, j, target in leads:
                later = max(shift, -values[j])
                other[j] += later
                other[i] += later * stiffness.get(f"cmd_{target}", np.mean(np.asarray(servos.stiffness)))
            others.append(other)
        return others

    def point(self, x: np.ndarray) -> _Point:
        """Residuals at x, and their derivatives by finite differences, all in one batch."""
        x = np.maximum(x, self.least)
        p = len(x)
        steps = DIFFERENCE * self.sizes * np.eye(p)
        weights = np.zeros((p + 1, len(self.rigid)))
        for k, i in enumerate(self.rigid):
            weights[1 + i, k] = 1.0
        every = self._residuals([x, *(x + step for step in steps)], x, [steps[i] for i in self.rigid], weights)
        return _Point(x, every[0], (every[1:] - every[:1]) / DIFFERENCE)

    def _residuals(
        self, lanes: Sequence[np.ndarray], x: np.ndarray, steps: Sequence[np.ndarray], weights: np.ndarray
    ) -> np.ndarray:
        """Residuals (P, B, R, n) of drives at P coordinates, with the rigid body at x and its changes."""
        parts = []
        for log, rows, count in zip(self.logs, self.rows, self.counts, strict=True):
            chosen = steps if len(steps) == weights.shape[1] else [np.zeros_like(x)] * weights.shape[1]
            q = log.simulate([log.drive(lane) for lane in lanes], x, rows, weights, chosen)
            parts.append((q - log.y[rows])[:, :count, self._skipped(log) :])
        return np.concatenate(parts, axis=1)

    @staticmethod
    def _skipped(log: _Log) -> int:
        return max(int(SETTLING / np.median(np.diff(log.t))), 1)

    def loss(self, point: _Point, scale: np.ndarray) -> float:
        e = np.nan_to_num(point.residual / scale, nan=np.inf)
        e = np.where(np.isfinite(self._measured), e, 0.0)
        if not np.isfinite(e).all():
            return np.inf
        return float(np.sum(robust(e)[0])) / self._alike + float(np.sum((point.x / self.sizes / PRIOR) ** 2) / 2)

    @property
    def _measured(self) -> np.ndarray:
        return np.concatenate(
            [
                log.y[rows[:count]][:, self._skipped(log) :]
                for log, rows, count in zip(self.logs, self.rows, self.counts, strict=True)
            ]
        )

    @property
    def _alike(self) -> float:
        """Number of rows that are one independent error: those of a tenth of a window."""
        return max(1.0, self._measured.shape[1] / 10)

    def normal(self, point: _Point) -> _Normal:
        """The normal equations at a point."""
        measured = np.isfinite(self._measured)
        residual = np.where(measured, point.residual, 0.0)
        n = residual.shape[2]
        scale = np.array([_scale(residual[..., j][measured[..., j]]) for j in range(n)])
        e = residual / scale
        loss, weight = robust(e)
        z = np.where(measured, point.slopes, 0.0) / scale
        z = np.where(np.isfinite(z), z, 0.0)
        share = 1 / self._alike
        flat = z.reshape(len(z), -1)
        information, curvature = (share * (flat * w.ravel()) @ flat.T for w in (weight, weight**3))
        scores = share * np.einsum("pbkj,bkj->bp", z, weight * e, optimize=True)
        prior = np.eye(len(z)) / PRIOR**2
        gradient = scores.sum(axis=0) + prior @ (point.x / self.sizes)
        covariance = block_covariance(scores, curvature, np.linalg.inv(curvature + prior), prior)
        outer = np.outer(self.sizes, self.sizes)
        losses = share * np.sum((loss + np.log(scale)) * measured, axis=(1, 2))
        least = (self.least - point.x) / self.sizes
        return _Normal(
            information + prior, gradient, least, self.sizes, scale, curvature / outer, covariance * outer, losses
        )


def _scale(values: np.ndarray) -> float:
    """Robust standard deviation; 1 where there is nothing."""
    values = values[np.isfinite(values)]
    return float(max(STD_OF_MEDIAN * np.median(np.abs(values)), 1e-9)) if len(values) else 1.0


@functools.partial(jax.jit, static_argnums=6)
def _simulate(
    drives: Drive,
    weights: Float[Array, "P r"],
    delays: Float[Array, "m"],
    cut: Cut,
    body: Body,
    changes: tuple[Body, ...],
    sweeps: int,
) -> Float[Array, "P W R1 n"]:
    """Positions at all rows of all windows, for each of P drives."""

    def window(drive: Drive, weight: Array, cut: Any, body: Any, changes: Any) -> Array:
        late = drive.servos.delay - delays

        def row(state: Any, each: Any) -> Any:
            inputs, path, body, changes, h = each
            for k, change in enumerate(changes):
                body = Body(*(a + weight[k] * b for a, b in zip(body, change, strict=True)))

            def substep(state: Any, inputs: Array) -> Any:
                mean, slope, rate, bend = inputs
                u = mean + late * slope + drive.servos.lead * (rate + late * bend)
                return _advance(drive, body, path, u, h, state, sweeps), None

            state = jax.lax.scan(substep, state, inputs)[0]
            return state, state[0]

        start = cut.q, cut.v, jnp.zeros_like(cut.v)
        h = cut.step / cut.inputs.shape[1]
        after = jax.lax.scan(row, start, (cut.inputs, cut.path, body, changes, h))[1]
        return jnp.concatenate([cut.q[None], after])

    over_windows = jax.vmap(window, in_axes=(None, None, 0, 0, 0))
    return jax.vmap(over_windows, in_axes=(0, 0, None, None, None))(drives, weights, cut, body, changes)


def _advance(drive: Drive, body: Any, path: Array, u: Array, h: Array, state: Any, sweeps: int) -> Any:
    """One leapfrog step: positions at its ends, velocities in its middle, damping at the mean velocity."""
    q, v, last = state
    servos = drive.servos
    weight = -body.slope - body.bend @ (q - path)
    # The velocity in the middle of the two: what depends on it is then known to second order.
    mean = v + last / 2
    torque, slope = jax.jvp(lambda w: servos.torque(q, w, u), (mean,), (jnp.ones_like(v),))
    # The rate of a servo is its row times that of its one coordinate, so its slope in that is the row's square.
    squares = servos.rows**2
    braking = squares.T @ (slope / jnp.sum(servos.rows, axis=1))
    rates = drive.joints @ mean
    viscous = (drive.joints**2).T @ drive.viscous
    size = jnp.abs(drive.joints).T @ (drive.coulomb + dry_friction(rates, drive.law))
    if servos.loaded:
        at_servo = (servos.rows @ weight) / jnp.sum(squares, axis=1)
        size = size + jnp.abs(servos.rows).T @ servos.added_friction(torque, at_servo)
    aside = drive.joints.T @ drive.law["asymmetry"]
    inertia = body.inertia + jnp.diag(drive.armature)
    driving = weight - body.coriolis + servos.rows.T @ torque + drive.motors @ u
    # Torque at the mean of both velocities: τ + braking ((w + v)/2 − mean) − viscous (w + v)/2.
    impulse = inertia @ v + h * (driving - braking * mean) + h / 2 * (braking - viscous) * v
    diagonal = jnp.diagonal(inertia)
    whole = diagonal + h / 2 * (viscous - braking)
    w = v + last
    for _ in range(sweeps):
        for j in range(v.shape[0]):
            pushed = impulse[j] - (inertia[j] @ w - diagonal[j] * w[j])
            stopped = jnp.clip(pushed, -h * (size[j] - aside[j]), h * (size[j] + aside[j]))
            w = w.at[j].set((pushed - stopped) / whole[j])
    return q + h * w, w, w - v
