"""How well a log shows what servos do: errors of their commands, and what no numbers of a servo explain of them.

The torque of a servo is proportional to the error of its command until it reaches its limit. Divided by its
stiffness, the equation of motion says what the error has to be: a share of the motion, of friction, weight and rotor,
and a constant. These are fitted, with the delay, so that a first guess at a servo's numbers is no fault of a log.
Dry friction of a joint at rest holds any torque up to its size, and takes what the others leave.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case, averaged
from covariant.calibration.diagnosis._smooth import Smooth, held_inputs, smooth
from covariant.calibration.diagnosis._suspicion import BLOCKS, HELD_OUT, Unexplained
from covariant.geometry import differential
from covariant.lowering import on_batches
from covariant.models import MechanicalSystem

DELAYS = (0.0, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1)
"""Delays of a command [s] that are tried."""
LEVELS = (0.3, 0.5, 0.7, 0.85, 0.95)
"""Largest errors that act, relative to the largest one seen, that are tried for a servo with a limit."""
MOST_BEYOND = 0.6
"""Largest fraction of the log in which a servo may be at its limit."""
FRACTIONS, NEARER = np.array([0.5, 1.0]), (0.85, 0.93, 1.0, 1.07, 1.15)
"""Parts of the damping that may be within the limit, and factors by which a limit is refined."""
RATE = 2
"""Place of the rate among what explains an error."""
REFINED, NUDGE = 3, 1e-3
"""Steps from the best of these delays to a finer one, and shift [s] of the differences for its slope."""
MOST_POINTS = 2000
"""Largest number of points of the grid in a fit."""
SLOW = 0.1
"""Speed, relative to the usual one, below which a joint may stick."""
HEAVIEST, ASKEW = 10.0, 0.5
"""Largest error by the weight, relative to the motion, and largest one by a weight in another direction than the model
says: larger ones explain other units and signs."""
RIDGE = 1e-6
"""Weight of the squares of the numbers beside that of the errors, for numbers that a log does not show."""
LIGHT = 0.02
"""Change of the weight on a joint, relative to the largest weight on any, below which it is none."""
ROUNDS = 4
"""Rounds in which friction at rest and the other numbers settle."""
MOVED = 6.0
"""Range of the positions of a joint that moves, in the noise or the ticks of its encoder."""


class Servos(NamedTuple):
    """What is read of the servos of a model, k of them, one for each joint that has one.

    Attributes:
        joint: Coordinate (k,) of each.
        gear: Position of the servo for a unit of its coordinate (k,).
        zero: Position (k,) where the coordinate is zero, less the offset of the servo.
        column: Column of the inputs that commands it.
        factors: Columns of the inputs that multiply its torque, its switch and its voltage, with their usual values.
        stiffness: Stiffness (k,) that the model states.
        limited: Whether the model states a limit (k,) of its torque.
        circle: Whether its position is an angle on a full circle (k,).
        delay: Delay (m,) of each input that the model states [s].
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
    def of(cls, case: Case) -> "Servos":
        """Those of the model of a case."""
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
    """The smoothed positions of a case, and per servo what may explain its errors.

    Attributes:
        log: Smoothed positions on the grid.
        position: Positions (K, k) of the servos.
        rate: Rates (K, k).
        columns: Explanations (k, K, p), averaged as accelerations are: rate, rotor, motion, 1, and weights.
        least, most: Bounds (k, p) of their multiples.
        moves: Points (K, k) at which the joint moves.
        weighs: Whether the weight on a servo changes (k,).
        known: Whether a servo moves enough (k,).
        rows: Points (J,) of the grid that are used.
        blocks: Block (J,) of each.
        noise: Variance (k,) of an error that the reading causes.
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
    """The numbers of one servo that explain its errors best.

    Attributes:
        left: Error (J,) that is left at the points that are used, averaged [rad].
        error: Error (K,) that acts, not averaged.
        explained: What explains it (K,), averaged.
        multiples: Multiples (p,) of the explanations.
        friction: Dry friction (1,) relative to the stiffness [rad].
        delay: Delay of the command [s].
        size: Variance of the error without a delay.
        level: Largest error that acts.
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
    """Function from a case to what no numbers of its servos explain of the errors of their commands.

    It remembers what positions and commands have shown, since most suspicions change one column.
    """

    def __init__(self) -> None:
        self._prepared: dict[int, tuple[np.ndarray, Prepared]] = {}
        self._fits: dict[tuple, ServoFit] = {}

    def __call__(self, case: Case) -> Unexplained | None:
        return self.of(None, case)

    def of(self, servo: int | None, case: Case) -> Unexplained | None:
        """What is unexplained of all servos that move, or of one of them."""
        prepared = self.prepared(case)
        if len(prepared.rows) < 2 * BLOCKS or not prepared.known.any():
            return None
        known = prepared.known if servo is None else np.arange(len(prepared.known)) == servo
        fits = [self.fit(case, i) for i in range(len(prepared.known))]
        blocks = [[np.mean(fit.left[prepared.blocks == b] ** 2) / fit.size for fit in fits] for b in range(BLOCKS)]
        noise = prepared.noise / np.array([fit.size for fit in fits])
        return Unexplained(np.array(blocks), noise, known)

    def prepared(self, case: Case) -> Prepared:
        """What the positions of a case say."""
        y = case.record.y
        if id(y) not in self._prepared:
            self._prepared[id(y)] = y, _prepare(case)  # pyright: ignore[reportArgumentType]
        return self._prepared[id(y)][1]

    def fit(self, case: Case, i: int) -> ServoFit:
        """The numbers of servo i that explain its errors best."""
        prepared, servos, u = self.prepared(case), Servos.of(case), np.asarray(case.record.u)
        places = [servos.column[i], *(place for place, _ in servos.factors[i])]
        key = (id(prepared), i, bool(servos.limited[i]), u[:, places].tobytes())
        if key not in self._fits:
            self._fits[key] = fit_servo(case, prepared, servos, i)
        return self._fits[key]


