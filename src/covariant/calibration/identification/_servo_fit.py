"""Fit of a robot with servos to commands and positions: prediction errors over windows, Levenberg–Marquardt steps.

A servo holds its joint so firmly that residual accelerations contain little information on it; the positions through
which the joint moves, and at which it stops, contain more. So positions are predicted over windows from the commands
alone.

Source: Huber 1981 for the weights; White 1982 for the sandwich covariance, here over blocks.
"""

import inspect
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._least_squares import PRIOR, Blocks, Fixed, Point, block_covariance, minimise, robust
from covariant.calibration.identification._robot_combinations import late_alike
from covariant.calibration.identification._robot_fit import RobotFit, scale_of
from covariant.calibration.identification._robot_torques import Determined, usual_sizes
from covariant.calibration.identification._servo_motion import MAX_STEP, RIGID_BODY_GROUPS, ServoLog, simulate
from covariant.models import RobotFamily
from covariant.models.robots import Servo
from covariant.signals import Record
from scalargraph.errors import InputError

WINDOW = 2.0
"""Length of a window [s], as the effect of the initial state decays within a few tenths of a second."""
SETTLING = 0.2
"""Time at the start of a window [s] that does not count, since the initial speed is only roughly known."""
MIN_WINDOWS = 8
BLOCKS_PER_NUMBER = 3
"""Least number of blocks per fitted number: with too few blocks their covariance has no full rank."""
MAX_ROUNDS, STEPS, LONGEST_STEP = 24, 12, 1.5
"""Most steps of a search, and those until the scale of the errors is renewed; longest step of an unknown."""
TOLERANCE = 3e-3
"""Relative decrease of the loss below which the search stops."""
ROWS_ALIKE = 10
"""Number of independent errors in a window."""
SHOWN = 0.1
"""Largest standard error of a number of one log, relative to that before the log."""
RELATIVE_ACCURACY, TIME_ACCURACY = 2e-3, 2e-4
"""Integration error in the fitted numbers: relative, and for times such as a delay absolute [s]."""
DIFFERENCE_STEP = 1e-4
"""Step, in usual sizes, over which the change of the drive is a derivative."""
MIN_RATIO = 0.02
"""Least value of a number that must be positive, relative to its first value."""
POSITIVE_NUMBERS = ("stiffness", "resistance", "torque_constant", "stribeck_velocity", "limit")
FIRST_TIMES, STIFFNESS_FACTORS = (0.0, 0.02, 0.04, 0.08), (0.5, 1.0, 2.0)
"""Delays and dampings relative to a stiffness [s], and factors on the first stiffness, that are tried as starting
points of the search."""
ASIDE = 3.0
"""Distance from a fit, in standard errors, from which the search starts again."""
STEEP = 1e4
"""Change of a position [rad or m] per usual size of a number from which a prediction is unstable."""
FREE, ABOVE = 1e3, 1.5
"""Usual sizes by which a limit without effect is above its first value in a search; such a limit at its end, relative
to the largest torque that the logs demand."""
CUTS, MARGIN = (0.8, 0.6, 0.4, 0.25), 2.0
"""Limits that are tried, relative to the largest torque demanded; decrease of the loss by which one is believed."""


