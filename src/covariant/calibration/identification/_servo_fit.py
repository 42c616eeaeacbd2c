"""Fit of a robot with servos to commands and positions: prediction errors over windows, Levenberg–Marquardt steps.

A servo holds its joint so firmly that residual accelerations contain little information on it; the positions through
which the joint moves, and at which it stops, contain more. So positions are predicted over windows from the commands
alone.

Source: Huber 1981 for the weights; White 1982 for the sandwich covariance, here over blocks.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration._least_squares import PRIOR, block_covariance, robust
from covariant.calibration.identification._robot_fit import RobotFit, minimise_above_bounds, scale_of
from covariant.calibration.identification._robot_torques import Determined, usual_sizes
from covariant.calibration.identification._servo_motion import ServoLog
from covariant.models import RobotFamily
from covariant.signals import Record
from scalargraph.errors import InputError

WINDOW = 2.0
"""Length of a window [s]: the effect of the initial state decays within a few tenths of a second."""
SETTLING = 0.2
"""Time at the start of a window [s] that does not count, since the initial speed is only roughly known."""
MIN_WINDOWS = 8
BLOCKS_PER_NUMBER = 3
"""Least number of blocks per fitted number: with too few blocks their covariance has no full rank."""
MAX_ROUNDS = 25
TOLERANCE = 3e-3
"""Relative decrease of the loss below which the search stops."""
RELATIVE_ACCURACY, TIME_ACCURACY = 2e-3, 2e-4
"""Integration error in the fitted numbers: relative, and for times such as a delay absolute [s]."""
DIFFERENCE_STEP = 1e-4
"""Step of the finite differences, in usual sizes: it moves a joint by some 0.01 µm, which is far above rounding."""
MIN_RATIO = 0.02
"""Least value of a number that must be positive, relative to its first value."""
POSITIVE_NUMBERS = ("stiffness", "resistance", "torque_constant", "stribeck_velocity", "limit")
RIGID_BODY_GROUPS = ("payload", "inertia", "gravity", "offsets")
"""Groups of open numbers that change the rigid body."""
FIRST_DELAYS, STIFFNESS_FACTORS = (0.0, 0.02, 0.04, 0.08), (0.5, 1.0, 2.0)
"""Delays [s], and factors on the first stiffness, that are tried as starting points of the search."""
DELAY_SHIFTS = 0.015, -0.01
"""Changes of the fitted delay [s] from which the search starts again."""


def fit_servos(
    families: Sequence[RobotFamily],
    records: Sequence[Record],
    between: str = "held",
    progress: Callable[[int], object] = lambda _: None,
    length: float | None = None,
    late: float = 0.0,
) -> RobotFit:
    """Fit open numbers of a robot with servos to logs of commands and positions.

    Positions are predicted over windows from the commands alone, with dry friction that sticks. The search starts from
    several delays and stiffnesses, and again from other delays after the first fit, since delay and lead are similar.

    Args:
        families: The robot as a function of its p open numbers, from `models.robot_family`, one for each log. Settings
            that are not open, such as a gain or a known payload, may differ between logs.
        records: The logs, with the commands at the stamps at which they were sent.
        between: "held" if a command is constant until the next stamp, "linear" if it is linear between stamps.
        progress: Called with the number of each round.
        length: Length of the windows [s]; by default 2 s, and less for short logs. Longer windows suit joints that
            stick for seconds.
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
    search = _Search.of(families, records, between, length, late)
    rounds = itertools.count()
    point = search.descend(search.started(), lambda: progress(next(rounds)))
    # A delay and a lead differ only where the command jumps, so there is a local minimum on either side of a fit.
    for x in search.shifted(point.x):
        other = search.descend(search.point(x), lambda: progress(next(rounds)))
        scale = search.normal(point).scale
        point = min(point, other, key=lambda each: search.loss(each, scale))
    step = search.normal(point)
    family = families[0]
    # Integration steps of a few milliseconds bias the numbers in every window alike, which blocks do not show.
    values = np.asarray(family.values(point.x))
    stiffness = float(np.max(np.asarray(search.logs[0].drive(point.x).servos.stiffness)))
    # A feedforward is a lead times a stiffness, and a lead is a time like a delay.
    of_times = {"delay": TIME_ACCURACY, "feedforward": TIME_ACCURACY * stiffness}
    times = [of_times.get(number.number, 0.0) if number.group == "servo" else 0.0 for number in family.numbers]
    integration_error = np.where(np.array(times) > 0, times, RELATIVE_ACCURACY * np.abs(values))
    known = Determined.of(
        family, point.x, search.sizes, step.information, step.covariance + np.diag(integration_error**2)
    )
    reached = step.scale, (WINDOW if length is None else length) / 2, point.x, step.losses
    return RobotFit(family.names, family.first, values, *known.said, *reached)


class _Point(NamedTuple):
    """Coordinates x (p,), residuals (B, R, n) of all windows, and their derivatives (p, B, R, n) by usual sizes."""

    x: Float[np.ndarray, "p"]
    residual: Float[np.ndarray, "B R n"]
    slopes: Float[np.ndarray, "p B R n"]


