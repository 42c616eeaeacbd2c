"""Command errors of servos, and the part of them that no parameters of a servo explain.

The torque of a servo is proportional to its command error until it reaches its limit. Divided by the stiffness, the
equation of motion states this error as a sum: multiples of the rate, of rotor, inertial torque, dry friction and
weight, and a constant. These multiples and the delay are fitted, so that wrong first guesses of parameters do not count
as a fault of the log. At rest, dry friction takes any value up to its size, here the rest that the other terms leave.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case, averaged
from covariant.calibration.diagnosis._smooth import Smooth, held_inputs, smooth
from covariant.calibration.diagnosis._suspicion import BLOCKS, HELD_OUT, Unexplained, blocks_of
from covariant.geometry import differential
from covariant.models import MechanicalSystem
from scalargraph import on_batches

FIRST_DELAYS = (0.0, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1)
"""Delays [s] of a command that are tried first."""
LIMIT_LEVELS = (0.3, 0.5, 0.7, 0.85, 0.95)
"""Clipping levels of the error, relative to its largest value, that are tried for a servo with a limit."""
MAX_LIMITED = 0.6
"""Largest fraction of points at which a servo may be at its limit."""
DAMPING_FRACTIONS, LIMIT_FACTORS = np.array([0.5, 1.0]), (0.85, 0.93, 1.0, 1.07, 1.15)
"""Fractions of the damping that the limit may clip, and factors by which a limit is refined."""
RATE_INDEX = 2
"""Index of the rate among the explanations of an error."""
REFINEMENTS, DELAY_DIFFERENCE = 3, 1e-3
"""Steps that refine the best delay or limit, and shift [s] of the finite difference for the slope in the delay."""
MAX_POINTS = 2000
"""Largest number of points of the grid in a fit."""
STICKING_SPEED = 0.1
"""Speed, relative to the RMS speed, below which a joint may stick."""
MAX_WEIGHT_ERROR, MAX_SLOPE_ERROR = 10.0, 0.5
"""Largest error due to the weight, relative to the motion, and largest one due to a weight in another direction than
the model states: larger ones would explain wrong units and signs."""
RIDGE = 1e-6
"""Ridge weight of the multiples relative to the errors, for multiples that a log does not determine."""
MIN_WEIGHT_CHANGE = 0.02
"""Change of the weight on a joint, relative to the largest weight on any joint, up to which it counts as constant."""
ROUNDS = 4
"""Rounds of alternating between friction at rest and the other multiples."""
MIN_RANGE = 6.0
"""Least range of the positions of a joint that moves, in multiples of the noise or tick of its encoder."""


class JointServos(NamedTuple):
    """The k servos of a model, as arrays that the diagnosis needs.

    Attributes:
        joint: Index of the coordinate (k,) of each servo.
        gear: Position of the servo (k,) per unit of its coordinate.
        zero: Position (k,) where the coordinate is zero, minus the offset of the servo.
        column: Column of the inputs (k,) that commands each servo.
        factors: Columns of the inputs that multiply the torque, switch and voltage, with their nominal values.
        stiffness: Stiffness (k,) that the model states.
        limited: Whether the model states a limit (k,) of its torque.
        circle: Whether the position (k,) is an angle on a full circle.
        delay: Delay (m,) of each input [s], as the model states it.
    """

    joint: np.ndarray
    gear: Float[np.ndarray, "k"]
    zero: Float[np.ndarray, "k"]
    column: np.ndarray
    factors: tuple[tuple[tuple[int, float], ...], ...]
    stiffness: Float[np.ndarray, "k"]
    limited: Bool[np.ndarray, "k"]
    circle: Bool[np.ndarray, "k"]
    delay: Float[np.ndarray, "m"]

    @classmethod
    def of(cls, case: Case) -> "JointServos":
        """The servos of the model of a case."""
        servos = case.model.force.servos  # pyright: ignore[reportFunctionMemberAccess]
        rows, commands = np.asarray(servos.rows), np.asarray(servos.commands)
        joint = np.argmax(np.abs(rows), axis=1)
        return cls(
            joint,
            rows[np.arange(len(rows)), joint],
            np.asarray(servos.zero) - np.asarray(servos.offset),
            np.argmax(np.abs(commands), axis=1),
            tuple(
                tuple((place, usual) for place, usual in ((switch, 1.0), (volts, float(supply))) if place >= 0)
                for switch, volts, supply in zip(servos.switches, servos.volts, np.asarray(servos.supply), strict=True)
            ),
            np.asarray(servos.stiffness),
            np.isfinite(np.asarray(servos.limit)),
            np.asarray(servos.circles),
            np.broadcast_to(np.asarray(case.file.input_delay, float), commands.shape[1]),
        )


class Prepared(NamedTuple):
    """The smoothed positions of a case, and the possible explanations of the errors of each servo.

    Attributes:
        log: Smoothed positions on the grid.
        position: Positions (K, k) of the servos.
        rate: Rates (K, k).
        columns: Explanations (k, K, p), averaged as the accelerations are: rotor, inertial torque, rate, 1, weight, and
            the derivatives of the weight.
        least, most: Bounds (k, p) of the multiples of these.
        moves: Points (K, k) at which the joint moves.
        weighs: Whether the weight on a servo (k,) changes.
        known: Whether a servo (k,) moves enough to be judged.
        rows: Indices (J,) of the points of the grid that are used.
        blocks: Block (J,) of each of these points.
        noise: Variance (k,) of an error due to the noise or ticks of the encoder.
    """

    log: Smooth
    position: Float[np.ndarray, "K k"]
    rate: Float[np.ndarray, "K k"]
    columns: Float[np.ndarray, "k K p"]
    least: Float[np.ndarray, "k p"]
    most: Float[np.ndarray, "k p"]
    moves: Bool[np.ndarray, "K k"]
    weighs: Bool[np.ndarray, "k"]
    known: Bool[np.ndarray, "k"]
    rows: np.ndarray
    blocks: np.ndarray
    noise: Float[np.ndarray, "k"]


class ServoFit(NamedTuple):
    """The parameters of one servo that explain its errors best.

    Attributes:
        left: Averaged error (J,) that is left unexplained at the points that are used [rad].
        error: Error (K,) that acts, not averaged.
        explained: Explained part (K,) of it, averaged.
        multiples: Multiples (p,) of the explanations.
        friction: Dry friction divided by the stiffness [rad].
        delay: Delay of the command [s].
        size: Variance of the error without a delay, to which errors are relative.
        level: Error at which the torque reaches its limit; infinite without a limit.
    """

    left: Float[np.ndarray, "J"]
    error: Float[np.ndarray, "K"]
    explained: Float[np.ndarray, "K"]
    multiples: Float[np.ndarray, "p"]
    friction: float
    delay: float
    size: float
    level: float


class CommandErrors:
    """Function from a case to the part of its command errors that no parameters of its servos explain.

    It caches results by positions and by commands, since most suspicions change one column.
    """

    def __init__(self) -> None:
        self._prepared: dict[int, tuple[np.ndarray, Prepared]] = {}
        self._fits: dict[tuple, ServoFit] = {}

    def __call__(self, case: Case) -> Unexplained | None:
        return self.of(None, case)

    def of(self, servo: int | None, case: Case) -> Unexplained | None:
        """The unexplained part for all servos that move, or for one of them."""
        prepared = self.prepared(case)
        if len(prepared.rows) < 2 * BLOCKS or not prepared.known.any():
            return None
        known = prepared.known if servo is None else np.arange(len(prepared.known)) == servo
        fits = [self.fit(case, i) for i in range(len(prepared.known))]
        blocks = [[np.mean(fit.left[prepared.blocks == b] ** 2) / fit.size for fit in fits] for b in range(BLOCKS)]
        noise = prepared.noise / np.array([fit.size for fit in fits])
        return Unexplained(np.array(blocks), noise, known, independent_parts(prepared.position[prepared.rows]))

    def prepared(self, case: Case) -> Prepared:
        """Smoothed positions and explanations of a case, cached by its positions."""
        y = case.record.y
        if id(y) not in self._prepared:
            self._prepared[id(y)] = y, _prepare(case)  # pyright: ignore[reportArgumentType]
        return self._prepared[id(y)][1]

    def fit(self, case: Case, i: int) -> ServoFit:
        """The best fit of servo i, cached by positions and inputs."""
        prepared, servos, u = self.prepared(case), JointServos.of(case), np.asarray(case.record.u)
        places = [servos.column[i], *(place for place, _ in servos.factors[i])]
        key = (id(prepared), i, bool(servos.limited[i]), u[:, places].tobytes())
        if key not in self._fits:
            self._fits[key] = fit_servo(case, prepared, servos, i)
        return self._fits[key]


def errors(case: Case, prepared: Prepared, servos: JointServos, i: int, delay: float) -> Float[np.ndarray, "K"]:
    """Command error (K,) of servo i under this delay, not clipped by a limit."""
    log, t, u = prepared.log, np.asarray(case.record.t), np.asarray(case.record.u)
    command = held_inputs(t + delay, u[:, [servos.column[i]]], log.t, log.step)[:, 0]
    error = command - prepared.position[:, i]
    if servos.circle[i]:
        error = error - 2 * np.pi * np.round(error / (2 * np.pi))
    for place, usual in servos.factors[i]:
        error = error * held_inputs(t + delay, u[:, [place]], log.t, log.step)[:, 0] / usual
    return error


def _prepare(case: Case) -> Prepared:
    servos = JointServos.of(case)
    record = case.record._replace(u=np.zeros((len(case.record.t), 0)))
    delay = np.asarray(case.file.delay, float)
    log = smooth(record, case.file.reference_half, case.model.circles, delay, case.ticks)
    motion, weight, slopes = _rigid(case.model, log.q.shape[1])(log.q, log.v, log.a)
    columns, least, most, weighs = [], [], [], []
    for j, gear in zip(servos.joint, servos.gear, strict=True):
        v = gear * log.v[:, j]
        weights = np.column_stack([weight[:, j], slopes[:, j]])
        shown = np.ptp(weights, axis=0) > 1e-9 * max(np.abs(weight).max(), 1e-300)
        weights = weights[:, shown]
        weighs.append(bool(np.std(weight[:, j]) > MIN_WEIGHT_CHANGE * np.abs(weight).max()))
        free = [v, np.ones_like(v), *weights.T]
        smoothed = averaged(log, np.column_stack([motion[:, j], *free]))
        part = np.column_stack([log.a[:, j] * gear, smoothed])
        range_of = np.std(log.q[log.used, j]) if log.used.any() else 1.0
        bound = MAX_SLOPE_ERROR * range_of / np.maximum(np.std(weights, axis=0), 1e-300)
        least.append([0.0, 0.0, -np.inf, -np.inf, *-bound])
        bound = np.where(shown[0] & (np.arange(len(bound)) == 0), MAX_WEIGHT_ERROR / MAX_SLOPE_ERROR, 1.0) * bound
        most.append([np.inf, np.inf, np.inf, np.inf, *bound])
        columns.append(part)
    # Explanations of a weight that does not change are zero, and their multiples are free between −1 and 1.
    width = max(part.shape[1] for part in columns)
    columns = np.array([np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in columns])
    least = np.array([np.pad(part, (0, width - len(part)), constant_values=-1.0) for part in least])
    most = np.array([np.pad(part, (0, width - len(part)), constant_values=1.0) for part in most])
    rate = log.v[:, servos.joint] * servos.gear
    position = log.q[:, servos.joint] * servos.gear + servos.zero
    usual = np.sqrt(np.mean(rate[log.used] ** 2, axis=0)) if log.used.any() else np.ones(len(servos.joint))
    # A change by one tick within the smoothing window is not motion.
    least_rate = np.maximum(STICKING_SPEED * usual, case.ticks[servos.joint] * np.abs(servos.gear) / log.half / 2)
    moves = np.abs(rate) > least_rate
    used = np.flatnonzero(log.used)
    rows = used[:: max(1, -(-len(used) // MAX_POINTS))]
    resolved = np.maximum(log.noise, case.ticks)[servos.joint] * np.abs(servos.gear)
    known = np.ptp(position[used], axis=0) > MIN_RANGE * resolved if len(used) else np.zeros(len(resolved), bool)
    std = np.maximum(np.where(case.ticks > 0, case.ticks / np.sqrt(12), log.noise)[servos.joint] * servos.gear, 1e-12)
    return Prepared(
        log, position, rate, columns, least, most, moves, np.array(weighs), known, rows, blocks_of(len(rows)), std**2
    )


def independent_parts(position: Float[np.ndarray, "J k"]) -> Float[np.ndarray, "k"]:
    """Number of independent parts of motions: their length over the sum of the autocorrelation up to its first zero.

    Source: Sokal 1997, Monte Carlo methods in statistical mechanics, §3.
    """
    count, off = len(position), position - position.mean(axis=0)
    products = np.fft.irfft(np.abs(np.fft.rfft(off, 2 * count, axis=0)) ** 2, axis=0)[:count]
    positive = np.logical_and.accumulate(products > 0, axis=0)
    return count * products[0] / np.maximum(2 * np.sum(products * positive, axis=0) - products[0], 1e-300)


@functools.lru_cache(maxsize=4)
def _rigid(model: MechanicalSystem, n: int) -> Callable:
    """Function to inertial torques (n,), weight (n,) and the derivative (n, n) of the weight."""

    def at(q, v, a):
        def weight(q):
            return differential(model.manifold, model.potential, q)

        return model.space.lower(q, a) + model.space.connection_force(q, v, v), weight(q), jax.jacfwd(weight)(q)

    return on_batches(at, np.zeros(n), np.zeros(n), np.zeros(n))


def fit_servo(case: Case, prepared: Prepared, servos: JointServos, i: int) -> ServoFit:
    """Fit the delay, the limit if the model states one, and the multiples of the explanations."""
    stated = float(servos.delay[servos.column[i]])
    plain, always = np.sign(prepared.rate[:, i]) * prepared.moves[:, i], _always(prepared, i)
    # Includes times at which the servo is off, so that errors before and after a suspicion have the same reference.
    raw = errors(case, prepared, servos._replace(factors=((),) * len(servos.factors)), i, 0.0)
    size = float(np.var(raw[prepared.rows])) or 1.0
    best, least = (0.0, np.inf, 0.0), np.inf

    def attempt(delay: float, level: float, damping: float) -> np.ndarray:
        nonlocal best, least
        error = cut(errors(case, prepared, servos, i, delay), prepared.rate[:, i], level, damping)
        # If most errors are beyond the limit, they are clipped to a constant, which explains anything.
        beyond = np.abs(error - damping * prepared.rate[:, i])[prepared.rows] >= level
        if np.isfinite(level) and np.mean(beyond) > MAX_LIMITED:
            return np.zeros(1)
        x, left = _solve(prepared, i, error, plain, always)
        if left < least:
            best, least = (delay, level, damping), left
        return x

    for delay in sorted({*FIRST_DELAYS, stated}):
        largest = float(np.abs(errors(case, prepared, servos, i, delay)[prepared.rows]).max())
        attempt(delay, np.inf, 0.0)
        for level in (each * largest for each in LIMIT_LEVELS if servos.limited[i]):
            attempt(delay, level, 0.0)
    if servos.limited[i]:
        for _ in range(REFINEMENTS):
            # The limit clips the torque with the damping, which is estimated where the limit is not reached.
            delay, level, damping = best
            if np.isfinite(level):
                dampings = {damping, *(DAMPING_FRACTIONS * _damping(case, prepared, servos, i, best))}
                for other, factor in itertools.product(dampings, LIMIT_FACTORS):
                    attempt(delay, level * factor, float(other))
    delay, level, damping = best

    def acting(delay: float) -> np.ndarray:
        return cut(errors(case, prepared, servos, i, delay), prepared.rate[:, i], level, damping)

    for _ in range(REFINEMENTS):
        slope = (acting(delay + DELAY_DIFFERENCE) - acting(delay - DELAY_DIFFERENCE)) / (2 * DELAY_DIFFERENCE)
        finer = delay - float(np.clip(_solve(prepared, i, acting(delay), plain, always, slope)[0][-1], -0.01, 0.01))
        left = _solve(prepared, i, acting(finer), plain, always)[1]
        if left >= least:
            break
        delay, least = finer, left
    # Errors clipped at a limit are smaller, and so is the reference for what is left of them.
    size = min(size, float(np.var(np.clip(raw, -level, level)[prepared.rows])) or 1.0)
    return settle(prepared, i, acting(delay), delay, size, level)


def cut(error: np.ndarray, rate: np.ndarray, level: float, damping: float) -> np.ndarray:
    """Errors (K,) that act under a limit, which clips error and damping together, relative to the stiffness."""
    return np.clip(error - damping * rate, -level, level) + damping * rate if np.isfinite(level) else error


def _damping(case: Case, prepared: Prepared, servos: JointServos, i: int, best: tuple[float, float, float]) -> float:
    """Damping relative to the stiffness, from the points at which the error is well below the limit."""
    delay, level, damping = best
    error, rate = errors(case, prepared, servos, i, delay), prepared.rate[:, i]
    within = averaged(prepared.log, (np.abs(error - damping * rate) < 0.9 * level).astype(float)[:, None])[:, 0] > 0.95
    x, _ = _solve(prepared, i, error, np.sign(rate) * prepared.moves[:, i], within & _always(prepared, i))
    return max(float(x[1 + RATE_INDEX]), 0.0)


def settle(prepared: Prepared, i: int, error: np.ndarray, delay: float, size: float, level: float) -> ServoFit:
    """Fit the multiples together with the dry friction at rest to an error (K,) that acts."""
    log, moves, direction = prepared.log, prepared.moves[:, i], np.sign(prepared.rate[:, i])
    friction, smoothed = direction * moves, averaged(log, error[:, None])[:, 0]
    always, chosen = _always(prepared, i), prepared.rows[~HELD_OUT[prepared.blocks]]
    # The start is a constant alone, which stays the answer if the joint hardly moves.
    mean = float(smoothed[chosen].mean())
    best = np.zeros(prepared.columns.shape[2] + 1), np.full(len(error), mean)
    least = float(np.var(smoothed[chosen]))
    for k in range(ROUNDS):
        # The first round uses only points around which the joint moves.
        x, _ = _solve(prepared, i, error, friction, always if k == 0 else None)
        rest = error - prepared.columns[i] @ x[1:]
        holding = np.clip(rest / x[0], -1.0, 1.0) if x[0] > 0 else np.zeros_like(rest)
        friction = np.where(moves, direction, holding)
        explained = prepared.columns[i] @ x[1:] + x[0] * averaged(log, friction[:, None])[:, 0]
        left = float(np.mean((smoothed - explained)[chosen] ** 2))
        if left < least:
            best, least = (x, explained), left
    x, explained = best
    left = (smoothed - explained)[prepared.rows]
    return ServoFit(left, error, explained, x[1:], float(x[0]), delay, size, level)


def _always(prepared: Prepared, i: int) -> Bool[np.ndarray, "K"]:
    """Points (K,) around which a joint moves without a stop."""
    return averaged(prepared.log, prepared.moves[:, [i]].astype(float))[:, 0] > 1 - STICKING_SPEED


def _solve(
    prepared: Prepared,
    i: int,
    error: np.ndarray,
    friction: np.ndarray,
    where: np.ndarray | None,
    slope: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Multiples (1 + p,) of friction and the explanations by least squares, and the mean square that is left."""
    more = () if slope is None else (slope,)
    both = averaged(prepared.log, np.column_stack([error, friction, *more]))
    chosen = ~HELD_OUT[prepared.blocks]
    if where is not None and (where[prepared.rows] & chosen).sum() > 4 * BLOCKS:
        chosen &= where[prepared.rows]
    rows = prepared.rows[chosen]
    table, target = np.column_stack([both[rows, 1], prepared.columns[i][rows], both[rows, 2:]]), both[rows, 0]
    least = np.concatenate([[0.0], prepared.least[i], [-np.inf] * len(more)])
    most = np.concatenate([[np.inf], prepared.most[i], [np.inf] * len(more)])
    x = bounded(table, target, least, most)
    return x, float(np.mean((target - table @ x) ** 2))


def bounded(
    table: Float[np.ndarray, "J p"], target: Float[np.ndarray, "J"], least: np.ndarray, most: np.ndarray
) -> Float[np.ndarray, "p"]:
    """Least squares with bounds: a number that exceeds a bound stays at that bound."""
    size = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-12)
    matrix, vector = (table / size).T @ (table / size), (table / size).T @ target
    matrix[np.diag_indices(len(size))] += RIDGE * len(table)
    free, x = np.ones(len(size), bool), np.zeros(len(size))
    for _ in range(len(size)):
        rest = vector[free] - matrix[np.ix_(free, ~free)] @ x[~free]
        x[free] = np.linalg.lstsq(matrix[np.ix_(free, free)], rest, rcond=1e-10)[0]
        beyond = free & ((x < least * size) | (x > most * size))
        if not beyond.any():
            break
        x[beyond] = np.clip(x, least * size, most * size)[beyond]
        free &= ~beyond
    return x / size


def joint_name(case: Case, i: int) -> str:
    """Name of the joint of a servo."""
    return case.model.coordinates[JointServos.of(case).joint[i]]