def fit_servos(
    families: Sequence[RobotFamily],
    records: Sequence[Record],
    between: str = "held",
    progress: Callable[[int], object] = lambda _: None,
    late: float = 0.0,
) -> RobotFit:
    """Fit open numbers of a robot with servos to logs of commands and positions.

    Positions are predicted over windows from the commands alone, with dry friction that sticks. The search starts from
    those of several delays, stiffnesses and dampings that predict best, and again on either side of what it finds,
    along the combination that the logs tell least; standard errors hold other minima that are nearly as good.

    Args:
        families: The robot as a function of its p open numbers, from `models.robot_family`, one for each log. Settings
            that are not open, such as a gain or a known payload, may differ between logs.
        records: The logs, with the commands at the stamps at which they were sent.
        between: "held" if a command is constant until the next stamp, "linear" if it is linear between stamps.
        progress: Called with the number of each round.
        late: Time [s] by which the stamps of positions are ahead of those of the commands.

    Returns:
        Values, standard errors, and the combinations that the logs determine; `torque` has residuals of positions.

    Raises:
        ValueError: The logs are too short, or no prediction is finite.

    Example:
        >>> from covariant.calibration.identification import fit_servos
        >>> fit_servos([], [])
        Traceback (most recent call last):
        scalargraph.errors.InputError: give a family and a log for each of the logs
    """
    if not records or len(families) != len(records):
        raise InputError("give a family and a log for each of the logs")
    search = _Search.of(families, records, between, late)
    rounds = itertools.count()
    # A limit has a slope only where a log is at it, so that the search starts once without limits and once with them.
    point = search.descend(np.where(search.one_sided, FREE, search.started()), progress, rounds)
    if search.one_sided.any():
        limited = search.better(point, search.descend(search.started(CUTS), progress, rounds))
        without = Point.at(search, np.where(search.one_sided, FREE, limited.z))
        point = search.descend(search.better(limited, without, -MARGIN).z, progress, rounds)
    minima = [point]
    # Joints stick, and a delay is nearly a damping or a lead, so that there are local minima on either side of a fit.
    for z in search.aside(point):
        minima.append(search.descend(z, progress, rounds, STEPS))
        point = search.better(point, minima[-1])
    search = search.scaled(point.blocks.rest[0])
    point = search.weighed(point)
    idle, demanded = search.idle(point), search.demanded(point.z)
    x = np.where(idle, np.maximum(ABOVE * demanded - families[0].first, 0.0), point.z * search.sizes)
    # Rounded, a number at its bound would be beyond it.
    x = np.maximum(x, search.least)
    blocks, outer = point.blocks, np.outer(search.sizes, search.sizes)
    covariance, inverse = _covariance(blocks)
    covariance = outer * (covariance + search.between(point, minima))
    family = families[0]
    # Integration steps of a few milliseconds bias the numbers in every window alike, which blocks do not show.
    values = np.asarray(family.values(x))
    stiffness = float(np.max(np.asarray(search.logs[0].drive(x).servos.stiffness)))
    # A feedforward is a lead times a stiffness, and a lead is a time like a delay.
    of_times = {"delay": TIME_ACCURACY, "feedforward": TIME_ACCURACY * stiffness}
    times = [of_times.get(number.number, 0.0) if number.group == "servo" else 0.0 for number in family.numbers]
    integration_error = np.where(np.array(times) > 0, times, RELATIVE_ACCURACY * np.abs(values))
    covariance += np.diag(integration_error**2)
    known = Determined.of(family, x, search.sizes, blocks.information / outer, covariance)
    reached = search.scale, search.length / 2, x, blocks.loss
    beyond = tuple((family.names[i], float(demanded[i])) for i in np.flatnonzero(idle))
    alike = late_alike(family, x, outer * inverse)
    return RobotFit(family.names, family.first, values, *known[:3], *reached, alike=alike, beyond=beyond)


def own_numbers(
    family: RobotFamily, records: Sequence[Record], between: str = "held", late: float = 0.0
) -> tuple[Float[np.ndarray, "K p"], Float[np.ndarray, "K p"]]:
    """Numbers of each log by itself, near the fitted ones, and their standard errors; NaN where it does not show one.

    They are one Gauss–Newton step from the first values of the family, so these should be fitted to all logs before.

    Args:
        family: The robot as a function of its p open numbers, whose first values are those of all logs.
        records: K logs of commands and positions.
        between, late: As for `fit_servos`.
    """
    x = np.zeros(len(family.names))
    slope = np.abs(np.diagonal(np.asarray(jax.jacfwd(family.values)(x))))
    values, std = (np.full((len(records), len(x)), np.nan) for _ in range(2))
    longest = max((float(record.t[-1] - record.t[0]) for record in records), default=0.0)
    length = WINDOW if longest > 1.5 * WINDOW else 3 * SETTLING
    search = _Search.of([family] * len(records), records, between, late, length)
    errors, slopes = search.blocks(x).rest
    search = search.scaled(errors)
    ends = np.cumsum(search.counts)[:-1]
    usual = slope * search.sizes
    for k, own, its in zip(search.used, np.split(errors, ends), np.split(slopes, ends, 1), strict=True):
        change, error = search.step(own, its)
        shown = error < SHOWN * PRIOR
        values[k] = np.where(shown, family.first + change * usual, np.nan)
        std[k] = np.where(shown, error * usual, np.nan)
    return values, std