class _Normal(NamedTuple):
    """The normal equations at a point, in usual sizes, with the information and the covariance of the numbers."""

    matrix: Float[np.ndarray, "p p"]
    gradient: Float[np.ndarray, "p"]
    least: Float[np.ndarray, "p"]
    sizes: Float[np.ndarray, "p"]
    scale: Float[np.ndarray, "n"]
    information: Float[np.ndarray, "p p"]
    covariance: Float[np.ndarray, "p p"]
    losses: Float[np.ndarray, "B"]

    def to(self, damping: float) -> np.ndarray:
        """Damped step of the coordinates (p,) that stays above their bounds."""
        damped = self.matrix + damping * np.diag(np.diagonal(self.matrix))
        step = np.clip(minimise_above_bounds(damped, self.gradient, self.least), -1.5, 1.5)
        return step * self.sizes


class _Search(NamedTuple):
    """Logs and their windows, with the usual sizes and lower bounds of the open numbers."""

    logs: tuple[ServoLog, ...]
    rows: tuple[np.ndarray, ...]
    counts: tuple[int, ...]
    sizes: Float[np.ndarray, "p"]
    least: Float[np.ndarray, "p"]
    rigid: tuple[int, ...]

    @classmethod
    def of(
        cls, families: Sequence[RobotFamily], records: Sequence[Record], between: str, length: float | None, late: float
    ) -> "_Search":
        family = families[0]
        logs = tuple(ServoLog.of(each, record, between, late) for each, record in zip(families, records, strict=True))
        min_windows = MIN_WINDOWS
        if length is None:
            # A covariance over blocks needs more than about 16 windows, so the windows of short logs are shorter.
            total = sum(float(log.t[-1] - log.t[0]) for log in logs)
            length = max(min(WINDOW, total / (2 * min_windows + 1)), 3 * SETTLING)
        else:
            min_windows = 2
        windows = [log.windows(length) for log in logs]
        counts = tuple(len(each) for each in windows)
        if sum(counts) < min_windows:
            raise InputError(
                f"the logs hold {sum(counts)} windows of {length:.3g} s without a gap, and a fit needs "
                f"{min_windows}; give longer logs"
            )
        # All logs have the same number of windows, so that one compiled program serves all; copies do not count.
        max_windows = max(counts)
        padded = [each + each[:1] * (max_windows - len(each)) for each in windows if each]
        logs = tuple(log for log, each in zip(logs, windows, strict=True) if each)
        rows = tuple(np.stack(each) for each in padded)
        motion = [np.concatenate([getattr(log, name) for log in logs]) for name in ("q", "v", "a")]
        body = logs[0].evaluate(np.zeros(len(family.names)), motion[0], motion[1])
        armature = np.asarray(logs[0].drive(np.zeros(len(family.names))).armature)
        inertia = body.inertia + np.diag(armature)
        torque = np.einsum("tij,tj->ti", inertia, motion[2]) + body.coriolis + body.slope
        servos = logs[0].drive(np.zeros(len(family.names))).servos
        directions, commanded = np.asarray(servos.rows), np.asarray(servos.commands)
        errors = np.concatenate([log.u for log in logs]) @ commanded.T - motion[0] @ directions.T
        servo_torques = (errors - np.asarray(servos.zero)) * np.asarray(servos.stiffness) @ np.abs(directions)
        sizes, _ = usual_sizes(family, servo_torques, torque, *motion[1:])
        # If the file states a stiffness, a speed or a limit, that value is its usual size.
        has_positive_number = np.array([number.number in POSITIVE_NUMBERS for number in family.numbers])
        sizes = np.where(has_positive_number & (np.abs(family.first) > 0), np.abs(family.first), sizes)
        least = np.where(
            has_positive_number, np.maximum(family.least, -(1 - MIN_RATIO) * np.abs(family.first)), family.least
        )
        rigid = tuple(i for i, number in enumerate(family.numbers) if number.group in RIGID_BODY_GROUPS)
        return cls(logs, rows, tuple(count for count in counts if count), sizes, least, rigid)

    def started(self) -> _Point:
        """The first values, with the delay and the stiffness among those tried that predict best."""
        family = self.logs[0].family
        kinds = [number.number if number.group == "servo" else "" for number in family.numbers]
        late = np.array([kind == "delay" for kind in kinds])
        is_stiffness = np.array([kind == "stiffness" for kind in kinds])
        points = []
        for delay in (None, *FIRST_DELAYS) if late.any() else (None,):
            x = np.zeros(len(kinds)) if delay is None else np.where(late, delay - family.first, 0.0)
            candidates = [
                np.where(is_stiffness, (factor - 1) * family.first, x)
                for factor in STIFFNESS_FACTORS[: 3 if is_stiffness.any() else 1]
            ]
            candidates = [np.maximum(candidate, self.least) for candidate in candidates]
            # Batches have the size of a point's batch, so that one compiled program serves both.
            candidates = (candidates * (len(kinds) + 1))[: max(len(kinds) + 1, 1)]
            residuals = self._residuals(candidates, candidates[0], [], np.zeros((len(candidates), len(self.rigid))))
            points += [
                _Point(candidate, each, residuals[:0]) for candidate, each in zip(candidates, residuals, strict=True)
            ]
        scale = np.array([scale_of(column) for column in points[0].residual.reshape(-1, points[0].residual.shape[2]).T])
        best = min(points, key=lambda point: self.loss(point, scale))
        if not np.isfinite(self.loss(best, scale)):
            raise InputError("the model predicts no finite motion from these commands; check units and first values")
        return self.point(best.x)

    def descend(self, point: _Point, report: Callable[[], object]) -> _Point:
        """The point that Levenberg–Marquardt steps reach, with a report before each round."""
        damping = 1e-3
        for _ in range(MAX_ROUNDS):
            report()
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
        return point

    def shifted(self, x: np.ndarray) -> list[np.ndarray]:
        """Coordinates with changed delays, and with leads that compensate for the change."""
        family = self.logs[0].family
        at = {(n.target, n.number): i for i, n in enumerate(family.numbers) if n.group == "servo"}
        leads = [
            (i, at[target, "delay"], target)
            for (target, kind), i in at.items()
            if kind == "feedforward" and (target, "delay") in at
        ]
        if not leads:
            return []
        values, servos = np.asarray(family.values(x)), self.logs[0].drive(x).servos
        stiffness = dict(zip(servos.input_names, np.asarray(servos.stiffness), strict=False))
        others = []
        for shift in DELAY_SHIFTS:
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
        steps = DIFFERENCE_STEP * self.sizes * np.eye(p)
        weights = np.zeros((p + 1, len(self.rigid)))
        for k, i in enumerate(self.rigid):
            weights[1 + i, k] = 1.0
        batch = self._residuals([x, *(x + step for step in steps)], x, [steps[i] for i in self.rigid], weights)
        return _Point(x, batch[0], (batch[1:] - batch[:1]) / DIFFERENCE_STEP)

    def _residuals(
        self, candidates: Sequence[np.ndarray], x: np.ndarray, steps: Sequence[np.ndarray], weights: np.ndarray
    ) -> np.ndarray:
        """Residuals (P, B, R, n) of drives at P coordinates, with the rigid body at x and its changes by `steps`."""
        parts = []
        for log, rows, count in zip(self.logs, self.rows, self.counts, strict=True):
            body_steps = steps if len(steps) == weights.shape[1] else [np.zeros_like(x)] * weights.shape[1]
            q = log.simulate([log.drive(candidate) for candidate in candidates], x, rows, weights, body_steps)
            parts.append((q - log.y[rows])[:, :count, self._skipped(log) :])
        return np.concatenate(parts, axis=1)

    @staticmethod
    def _skipped(log: ServoLog) -> int:
        return max(round(SETTLING / float(np.median(np.diff(log.t)))), 1)

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
        """Number of rows that count as one independent error: a tenth of a window."""
        return max(1.0, self._measured.shape[1] / 10)

    def normal(self, point: _Point) -> _Normal:
        """The normal equations at a point."""
        measured = np.isfinite(self._measured)
        residual = np.where(measured, point.residual, 0.0)
        n = residual.shape[2]
        scale = np.array([scale_of(residual[..., j][measured[..., j]]) for j in range(n)])
        e = residual / scale
        loss, weight = robust(e)
        z = np.where(measured, point.slopes, 0.0) / scale
        z = np.where(np.isfinite(z), z, 0.0)
        share = 1 / self._alike
        flat = z.reshape(len(z), -1)
        information, curvature = (share * (flat * w.ravel()) @ flat.T for w in (weight, weight**3))
        scores = share * self._by_blocks(np.einsum("pbkj,bkj->bkp", z, weight * e, optimize=True))
        prior = np.eye(len(z)) / PRIOR**2
        gradient = scores.sum(axis=0) + prior @ (point.x / self.sizes)
        covariance = block_covariance(scores, curvature, np.linalg.inv(curvature + prior), prior)
        outer = np.outer(self.sizes, self.sizes)
        losses = share * np.sum((loss + np.log(scale)) * measured, axis=(1, 2))
        least = (self.least - point.x) / self.sizes
        return _Normal(
            information + prior, gradient, least, self.sizes, scale, curvature / outer, covariance * outer, losses
        )

    @staticmethod
    def _by_blocks(scores: np.ndarray) -> np.ndarray:
        """Sums (B, p) of scores (W, R, p) over blocks: windows, or parts of windows if there are few."""
        windows, rows, p = scores.shape
        # Errors of a joint that sticks are alike for long: parts of a window are the last resort.
        parts = 1 if windows >= MIN_WINDOWS else min(math.ceil(BLOCKS_PER_NUMBER * p / windows), rows)
        starts = np.linspace(0, rows, parts, endpoint=False).astype(int)
        return np.add.reduceat(scores, starts, axis=1).reshape(-1, p)