def errors(case: Case, prepared: Prepared, servos: Servos, i: int, delay: float) -> Float[np.ndarray, "K"]:
    """Error (K,) of the command of a servo that acts after a delay, before any limit."""
    log, t, u = prepared.log, np.asarray(case.record.t), np.asarray(case.record.u)
    command = held_inputs(t + delay, u[:, [servos.column[i]]], log.t, log.step)[:, 0]
    error = command - prepared.position[:, i]
    if servos.circle[i]:
        error = error - 2 * np.pi * np.round(error / (2 * np.pi))
    for place, usual in servos.factors[i]:
        error = error * held_inputs(t + delay, u[:, [place]], log.t, log.step)[:, 0] / usual
    return error


def _prepare(case: Case) -> Prepared:
    servos, t = Servos.of(case), np.asarray(case.record.t)
    nothing = np.zeros((len(t), 0))
    log = smooth(
        case.record._replace(u=nothing),
        case.file.reference_half,
        case.model.circles,
        np.asarray(case.file.delay, float),
        case.ticks,
    )
    motion, weight, slopes = _rigid(case.model, log.q.shape[1])(log.q, log.v, log.a)
    columns, least, most, weighs = [], [], [], []
    for j, gear in zip(servos.joint, servos.gear, strict=True):
        v = gear * log.v[:, j]
        weights = np.column_stack([weight[:, j], slopes[:, j]])
        shown = np.ptp(weights, axis=0) > 1e-9 * max(np.abs(weight).max(), 1e-300)
        weights = weights[:, shown]
        weighs.append(bool(np.std(weight[:, j]) > LIGHT * np.abs(weight).max()))
        free = [v, np.ones_like(v), *weights.T]
        smoothed = averaged(log, np.column_stack([motion[:, j], *free]))
        part = np.column_stack([log.a[:, j] * gear, smoothed])
        range_of = np.std(log.q[log.used, j]) if log.used.any() else 1.0
        bound = ASKEW * range_of / np.maximum(np.std(weights, axis=0), 1e-300)
        least.append([0.0, 0.0, -np.inf, -np.inf, *-bound])
        bound = np.where(shown[0] & (np.arange(len(bound)) == 0), HEAVIEST / ASKEW, 1.0) * bound
        most.append([np.inf, np.inf, np.inf, np.inf, *bound])
        columns.append(part)
    width = max(part.shape[1] for part in columns)

    def pad(part: list[float], value: float) -> np.ndarray:
        return np.pad(np.array(part), (0, width - len(part)), constant_values=value)

    columns = [np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in columns]
    rate = log.v[:, servos.joint] * servos.gear
    position = log.q[:, servos.joint] * servos.gear + servos.zero
    usual = np.sqrt(np.mean(rate[log.used] ** 2, axis=0)) if log.used.any() else np.ones(len(servos.joint))
    # A tick within the window is no motion.
    least_rate = np.maximum(SLOW * usual, case.ticks[servos.joint] * np.abs(servos.gear) / log.half / 2)
    moves = np.abs(rate) > least_rate
    used = np.flatnonzero(log.used)
    rows = used[:: max(1, -(-len(used) // MOST_POINTS))]
    blocks = np.zeros(len(rows), int)
    for b, part in enumerate(np.array_split(np.arange(len(rows)), BLOCKS)):
        blocks[part] = b
    resolved = np.maximum(log.noise, case.ticks)[servos.joint] * np.abs(servos.gear)
    known = np.array([len(rows) > 0 and np.ptp(position[used, i]) > MOVED * resolved[i] for i in range(len(resolved))])
    std = np.maximum(np.where(case.ticks > 0, case.ticks / np.sqrt(12), log.noise)[servos.joint] * servos.gear, 1e-12)
    return Prepared(
        log,
        position,
        rate,
        np.array(columns),
        np.array([pad(each, -1.0) for each in least]),
        np.array([pad(each, 1.0) for each in most]),
        moves,
        np.array(weighs),
        known,
        rows,
        blocks,
        std**2,
    )


@functools.lru_cache(maxsize=4)
def _rigid(model: MechanicalSystem, n: int) -> Callable:
    """Torques of the motion (n,) beside the weight (n,), and the slopes (n, n) of the weight."""

    def at(q, v, a):
        def weight(q):
            return differential(model.manifold, model.potential, q)

        return model.space.lower(q, a) + model.space.connection_force(q, v, v), weight(q), jax.jacfwd(weight)(q)

    return on_batches(at, np.zeros(n), np.zeros(n), np.zeros(n))


def fit_servo(case: Case, prepared: Prepared, servos: Servos, i: int) -> ServoFit:
    """The delay, the limit where the model states one, and the other numbers that explain errors best."""
    stated = float(servos.delay[servos.column[i]])
    plain, always = np.sign(prepared.rate[:, i]) * prepared.moves[:, i], _always(prepared, i)
    # Also where the servo is off, so that errors before and after a suspicion are relative to the same.
    raw = errors(case, prepared, servos._replace(factors=((),) * len(servos.factors)), i, 0.0)
    size = float(np.var(raw[prepared.rows])) or 1.0
    best, least = (0.0, np.inf, 0.0), np.inf

    def attempt(delay: float, level: float, damping: float) -> np.ndarray:
        nonlocal best, least
        error = cut(errors(case, prepared, servos, i, delay), prepared.rate[:, i], level, damping)
        # Where nearly all errors are beyond the limit, a constant explains them.
        if (
            np.isfinite(level)
            and np.mean(np.abs(error[prepared.rows] - damping * prepared.rate[prepared.rows, i]) >= level) > MOST_BEYOND
        ):
            return np.zeros(1)
        x, left = _solve(prepared, i, error, plain, always)
        if left < least:
            best, least = (delay, level, damping), left
        return x

    for delay in sorted({*DELAYS, stated}):
        largest = float(np.abs(errors(case, prepared, servos, i, delay)[prepared.rows]).max())
        attempt(delay, np.inf, 0.0)
        for level in (each * largest for each in LEVELS if servos.limited[i]):
            attempt(delay, level, 0.0)
    if servos.limited[i]:
        for _ in range(REFINED):
            # The limit is of the torque with the damping, whose share shows where it is not reached.
            delay, level, damping = best
            for other in (
                {damping, *(FRACTIONS * _damping(case, prepared, servos, i, best))} if np.isfinite(level) else ()
            ):
                for factor in NEARER:
                    attempt(delay, level * factor, float(other))
    delay, level, damping = best

    def acting(delay: float) -> np.ndarray:
        return cut(errors(case, prepared, servos, i, delay), prepared.rate[:, i], level, damping)

    for _ in range(REFINED):
        slope = (acting(delay + NUDGE) - acting(delay - NUDGE)) / (2 * NUDGE)
        finer = delay - float(np.clip(_solve(prepared, i, acting(delay), plain, always, slope)[0][-1], -0.01, 0.01))
        left = _solve(prepared, i, acting(finer), plain, always)[1]
        if left >= least:
            break
        delay, least = finer, left
    # Errors cut at a limit are the smaller, so that what is left of them counts the more.
    size = min(size, float(np.var(np.clip(raw, -level, level)[prepared.rows])) or 1.0)
    return settle(prepared, i, acting(delay), delay, size, level)


def cut(error: np.ndarray, rate: np.ndarray, level: float, damping: float) -> np.ndarray:
    """Errors (K,) that act under a limit, which cuts the torque with the damping, relative to the stiffness."""
    return np.clip(error - damping * rate, -level, level) + damping * rate if np.isfinite(level) else error


def _damping(case: Case, prepared: Prepared, servos: Servos, i: int, best: tuple[float, float, float]) -> float:
    """Damping relative to the stiffness, from the points at which the error is far below a limit."""
    delay, level, damping = best
    error, rate = errors(case, prepared, servos, i, delay), prepared.rate[:, i]
    within = averaged(prepared.log, (np.abs(error - damping * rate) < 0.9 * level).astype(float)[:, None])[:, 0] > 0.95
    x, _ = _solve(prepared, i, error, np.sign(rate) * prepared.moves[:, i], within & _always(prepared, i))
    return max(float(x[1 + RATE]), 0.0)


def settle(prepared: Prepared, i: int, error: np.ndarray, delay: float, size: float, level: float) -> ServoFit:
    """Fit the numbers of a servo together with the dry friction at rest, to an error (K,) that acts."""
    log, moves, direction = prepared.log, prepared.moves[:, i], np.sign(prepared.rate[:, i])
    friction, smoothed = direction * moves, averaged(log, error[:, None])[:, 0]
    always, chosen = _always(prepared, i), prepared.rows[~HELD_OUT[prepared.blocks]]
    # Nothing but a constant, where the joint hardly moves.
    mean = float(smoothed[chosen].mean())
    best = np.zeros(prepared.columns.shape[2] + 1), np.full(len(error), mean)
    least = float(np.var(smoothed[chosen]))
    for k in range(ROUNDS):
        # At first only points at which the joint moves.
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
    """Points (K,) around which a joint does not stop."""
    return averaged(prepared.log, prepared.moves[:, [i]].astype(float))[:, 0] > 1 - SLOW


def _solve(
    prepared: Prepared,
    i: int,
    error: np.ndarray,
    friction: np.ndarray,
    where: np.ndarray | None,
    slope: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Multiples (1 + p,) of friction and the explanations on the blocks that choose, and the mean square they leave."""
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
    """Least squares whose numbers stay at a bound once they are beyond it."""
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