class _Search(NamedTuple):
    """Logs and their windows, with the usual sizes and lower bounds of the open numbers, and the scale (n,) of errors.

    Logs without a window are left out; `used` has the indices of the others. Derivatives are those along the motion: in
    differences a joint that sticks jumps, which outweighs all else, and seems to tell numbers that act by their ratios.

    The unknowns z (p,) of the search are coordinates in usual sizes.
    """

    logs: tuple[ServoLog, ...]
    rows: tuple[np.ndarray, ...]
    counts: tuple[int, ...]
    sizes: Float[np.ndarray, "p"]
    least: Float[np.ndarray, "p"]
    rigid: tuple[int, ...]
    length: float
    scale: Float[np.ndarray, "n"]
    used: tuple[int, ...]

    @classmethod
    def of(
        cls,
        families: Sequence[RobotFamily],
        records: Sequence[Record],
        between: str,
        late: float,
        length: float | None = None,
    ) -> "_Search":
        """The search in windows of this length; without one, of a length that suits a fit."""
        family = families[0]
        logs = tuple(ServoLog.of(each, record, between, late) for each, record in zip(families, records, strict=True))
        durations = [float(log.t[-1] - log.t[0]) for log in logs]
        if length is None:
            # A covariance over blocks needs more than about 16 windows, so the windows of short logs are shorter.
            length = max(min(WINDOW, sum(durations) / (2 * MIN_WINDOWS + 1)), 3 * SETTLING)
        windows = [log.windows(length) for log in logs]
        counts = tuple(len(each) for each in windows)
        if not sum(counts):
            raise InputError(f"the logs hold no {length:.3g} s without a gap, which a fit needs; give longer logs")
        # Logs of several families have as many windows each, so that one program serves all; copies do not count.
        max_windows = max(counts) if len({id(each) for each in families}) > 1 else 0
        padded = [each + each[:1] * (max_windows - len(each)) for each in windows if each]
        logs = tuple(log for log, each in zip(logs, windows, strict=True) if each)
        rows = tuple(np.stack(each) for each in padded)
        motion = [np.concatenate([getattr(log, name) for log in logs]) for name in ("q", "v", "a")]
        first = np.zeros(len(family.names))
        body, drive = logs[0].evaluate(first, motion[0], motion[1]), logs[0].drive(first)
        inertia = body.inertia + np.diag(np.asarray(drive.armature))
        torque = np.einsum("tij,tj->ti", inertia, motion[2]) + body.coriolis + body.slope
        directions, commanded = np.asarray(drive.servos.rows), np.asarray(drive.servos.commands)
        zero, stiffness = np.asarray(drive.servos.zero), np.asarray(drive.servos.stiffness)
        errors = np.concatenate([log.u for log in logs]) @ commanded.T - motion[0] @ directions.T - zero
        sizes, _ = usual_sizes(family, errors * stiffness @ np.abs(directions), torque, *motion[1:])
        # If the file states a stiffness, a speed or a limit, that value is its usual size.
        has_positive_number = np.array([number.number in POSITIVE_NUMBERS for number in family.numbers])
        sizes = np.where(has_positive_number & (np.abs(family.first) > 0), np.abs(family.first), sizes)
        above_zero = np.maximum(family.least, -(1 - MIN_RATIO) * np.abs(family.first))
        least = np.where(has_positive_number, above_zero, family.least)
        rigid = tuple(i for i, number in enumerate(family.numbers) if number.group in RIGID_BODY_GROUPS)
        used, unscaled = tuple(np.flatnonzero(counts).tolist()), np.ones(logs[0].q.shape[1])
        return cls(logs, rows, tuple(counts[k] for k in used), sizes, least, rigid, length, unscaled, used)

    @property
    def one_sided(self) -> Bool[np.ndarray, "p"]:
        """Which numbers act only beyond a motion of some size: those without a table are infinite."""
        numbers, of_servo = self.logs[0].family.numbers, inspect.signature(Servo).parameters
        infinite = {name for name, each in of_servo.items() if each.default == np.inf}
        return np.array([number.group == "servo" and number.number in infinite for number in numbers], bool)

    @property
    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Parts of the robot with their own numbers: that of each joint (n,), and that of each number (p,)."""
        family = self.logs[0].family
        names = list(family.file.model.coordinates)
        own = np.array([names.index(n.target) if n.target in names else -1 for n in family.numbers], int)
        shared = any("like" in table for table in family.document.get("servo", {}).values())
        return (0 * np.arange(len(names)), 0 * own) if shared or (own < 0).any() else (np.arange(len(names)), own)

    def idle(self, point: Point) -> Bool[np.ndarray, "p"]:
        """Which one-sided numbers act on no prediction."""
        return self.one_sided & ~np.nan_to_num(point.blocks.rest[1]).any(axis=(1, 2, 3))

    def demanded(self, z: np.ndarray) -> Float[np.ndarray, "p"]:
        """The largest torque that the logs demand of the servos of each one-sided number; zero for other numbers."""
        most, one_sided = np.zeros(len(z)), self.one_sided
        x = np.where(one_sided, FREE, z) * self.sizes
        for log in self.logs if one_sided.any() else ():
            servos = log.drive(x).servos
            delays = np.asarray(servos.delay) + log.late
            mean, _, rate, *_ = np.moveaxis(log.commands(log.t, np.full(len(log.t), MAX_STEP), delays), -2, 0)
            u = mean + np.asarray(servos.lead) * rate
            torque = jax.vmap(servos.torque)(*map(jnp.asarray, (log.q, log.v, u)))
            largest = np.abs(np.asarray(torque)).max(axis=0)
            for i in np.flatnonzero(one_sided):
                own = log.drive(np.where(np.arange(len(x)) == i, 0.0, x)).servos.limit != servos.limit
                most[i] = max(most[i], *largest[np.asarray(own)], 0.0)
        return most

    def better(self, point: Point, other: Point, margin: float = 0.0) -> Point:
        """The better of two points, or the better numbers of each part if these predict better together; the other
        point is better by a margin at least."""
        search = self.scaled(point.blocks.rest[0])
        _, own = self.joints
        loss, less = (search.by_part(each.blocks.rest[0]) for each in (point, other))
        takes = less < loss - margin
        if not takes.any():
            return point
        mixed = other if takes.all() else Point.at(search, np.where(takes[own], other.z, point.z))
        if search.by_part(mixed.blocks.rest[0]).sum() < loss.sum() - margin * takes.sum():
            return mixed
        return other if less.sum() < loss.sum() - abs(margin) else point

    def between(self, point: Point, minima: Sequence[Point]) -> Float[np.ndarray, "p p"]:
        """What other local minima add to a covariance, by how probable each is beside the point that was found.

        Source: Gelman et al. 2013, Bayesian data analysis, section 13.3: a mixture of normal approximations at the
        modes, of variances enlarged as errors are alike within a window.
        """
        own, (best, *others) = self.joints[1], (self.by_part(each.blocks.rest[0]) for each in (point, *minima))
        moved = np.where(self.one_sided, 0.0, [each.z - point.z for each in minima])
        apart = np.array([np.bincount(own, np.abs(each), len(best)) > 0 for each in moved])
        odds = apart * np.exp(-np.maximum(np.array(others) - best, 0.0) / point.blocks.overdispersion)
        moved = np.sqrt(odds / (1 + odds.sum(axis=0)))[:, own] * moved
        return moved.T @ moved

    def chosen(self, candidates: Sequence[Sequence[np.ndarray]]) -> Float[np.ndarray, "p"]:
        """Coordinates (p,) of which each part of the robot has those that predict it best; a group has one delay."""
        tried, losses, search = [], [], self
        # Batches have the size of a point's batch, so that one compiled program serves both.
        count = len(self.sizes) + 1
        for group in (each[k : k + count] for each in candidates for k in range(0, len(each), count)):
            batch = (list(group) * count)[:count]
            residuals = self._residuals(batch, batch[0], [], np.zeros((count, len(self.rigid))))
            search = search.scaled(residuals[0]) if (search.scale == 1).all() else search
            tried += batch
            losses += [search.by_part(each) for each in residuals]
        if not np.isfinite(losses).any(axis=0).all():
            raise InputError("the model predicts no finite motion from these commands; check units and first values")
        return np.array(tried)[np.argmin(losses, axis=0)[self.joints[1]], np.arange(len(self.sizes))]

    def by_part(self, errors: np.ndarray) -> Float[np.ndarray, "m"]:
        """The loss of each part of the robot, by the errors of all windows."""
        e = np.where(np.isfinite(self._measured), errors, 0.0) / self.scale
        each = np.bincount(self.joints[0], np.einsum("b,bkj->j", self._shares, robust(e)[0]))
        return np.where(np.isfinite(each), each, np.inf)

    def started(self, cuts: Sequence[float] = ()) -> Float[np.ndarray, "p"]:
        """The first values, with the delays, stiffnesses and dampings that predict best, in usual sizes; and the
        limits, of these fractions of what the logs demand with each stiffness."""
        first, late, stiff, damping = self.logs[0].family.first, *map(self._are, ("delay", "stiffness", "damping"))
        none, candidates = np.zeros(len(first)), []
        demanded, servos = self.demanded(none), self.logs[0].drive(none).servos
        stiffness = dict(zip(servos.input_names, np.asarray(servos.stiffness), strict=False))
        own = (stiffness.get(f"cmd_{each.target}") for each in self.logs[0].family.numbers)
        stiffness = np.array([np.mean(servos.stiffness) if each is None else each for each in own])
        times, factors = (None, *FIRST_TIMES), STIFFNESS_FACTORS[: 3 if stiff.any() else 1]
        for delay in times if late.any() else (None,):
            x = none if delay is None else np.where(late, delay - first, 0.0)
            # A stiffness and a damping are tried with each other, and a limit with a stiffness.
            lags = times if damping.any() and not cuts else (None,)
            group = []
            for factor, cut, lag in itertools.product(factors, cuts or (0.0,), lags):
                other = np.where(stiff, (factor - 1) * first, x)
                other = other if lag is None else np.where(damping, lag * factor * stiffness - first, other)
                limit = cut * factor * demanded - first if cuts else FREE * self.sizes
                group.append(np.maximum(np.where(self.one_sided, limit, other), self.least))
            candidates.append(group)
        return self.chosen(candidates) / self.sizes

    def _are(self, kind: str) -> Bool[np.ndarray, "p"]:
        """Which numbers are of this kind, of servos."""
        return np.array([n.group == "servo" and n.number == kind for n in self.logs[0].family.numbers], bool)

    def descend(
        self, z: np.ndarray, progress: Callable[[int], object], rounds: Iterator[int], most: int = MAX_ROUNDS
    ) -> Point:
        """The point that a search reaches in some steps at most; the scale of the errors follows them."""
        point = Point.at(self, z)
        # Its prior would pull a number that does not act to where it does.
        free = Fixed(np.diag(1.0 * self.idle(point)), z)
        for _ in range(most // STEPS):
            search = self.scaled(point.blocks.rest[0])
            point = search.weighed(point)
            before = point.blocks.loss.sum()  # without the prior, which is large for a limit that does not act
            point = minimise(search, point, free, lambda _: progress(next(rounds)), STEPS)
            if not before - point.blocks.loss.sum() > TOLERANCE * before:  # nor where it is not finite
                break
        return point

    def aside(self, point: Point) -> list[np.ndarray]:
        """Unknowns on either side of a point, along the combination of those of each part that the logs tell least."""
        covariance, own = _covariance(self.scaled(point.blocks.rest[0]).weighed(point).blocks)[0], self.joints[1]
        step = np.zeros(len(own))
        for part in np.unique(own):
            its = np.flatnonzero((own == part) & ~self.one_sided)
            variances, axes = np.linalg.eigh(covariance[np.ix_(its, its)])
            step[its] = min(ASIDE * np.sqrt(variances[-1]), LONGEST_STEP) * axes[:, -1] if len(its) else 0.0
        return [np.maximum(each, self.least / self.sizes) for each in (point.z + step, point.z - step)]

    def blocks(self, z: np.ndarray, kept: Any = None) -> Blocks:
        """The loss of each block of rows, and its derivatives; `rest` has the errors of all windows and their own."""
        del kept
        p, x = len(z), z * self.sizes
        steps = DIFFERENCE_STEP * np.diag(self.sizes)
        weights = np.concatenate([np.zeros((1, p)), np.eye(p)])[:, list(self.rigid)]
        # Errors, and their derivatives, all in one batch.
        rigid = [steps[i] for i in self.rigid]
        batch = self._residuals([x, *(x + step for step in steps)], x, rigid, weights, along=True)
        return self._weigh((batch[0], (batch[1:] - batch[:1]) / DIFFERENCE_STEP))

    def moved(self, z: np.ndarray, dz: np.ndarray) -> np.ndarray:
        """Unknowns (p,) after a step of limited length."""
        return np.maximum(z + np.clip(dz, -LONGEST_STEP, LONGEST_STEP), self.least / self.sizes)

    def lowest(self, z: np.ndarray) -> Float[np.ndarray, "p"]:
        """Least steps (p,) that the bounds of the numbers permit."""
        return self.least / self.sizes - z

    def scaled(self, errors: Float[np.ndarray, "B R n"]) -> "_Search":
        """The search with the scale of these errors: their robust standard deviations in the windows in which a joint
        moves, and no less than rounding to ticks makes. A joint that is left standing has no errors, however wrong its
        numbers are."""
        measured, tick = self._measured, np.asarray(self.logs[0].family.file.quantum or 0.0)
        known = np.isfinite(measured)
        moves = np.max(np.where(known, measured, -np.inf), 1) - np.min(np.where(known, measured, np.inf), 1) > tick
        told = np.where(known & (moves | ~moves.any(axis=0))[:, None], errors, np.nan)
        scales = [scale_of(column) for column in np.moveaxis(told, -1, 0)]
        return self._replace(scale=np.maximum(scales, tick / np.sqrt(12)))

    def weighed(self, point: Point) -> Point:
        """The point with its errors weighed by the scale."""
        return point._replace(blocks=self._weigh(point.blocks.rest))

    def _weigh(self, errors: tuple[np.ndarray, np.ndarray]) -> Blocks:
        seen, share = np.isfinite(self._measured), self._shares[:, None, None]
        e, slopes = (np.where(seen, each, 0.0) / self.scale for each in errors)
        loss, weight = robust(e)
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        # Where the motion is unstable a search cannot go on; a step to there is refused as one that is not finite.
        stable = np.abs(slopes * self.scale).max() < STEEP
        losses = np.sum(share * loss * seen, axis=(1, 2)) + (0.0 if stable else np.nan)
        scores = self._by_blocks(np.einsum("pbkj,bkj->bkp", slopes, share * weight * e, optimize=True))
        flat = slopes.reshape(len(slopes), -1)
        majorised, information = ((flat * (share * w).ravel()) @ flat.T for w in (weight, weight**3))
        return Blocks(losses, scores, majorised, information[None], errors)

    def step(self, errors: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A Gauss–Newton step (p,) from the errors of some windows alone, and its standard errors."""
        seen = np.isfinite(errors) & np.isfinite(slopes).all(axis=0)
        e, slopes = np.where(seen, errors, 0.0) / self.scale, np.where(seen, slopes, 0.0) / self.scale
        weight = robust(e)[1]
        flat = slopes.reshape(len(slopes), -1)
        rows = max(1.0, np.sum(seen.any(axis=(0, 2))) / ROWS_ALIKE)
        inverse = np.linalg.inv((flat * weight.ravel()) @ flat.T / rows + np.eye(len(flat)) / PRIOR**2)
        return -inverse @ (flat @ (weight * e).ravel()) / rows, np.sqrt(np.diagonal(inverse))

    def _residuals(
        self,
        candidates: Sequence[np.ndarray],
        x: np.ndarray,
        steps: Sequence[np.ndarray],
        weights: np.ndarray,
        along: bool = False,
    ) -> np.ndarray:
        """Residuals (P, B, R, n) of drives at P coordinates, with the rigid body at x and its changes by `steps`."""
        steps = steps if len(steps) == weights.shape[1] else [np.zeros_like(x)] * weights.shape[1]
        parts: dict[int, np.ndarray] = {}
        # Logs of one family, with windows of as many rows and steps, are simulated at once.
        alike = lambda k: (id(self.logs[k].family), self.rows[k].shape[1], self.logs[k].substeps)  # noqa: E731
        for _, group in itertools.groupby(sorted(range(len(self.logs)), key=alike), key=alike):
            own = list(group)
            logs, rows = [self.logs[k] for k in own], [self.rows[k] for k in own]
            drives = [logs[0].drive(candidate) for candidate in candidates]
            ends = np.cumsum([len(each) for each in rows])[:-1]
            q = np.split(simulate(logs, drives, x, rows, weights, steps, along), ends, axis=1)
            for k, log, each in zip(own, logs, q, strict=True):
                parts[k] = (each - log.y[self.rows[k]])[:, : self.counts[k], self._skipped(log) :]
        return _together([parts[k] for k in range(len(self.logs))])

    @staticmethod
    def _skipped(log: ServoLog) -> int:
        return max(round(SETTLING / float(np.median(np.diff(log.t)))), 1)

    @property
    def _measured(self) -> np.ndarray:
        parts = zip(self.logs, self.rows, self.counts, strict=True)
        return _together([log.y[rows[:count]][:, self._skipped(log) :] for log, rows, count in parts])

    @property
    def _shares(self) -> Float[np.ndarray, "B"]:
        """What a row of each window counts, since a tenth of its rows are one independent error."""
        rows = [each.shape[1] - self._skipped(log) for log, each in zip(self.logs, self.rows, strict=True)]
        return np.repeat(1 / np.maximum(1.0, np.array(rows) / ROWS_ALIKE), self.counts)

    @staticmethod
    def _by_blocks(scores: np.ndarray) -> np.ndarray:
        """Sums (B, p) of scores (W, R, p) over blocks: windows, or parts of windows if these are too few for p."""
        windows, rows, p = scores.shape
        # Errors of a joint that sticks are alike for long, so that parts are as long as they may be.
        parts = min(max(math.ceil(BLOCKS_PER_NUMBER * p / windows), 1), rows)
        starts = np.linspace(0, rows, parts, endpoint=False).astype(int)
        return np.add.reduceat(scores, starts, axis=1).reshape(-1, p)


def _covariance(blocks: Blocks) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p p"]]:
    """Covariance of the unknowns with their prior, and what it would be for independent errors."""
    prior = np.eye(len(blocks.zz)) / PRIOR**2
    inverse = np.linalg.inv(blocks.information + prior)
    return block_covariance(blocks.z, blocks.information, inverse, prior), inverse


def _together(windows: Sequence[np.ndarray]) -> np.ndarray:
    """Windows (…, B, R, n) of several logs, those of slower ones with unknown rows at their end."""
    most = max(each.shape[-2] for each in windows)
    ends = [((0, 0),) * (each.ndim - 2) + ((0, most - each.shape[-2]), (0, 0)) for each in windows]
    return np.concatenate([np.pad(*pair, constant_values=np.nan) for pair in zip(windows, ends, strict=True)], axis=-3)
