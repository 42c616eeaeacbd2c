"""Numbers of a robot from a log: residual accelerations over short windows, weighed as torques, by Gauss–Newton steps.

Positions are smoothed by local polynomials, not themselves but what the model leaves of them: from the positions the
twice integrated accelerations of the model are subtracted first, and added again afterwards. So a reversal, at which
friction jumps, is not rounded off, and the curvature of a polynomial is the residual acceleration, averaged over the
window. Times the inertia matrix it is a residual torque. The derivatives of torques in the numbers, at the model's
accelerations, are the regressor; noise in measured accelerations is not in it, and so makes no number too small.

Source: Gautier, Janot & Vandanjon 2013, A New Closed-Loop Output Error Method, IEEE Transactions on Control Systems
Technology 21(2), and Janot, Vandanjon & Gautier 2014, Robotica 32, on instruments from the model, section 3; Gautier
1991, Numerical calculation of the base inertial parameters of robots, Journal of Robotic Systems 8(4), for the
combinations that a log shows; Huber 1981 for weights; White 1982 for the sandwich by blocks.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from covariant import scoring
from covariant._linalg import solve
from covariant.calibration._least_squares import PRIOR, STD_OF_MEDIAN, block_covariance, minimise_above_bounds, robust
from covariant.calibration.diagnosis import held_inputs
from covariant.calibration.identification._contradictions import Evidence, contradictions
from covariant.calibration.identification._robot_combinations import Combinations
from covariant.calibration.identification._robot_torques import (
    BLOCK,
    FEWEST,
    FEWEST_BLOCKS,
    RESTING,
    WINDOWS,
    Determined,
    Torques,
    averaging,
    convolved,
    needed,
    sticking_speeds,
    usual_sizes,
)
from covariant.models import MechanicalSystem, RobotFamily, applied_force, resistance
from covariant.signals import Record
from scalargraph.errors import InputError

FINE = 12
"""Points of the grid in half of the shortest window."""
MOST_POINTS = 40_000
"""Largest number of points of the grid of all logs: beyond it the grid is coarser."""
MOST_ROWS = 6_000
"""Largest number of points of the grid at which derivatives are computed."""
ROUNDS, MORE_ROUNDS = 8, 4
"""Most rounds with the shortest window, and after another one has been chosen."""
CONVERGED = 0.05
"""A step is the last one when it changes no number by more than this fraction of its standard error."""
LONGEST_STEP = 1.0
"""Longest step of a coordinate in its usual size."""
FULL = 0.6
"""Fraction of the usual number of samples that a window must hold to be used."""
ROUNDING = 1e-10
"""A value that has come below this fraction of its prior standard deviation is zero but for rounding."""
SHORTEST = 12.0
"""Least duration of the logs, in half windows."""
STILL, MOSTLY = 8.0, 0.9
"""A joint that rests for this fraction of so many half windows is held by its friction: the model does not move it."""
ORDER = 3


class RobotFit(NamedTuple):
    """Numbers of a robot fitted to logs.

    Attributes:
        names: Names (p,) of the numbers.
        first: First values (p,).
        values: Fitted values (p,).
        standard_errors: Standard errors (p,), robust to residuals that are alike within a block; NaN for a number that
            the log does not show by itself, which stays near its first value.
        determined: Whether the log determines each number (p,) by itself: it shows the number, and can tell it, or else
            a tenth of its usual size, from zero.
        combinations: What the log determines of numbers that it cannot tell apart.
        torque: Robust standard deviation (n,) of the residual torques [N m or N].
        half: Half width [s] of the windows.
        coordinates: Coordinates (p,) of the family.
        losses: Negative log-likelihood (B,) of each block of the logs, up to a constant.
        unlike: Sentences on machines whose logs contradict a number that all machines share.
        likeliest: Whether the numbers are those of the greatest likelihood, and not those by residual torques.
        kept: Joints whose numbers are the first ones, since those predict better.
        alike: Pairs of names of numbers that the logs hardly separate, with the correlation of their errors.
        beyond: Names of limits that no log reaches, with the largest torque [N m or N] that the logs demand.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import RobotFit
        >>> from covariant.calibration.identification import Combinations
        >>> none = Combinations((), (), 1)
        >>> one = np.ones(1)
        >>> fitted = RobotFit(("gravity",), one, 9.8 * one, 0.1 * one, one > 0, none, one, 0.03, one, one)
        >>> fitted.determined.tolist()
        [True]
    """

    names: tuple[str, ...]
    first: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "p"]
    standard_errors: Float[np.ndarray, "p"]
    determined: Bool[np.ndarray, "p"]
    combinations: Combinations
    torque: Float[np.ndarray, "n"]
    half: float
    coordinates: Float[np.ndarray, "p"]
    losses: Float[np.ndarray, "B"]
    unlike: tuple[str, ...] = ()
    likeliest: bool = False
    kept: tuple[str, ...] = ()
    alike: tuple[tuple[str, str, float], ...] = ()
    beyond: tuple[tuple[str, float], ...] = ()

    def without(self, family: RobotFamily, joints: Bool[np.ndarray, "n"]) -> "RobotFit | None":
        """The fit with the first values of the numbers of some joints (n,); None where none or all are theirs."""
        held = np.array([number.joint >= 0 and bool(joints[number.joint]) for number in family.numbers])
        if not held.any() or held.all():
            return None
        x = np.where(held, 0.0, self.coordinates)
        return self._replace(
            values=np.asarray(jax.jit(family.values)(x)),
            standard_errors=np.where(held, np.nan, self.standard_errors),
            determined=self.determined & ~held,
            coordinates=x,
            kept=tuple(np.array(family.file.columns.q)[joints].tolist()),
        )


def fit_robot(
    family: RobotFamily,
    records: Sequence[Record],
    half: float,
    progress: Callable[[int], object] = lambda _: None,
    start: RobotFit | None = None,
    machines: Sequence[int] | None = None,
) -> RobotFit:
    """Fit open numbers of a robot to logs.

    It fits masses, inertias, friction and gravity of a robot from residual torques, without a simulation of the motion,
    so that many numbers at once are no problem. `fit` is for any other model, and compares predicted positions. Use a
    motion that excites all joints, as from `covariant.design_excitation`: a slow log determines only gravity and
    friction. The verb `covariant.fit` starts from files, and holds out rows to judge the result.

    Args:
        family: The robot as a function of its p open numbers, from `models.robot_family`.
        records: The logs, with the inputs that act in each step.
        half: Half width [s] of the shortest window.
        progress: Called with the number of each round.
        start: A fit to other inputs, from whose numbers the search starts, with its window.
        machines: Index of the machine of each log, of a family of several; by default one machine has made all.

    Returns:
        Values, standard errors, and the combinations that the logs determine.

    Raises:
        ValueError: The logs are too short, or the model predicts no finite acceleration.

    Example:
        >>> import covariant
        >>> from covariant import models
        >>> from covariant.calibration import fit_robot
        >>> arm = {"rate": 200.0, "duration": 20.0, "amplitude": [1.0, 0.4], "noise": 1e-5}
        >>> log = covariant.simulate("double_pendulum", **arm)
        >>> result = fit_robot(models.robot_family("double_pendulum", ["gravity"]), [log.record], 0.05)
        >>> bool(abs(result.values[0] - 9.81) < 0.01)
        True
    """
    search = _Search.of(family, records, half, [0] * len(records) if machines is None else machines)
    x = np.zeros(len(family.names)) if start is None else start.coordinates
    point = search.point(x, search.tracks[0].half if start is None else start.half)
    rounds = itertools.count()
    for most in (ROUNDS, MORE_ROUNDS) if start is None else (ROUNDS,):
        for _ in range(most):
            progress(next(rounds))
            step = search.step(point)
            point = search.point(point.x + step.dx, point.half, point.motions)
            if step.settled:
                break
        if most == ROUNDS and start is None:
            point = search.with_best_window(point)
    solution = search.step(point)
    known = Determined.of(family, point.x, search.sizes, solution.information, solution.covariance)
    values = rounded_values(np.asarray(jax.jit(family.values)(point.x)), family.first, known.prior)
    unlike = search.unlike(point, values) if len(family.parts) > 1 else ()
    reached = solution.scale, point.half, point.x, solution.losses
    return RobotFit(family.names, family.first, values, *known[:3], *reached, unlike)


class _Track(NamedTuple):
    """A log, its grid of K even times, inputs averaged around these, and the shortest half window."""

    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    grid: Float[np.ndarray, "K"]
    u: Float[np.ndarray, "K m"]
    half: float

    @property
    def step(self) -> float:
        return float(self.grid[1] - self.grid[0])


class _Path(NamedTuple):
    """Motion (K, n) along a grid, the accelerations of the model, the residual ones, and the points that are used."""

    q: Float[np.ndarray, "K n"]
    v: Float[np.ndarray, "K n"]
    modelled: Float[np.ndarray, "K n"]
    residual: Float[np.ndarray, "K n"]
    used: Bool[np.ndarray, "K"]


class _Point(NamedTuple):
    """Coordinates x (p,) of the numbers, the half window, and the motion along each log under the model at x."""

    x: Float[np.ndarray, "p"]
    half: float
    motions: tuple[_Path, ...]


class _Step(NamedTuple):
    """A step of the coordinates, with their covariance, the information about them, the scale of the torques, and the
    negative log-likelihood (B,) of each block."""

    dx: Float[np.ndarray, "p"]
    covariance: Float[np.ndarray, "p p"]
    information: Float[np.ndarray, "p p"]
    scale: Float[np.ndarray, "n"]
    settled: bool
    losses: Float[np.ndarray, "B"]


class _Rows(NamedTuple):
    """Residual torques at rows of all logs, their derivatives and robust losses in units of their scale, which of them
    count, the block and the machine of each row, the part of the rows that is independent, and scores of the blocks."""

    slopes: Float[np.ndarray, "r n p"]
    torque: Float[np.ndarray, "r n"]
    counts: Bool[np.ndarray, "r n"]
    scale: Float[np.ndarray, "r n"]
    loss: Float[np.ndarray, "r n"]
    weight: Float[np.ndarray, "r n"]
    block: Int[np.ndarray, "r"]
    machine: Int[np.ndarray, "r"]
    thinned: float
    scores: Float[np.ndarray, "B p"]


class _Search(NamedTuple):
    """What a fit works on: the family, the logs, the machine of each and where its k numbers are among all p, usual
    sizes (p,), the speeds (n,) below which a joint rests, and below which it may stick, and functions of the
    coordinates (k,) of a machine and rows of a motion."""

    family: RobotFamily
    tracks: tuple[_Track, ...]
    machines: tuple[int, ...]
    parts: Int[np.ndarray, "L k"]
    sizes: Float[np.ndarray, "p"]
    resting: Float[np.ndarray, "n"]
    sticking: Float[np.ndarray, "n"]
    derivatives: Callable[..., np.ndarray]
    accelerations: Callable[..., np.ndarray]
    momenta: Callable[..., np.ndarray]

    @classmethod
    def of(cls, family: RobotFamily, records: Sequence[Record], half: float, machines: Sequence[int]) -> "_Search":
        model = family.file.model
        total = sum(float(record.t[-1] - record.t[0]) for record in records)
        tracks = tuple(_track(record, half, model.circles, total) for record in records)
        paths = [_smooth_positions(track, track.half, None) for track in tracks]
        q, v, a = (np.concatenate([getattr(p, name)[p.used] for p in paths]) for name in ("q", "v", "residual"))
        u = np.concatenate([track.u[path.used] for track, path in zip(tracks, paths, strict=True)])
        if len(v) < SHORTEST * FINE:
            raise InputError(
                f"the logs hold {len(v) * tracks[0].step:.3g} s without a gap, and a fit needs "
                f"{SHORTEST * tracks[0].half:.3g} s; give longer logs"
            )
        parts = family.parts[list(machines)]
        torques, first = Torques.of(family.one), np.zeros(parts.shape[1])
        both = torques.rows(driving)(first, u), torques.rows(needed)(first, q, v, a)
        sizes, speed = usual_sizes(family, *both, v, a)
        functions = torques.derivatives, torques.rows(accelerations), torques.rows(_momentum)
        speeds = np.array(family.resting), sticking_speeds(family, speed)
        return cls(family, tracks, tuple(machines), parts, sizes, *speeds, *functions)

    def point(self, x: np.ndarray, half: float, before: tuple[_Path, ...] | None = None) -> _Point:
        """The motion along each log under the model at x: smoothed with the accelerations along the motion before."""
        motions = []
        for i, track in enumerate(self.tracks):
            path = before[i] if before else _smooth_positions(track, track.half, None)
            moving = 1.0 - self._still(track, path.v)
            modelled = self.accelerations(x[self.parts[i]], path.q, path.v, track.u, moving)
            motions.append(_smooth_positions(track, half, np.where(np.isfinite(modelled), modelled, 0.0)))
        if not any(motion.used.any() for motion in motions):
            raise InputError("no window of the logs is complete; give logs with fewer gaps")
        return _Point(x, half, tuple(motions))

    def _still(self, track: _Track, v: np.ndarray) -> np.ndarray:
        """Joints (K, n) that friction holds, 1 where it does: at rest for long."""
        box = np.ones(int(STILL * track.half / track.step) + 1)
        rests, rows = (convolved(each, box) for each in ((np.abs(v) < self.resting).astype(float), np.ones_like(v)))
        return (rests > MOSTLY * rows).astype(float)

    def with_best_window(self, point: _Point) -> _Point:
        """The same numbers with the window that makes their standard errors smallest."""
        shortest = min((track.grid[-1] - track.grid[0]) for track in self.tracks)
        tried = []
        for factor in WINDOWS:
            half = factor * self.tracks[0].half
            if factor > 1 and half * FEWEST_BLOCKS * BLOCK > shortest:
                break
            other = self.point(point.x, half, point.motions)
            step = self.step(other)
            tried.append((float(np.linalg.slogdet(step.covariance / np.outer(self.sizes, self.sizes))[1]), other))
        return min(tried, key=lambda each: each[0])[1]

    def step(self, point: _Point) -> _Step:
        """Gauss–Newton step from a point, with the covariance of the numbers."""
        rows = self._weighed(point)
        z, counts, weight = rows.slopes, rows.counts, rows.weight
        sums = (np.einsum("kjp,kj,kjq->pq", z, counts * each, z, optimize=True) for each in (weight, weight**3))
        information, curvature = (rows.thinned * each for each in sums)
        prior = np.eye(len(self.sizes)) / PRIOR**2
        gradient = np.sum(rows.scores, axis=0) + prior @ (point.x / self.sizes)
        covariance = block_covariance(rows.scores, curvature, np.linalg.inv(curvature + prior), prior)
        dz = minimise_above_bounds(information + prior, gradient, (self.family.least - point.x) / self.sizes)
        dz *= min(1.0, LONGEST_STEP / max(np.abs(dz).max(), 1e-300))
        settled = bool(np.all(np.abs(dz) < CONVERGED * np.sqrt(np.diagonal(covariance))))
        outer = np.outer(self.sizes, self.sizes)
        # The logarithm of the scale normalises the density.
        losses = rows.thinned * np.bincount(rows.block, np.sum(counts * (rows.loss + np.log(rows.scale)), axis=1))
        scale = _scales(rows.torque, counts)
        return _Step(dz * self.sizes, covariance * outer, information / outer, scale, settled, losses)

    def unlike(self, point: _Point, values: Float[np.ndarray, "p"]) -> tuple[str, ...]:
        """Sentences on machines whose logs contradict a number that all machines share."""
        rows, parts = self._weighed(point), self.family.parts
        # Below its bound a number is held, though the logs of any machine alone would lower it.
        free = (point.x > self.family.least) | (np.sum(rows.scores, axis=0) < 0)
        scores, machine = rows.scores * free, np.zeros(len(rows.scores), int)
        machine[rows.block] = rows.machine
        information = np.zeros((len(scores), parts.shape[1], parts.shape[1]))
        whole = np.eye(len(self.sizes)) / PRIOR**2
        for b, part in enumerate(parts[machine]):
            here = rows.block == b
            z, weight = rows.slopes[here][:, :, part] * free[part], rows.counts[here] * rows.weight[here] ** 3
            information[b] = rows.thinned * np.einsum("kjp,kj,kjq->pq", z, weight, z, optimize=True)
            whole[np.ix_(part, part)] += information[b]
        evidence = Evidence(machine, np.take_along_axis(scores, parts[machine], axis=1), information)
        slopes = np.asarray(jax.jit(jax.jacfwd(self.family.values))(point.x)) * self.sizes
        return contradictions(self.family.names, parts, values, slopes, evidence, np.linalg.inv(whole))

    def _weighed(self, point: _Point) -> _Rows:
        """Rows of all logs at a point, weighed by the scale of the torques of their machine."""
        rows = [self._rows(point, i) for i in range(len(self.tracks))]
        slopes, torque, counts, blocks = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        # Machines may differ in their noise, and in what the model lacks of them.
        whose = np.repeat(self.machines, [len(torque) for _, torque, *_ in rows])
        scale = np.ones_like(torque)
        for m in set(self.machines):
            scale[whose == m] = _scales(torque[whose == m], counts[whose == m])
        relative = torque / scale
        loss, weight = robust(relative)
        z = slopes / scale[:, :, None] * self.sizes
        # Neighbouring windows overlap: as many rows are independent as half windows fit into the log.
        _, numbering = np.unique(blocks, return_inverse=True)
        thinned = min(1.0, BLOCK * (numbering.max() + 1) / len(blocks))
        scores = np.zeros((numbering.max() + 1, len(self.sizes)))
        np.add.at(scores, numbering, thinned * np.einsum("kjp,kj->kp", z, counts * weight * relative, optimize=True))
        return _Rows(z, torque, counts, scale, loss, weight, numbering, whose, thinned, scores)

    def _rows(self, point: _Point, i: int):
        """Derivatives (r, n, p) of the torques, residual torques (r, n), which count, and the block of each row."""
        track, path = self.tracks[i], point.motions[i]
        own = point.x[self.parts[i]]
        total = sum(len(one.grid) for one in self.tracks)
        stride = max(1, -(-total // MOST_ROWS), int(point.half / 4 / track.step))
        rows = np.arange(0, len(track.grid), stride)
        of_machine = self.derivatives(own, path.q[rows], path.v[rows], path.modelled[rows], track.u[rows])
        raw = np.zeros((*of_machine.shape[:2], len(point.x)))
        raw[:, :, self.parts[i]] = of_machine
        weights = averaging(point.half, track.step * stride)
        slopes = convolved(np.where(np.isfinite(raw), raw, 0.0), weights)
        torque = self.momenta(own, path.q[rows], path.residual[rows])
        slow = (np.abs(path.v[rows]) < self.sticking).astype(float)
        sticks = convolved(slow, np.abs(weights) / np.abs(weights).sum())
        used = path.used[rows]
        counts = (sticks < RESTING)[used]
        block = np.floor((track.grid[rows][used] - track.grid[0]) / (BLOCK * point.half)).astype(int)
        return slopes[used], torque[used], counts, block + 1_000_000 * i


def _track(record: Record, half: float, circles: tuple[int, ...], total: float) -> _Track:
    t, u = np.asarray(record.t, float), np.asarray(record.u, float)
    half = max(half, FEWEST * float(np.median(np.diff(t))))
    step = max(half / FINE, total / MOST_POINTS)
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step) + 1)
    return _Track(t, scoring.unwrap(np.asarray(record.y, float), circles), grid, held_inputs(t, u, grid, step), half)


def _smooth_positions(track: _Track, half: float, modelled: np.ndarray | None) -> _Path:
    """Smooth what accelerations along the grid leave of the positions; without them the positions themselves."""
    from scipy.interpolate import CubicHermiteSpline

    t, y, grid, step = track.t, track.y, track.grid, track.step
    if modelled is None:
        modelled = np.zeros((len(grid), y.shape[1]))
    # The mean over a cell around each point changes the velocity from the middle of one step to that of the next.
    middle = np.cumsum(modelled, axis=0) * step
    places = np.concatenate([np.zeros_like(middle[:1]), np.cumsum(middle[:-1], axis=0) * step])
    speeds = middle - modelled * step / 2
    left = y - CubicHermiteSpline(grid, places, speeds)(t)
    c = scoring.local_polynomials(t, left, grid, half, ORDER)
    used = (grid >= t[0] + half) & (grid <= t[-1] - half)
    for column in np.isfinite(y).T:
        seen = t[column]
        held = np.searchsorted(seen, grid + half) - np.searchsorted(seen, grid - half)
        used &= held >= FULL * 2 * half / float(np.median(np.diff(seen)))
    return _Path(places + c[:, 0], speeds + c[:, 1], modelled, 2 * c[:, 2], used)


def rounded_values(values: np.ndarray, first: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """The values, with zero for those that have become zero but for rounding; those that did not move are no such."""
    size = np.abs(values)
    return np.where((size < ROUNDING * prior) & (size <= np.abs(values - first)), 0.0, values)


def _scales(torque: Float[np.ndarray, "k n"], counts: Bool[np.ndarray, "k n"]) -> Float[np.ndarray, "n"]:
    """Robust standard deviations of the torques that count."""
    return np.array([scale_of(torque[counts[:, j], j]) for j in range(torque.shape[1])])


def scale_of(values: np.ndarray) -> float:
    """Robust standard deviation of finite values; 1 where there are none."""
    values = values[np.isfinite(values)]
    return float(max(STD_OF_MEDIAN * np.median(np.abs(values)), 1e-12)) if len(values) else 1.0


def _momentum(model: MechanicalSystem, q: Array, a: Array) -> Array:
    return model.space.lower(q, a)


def accelerations(model: MechanicalSystem, q: Array, v: Array, u: Array, moving: Array) -> Array:
    """Accelerations (n,) of the joints that move; the others are held, by whatever torque that takes."""
    t = jnp.zeros(())
    covector = applied_force(model, t, q, u) + resistance(model, t, q, v, u) - model.space.connection_force(q, v, v)
    held = model.space(q) * moving[:, None] * moving[None, :] + jnp.diag(1.0 - moving)
    return solve(held, covector * moving)


def driving(model: MechanicalSystem, u: Array) -> Array:
    """Torques (n,) of the inputs u (m,)."""
    return model.force(jnp.zeros(()), model.manifold.origin(), u)
