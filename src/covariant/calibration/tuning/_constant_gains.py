"""Constant gains from logs: several candidates, of which the one is taken that is best on held-out rows.

Designs follow from the noise; the stationary gains are those that a Kalman filter with this noise has in the mean along
the log; searches minimise innovations, and distances of velocities. Two estimates judge that use rows which the
observer has not seen: one from the rows after each only, whose error is independent of the observer's, so that it is
right in the mean even where sizes of the noise are wrong; and the smoother's, which has less scatter. No reference
velocity takes part: where the estimate is better than the reference, comparing with it misleads.

Source: Kalata 1984, The tracking index, IEEE TAES 20(2), for gains of the sampled filter.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.identification import ErrorModel, Filtered, NoiseLevels, mean_square
from covariant.calibration.tuning._gains import gains, predict_sampled_errors
from covariant.calibration.tuning._judge import ErrorRatio
from covariant.calibration.tuning._noise_search import RunErrors, later_errors, smoothed_errors
from covariant.calibration.tuning._tuning_log import Runs, TuningLog, constant_gains
from covariant.models import MechanicalSystem
from covariant.signals import Record
from scalargraph.errors import InputError

FREQUENCIES, DAMPINGS = (2e-3, 3.0), (0.3, 3.0)
"""Bounds of natural frequencies, in radians a sample, and damping ratios. For white disturbances √½ is the best, for
others a larger or a smaller one; below 0.3 an error rings for so long that a log shows it by chance only."""
USUAL = 0.5**0.5
"""Damping ratio that is best for white disturbances."""
GRID = np.geomspace(1 / 6, 6, 9), (0.3, 0.5, 0.8, 1.5, 2.5), (0.0, 0.15, 0.5, 1.0, 2.0)
"""The grid of a search: ω in units of that of the innovations, ζ, and ρ in units of ω."""
FINER = 2
"""Number of times that the grid is made finer around its best."""
DESIGNS = ("model file", "sampled design", "rule", "Kalman filter", "three poles")
"""Candidates that are in place or follow from the noise, in the order in which they are taken from equal ones: a force
is learnt where that is clearly better."""
SLACK = 1.1
"""Ratio of distances to what later rows tell, up to which the smoother decides where the noise has a force: a force
that changes steadily, and not at random, has a share in an estimate's lag and in the error of that from later rows."""
SAME = 1.02
"""Ratio of errors up to which gains are said to be the same."""
VAGUER = 3.0
"""Rows count whose velocity the later rows leave at most so many times as uncertain as usual: before holes they tell
little."""
FAILED = 1e6


class Candidate(NamedTuple):
    """Constant gains, and how near their velocities are to what other rows tell.

    Attributes:
        source: Where they are from: "model file", "rule", "sampled design", "three poles", "Kalman filter",
            "innovations", "later rows" or "smoothed velocities".
        natural_frequency: ω [rad/s].
        damping: ζ.
        error: Distance of held-out velocities to those that the rows after each tell, as a fraction of the velocities,
            root mean square over the coordinates. It contains the error of the latter.
        smoothed: The same distance to the velocities of a smoother.
        force_rate: ρ [1/s]; 0 for an observer without a force.
        ties: Whether it cannot be told from the one with the least `error`.

    Example:
        >>> from covariant.calibration.tuning import Candidate
        >>> Candidate("rule", 20.0, 0.7, error=1e-3, smoothed=9e-4).source
        'rule'
    """

    source: str
    natural_frequency: float
    damping: float
    error: float
    smoothed: float
    force_rate: float = 0.0
    ties: bool = False


Poles = tuple[float, float, float]
"""ω [rad/s], ζ and ρ [1/s]."""


def best_innovations(
    model: MechanicalSystem, logs: list[TuningLog], runs: Runs
) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Natural frequency [rad/s] and damping ratio with the least innovations, and the size (n,) of these."""
    rate, parts = logs[0].rate, [log.first_part for log in logs]
    missing = [np.asarray(jax.vmap(model.manifold.missing)(jnp.asarray(part.y))) for part in parts]
    measured = ~np.concatenate([rows[log.tuned[: len(rows)]] for rows, log in zip(missing, logs, strict=True)])

    def squares(results):
        residuals = [np.asarray(done.info.innovation) for done in results]
        r = np.concatenate([r[log.tuned[: len(r)]] for r, log in zip(residuals, logs, strict=True)])
        return np.array([mean_square(column[mask]) for column, mask in zip(r.T, measured.T, strict=True)])

    def total(results):
        with np.errstate(all="ignore"):
            value = float(np.sum(np.log(squares(results))))
        return value if np.isfinite(value) else FAILED

    def along(z):
        return runs([_observer(model, z, rate)], parts)

    starts = [np.array([w, np.log(USUAL)]) for w in np.linspace(np.log(0.02), np.log(2.0), 8)]
    tried = [runs([_observer(model, z, rate) for z in starts], [part]) for part in parts]  # by part, then by start
    start = starts[int(np.argmin([total(results) for results in zip(*tried, strict=True)]))]
    best, least = _descend(lambda z: total(along(z)), start, 60)
    if least >= FAILED:
        raise InputError("no gains give a finite estimate; check units and signs by `covariant check`")
    return float(np.exp(best[0])) * rate, float(np.exp(best[1])), np.sqrt(squares(along(best)))


def candidates(
    noise: NoiseLevels, systems: Sequence[ErrorModel], filtered: Sequence[Filtered], rate: float
) -> dict[str, Poles]:
    """Natural frequencies [rad/s], damping ratios and force rates [1/s] that follow from the noise, within bounds."""
    std = float(np.sqrt(np.mean(np.asarray(noise.measurement) ** 2)))
    squares = [np.sum((np.asarray(s.input_matrix)[1:] * np.asarray(noise.force)) ** 2, axis=(1, 2)) for s in systems]
    force = float(np.mean(np.concatenate(squares))) / len(noise.measurement)  # mean square of its accelerations
    grid = np.geomspace(*FREQUENCIES, 400) * rate
    time = float(noise.force_time)
    coloured = force / grid**2 if np.isinf(time) else 2 * force * time / (1 + (grid * time) ** 2)
    density = float(noise.acceleration) ** 2 + coloured
    # ω⁴ = S_a(ω)/S_m, with the density of the disturbance at the frequency of the observer itself.
    at = int(np.argmin(np.abs(np.log(grid**4 * std**2 / rate / np.maximum(density, 1e-300)))))
    whole = [np.asarray(system.present).all(axis=1) for system in systems]
    gain = np.concatenate([np.asarray(each.gain)[rows] for each, rows in zip(filtered, whole, strict=True)])
    mean = np.mean(gain[len(gain) // 10 :], axis=0)  # without the first tenth, in which the filter settles
    designs = {
        "rule": (float(grid[at]), USUAL, 0.0),
        "sampled design": (*sampled_design(std, max(float(density[at]), 1e-12 * std**2 * rate**3), rate), 0.0),
        "Kalman filter": (*as_poles(float(mean[0]), float(mean[1]), rate), 0.0),
    }
    if force:
        white = max(float(noise.acceleration), 1e-9 * std * rate**1.5) * np.sqrt(rate)
        three = gains(std, rate, white, force_std=force**0.5, force_time=None if np.isinf(time) else time)
        designs["three poles"] = (*as_frequency(three.alpha, three.beta), three.force_rate)
    found = designs.items()
    return {name: (_within(w / rate, FREQUENCIES) * rate, _within(z, DAMPINGS), r) for name, (w, z, r) in found}


def as_frequency(alpha: float, beta: float) -> tuple[float, float]:
    """Natural frequency [rad/s] and damping ratio of the gains α and β."""
    return beta**0.5, alpha / (2 * beta**0.5)


def as_poles(k1: float, k2: float, rate: float) -> tuple[float, float]:
    """Natural frequency [rad/s] and damping ratio of the poles a, b with `k1 = 1 − ab`, `k2 = (1 − a)(1 − b) rate`."""
    product = float(np.clip(1 - k1, 1e-9, 1 - 1e-9))
    poles = np.asarray(np.roots([1.0, -(1 + product - k2 / rate), product]), complex)
    # A real pole below zero has no continuous one; it is as fast as its size.
    rates = np.log(np.where(np.real(poles) > 0, poles, np.abs(poles))) * rate
    frequency = float(np.sqrt(np.abs(np.prod(rates))))
    return frequency, float(-np.real(np.sum(rates)) / (2 * frequency))


def sampled_design(std: float, density: float, rate: float) -> tuple[float, float]:
    """Natural frequency [rad/s] and damping ratio with the least velocity error of the sampled loop, within bounds."""

    def error(z):
        frequency = float(np.exp(z[0])) * rate
        alpha = 2 * float(np.exp(z[1])) * frequency
        return np.log(predict_sampled_errors(alpha, frequency**2, rate, std, density).velocity_std)

    frequency = _within((density / std**2 * rate) ** 0.25 / rate, FREQUENCIES)
    best, _ = _descend(error, np.log([frequency, USUAL]), 120)
    return float(np.exp(best[0])) * rate, float(np.exp(best[1]))


class Judge(NamedTuple):
    """Velocities (T, n) of a log from the rows after each, and from all rows; and the rows (T,) that count."""

    later: Float[np.ndarray, "T n"]
    smooth: Float[np.ndarray, "T n"]
    rows: Bool[np.ndarray, "T"]
    size: Float[np.ndarray, "n"]

    @classmethod
    def of(cls, run: RunErrors, noise: NoiseLevels, speed: jax.Array) -> "Judge":
        errors, std = later_errors(run.system, noise, speed)
        std, log = np.asarray(std), run.log
        # A variance that rounding made negative has a root that is NaN: such a row does not count.
        rows = np.all(std <= VAGUER * np.nanmedian(std, axis=0), axis=1)
        size = np.sqrt(np.mean(log.velocity[log.tuned | log.held_out] ** 2, axis=0))
        smooth, later = run.corrected(smoothed_errors(run.system, noise, speed)), run.corrected(errors)
        if not ((rows & log.tuned).any() and (rows & log.held_out).any()):
            # What a servo or strong friction damps fast grows in reversed time, until it tells nothing.
            later, rows = smooth, np.isfinite(smooth).all(axis=1)
        return cls(later, smooth, np.asarray(rows), np.maximum(size, np.finfo(float).tiny))

    def distances(self, v: Float[np.ndarray, "K n"], rows: Bool[np.ndarray, "T"]) -> Float[np.ndarray, "R 2"]:
        """Squared distances of the velocities of the first K rows to both, where `rows` count."""
        rows = (rows & self.rows)[: len(v)]
        both = [np.mean(((v - each[: len(v)])[rows] / self.size) ** 2, axis=1) for each in (self.later, self.smooth)]
        return np.where(np.isfinite(both), both, FAILED).T


def best_gains(
    model: MechanicalSystem,
    logs: list[TuningLog],
    proposed: dict[str, Poles],
    judges: list[Judge],
    runs: Runs,
    force: bool,
) -> tuple[tuple[Candidate, ...], Candidate, tuple[float, float]]:
    """Search for gains on the first part of the logs, with those that learn a `force`, and judge on held-out rows.

    Returns all candidates, the one to take, and the range of ω [rad/s] of gains that are as good or better.
    """
    parts = [log.first_part for log in logs]
    tuned, held_out = [log.tuned for log in logs], [log.held_out for log in logs]

    def distances(poles: Sequence[Poles], over: list[Record], masks: list[np.ndarray]) -> list[list[np.ndarray]]:
        """Squared distances (R, 2) by gains and log."""
        observers = [constant_gains(model, *each) for each in poles]
        by_log = []
        for record, mask, judge in zip(over, masks, judges, strict=True):
            estimates = (model.motion(done.estimate).v for done in runs(observers, [record]))
            by_log.append([judge.distances(np.asarray(v), mask) for v in estimates])
        return [list(each) for each in zip(*by_log, strict=True)]

    tried: dict[Poles, np.ndarray] = {}

    def search(poles: Sequence[Poles]) -> None:
        new = [each for each in dict.fromkeys(poles) if each not in tried]
        if new:  # the best gains of both judges may have the same neighbours
            means = [np.concatenate(each).mean(axis=0) for each in distances(new, parts, tuned)]
            tried.update(zip(new, means, strict=True))

    bounds = np.array(FREQUENCIES) * logs[0].rate
    frequencies, dampings, rates = GRID
    at = proposed["innovations"][0]
    rates = rates if force else (0.0,)
    grid = [(_within(w * at, bounds), z, r) for w in frequencies for z in dampings for r in rates]
    search([*proposed.values(), *((w, z, r * w) for w, z, r in grid)])
    ratios = np.array([frequencies[1] / frequencies[0], 1.6, 1.8])
    for _ in range(FINER):
        ratios = ratios**0.5
        for k in range(2):
            w, z, r = min(tried, key=lambda each, k=k: tried[each][k])
            steps = itertools.product((-1, 0, 1), (-1, 0, 1), (-1, 0, 1) if r else (0,))
            near = (np.array([w, z, r]) * ratios**step for step in steps)
            search([(_within(w, bounds), _within(z, DAMPINGS), float(r)) for w, z, r in near])
    by_later, by_smoother = (min(tried, key=lambda each, k=k: tried[each][k]) for k in range(2))
    everything = proposed | {"later rows": by_later, "smoothed velocities": by_smoother}
    squares = distances(list(everything.values()), [log.record for log in logs], held_out)
    judged = chosen(everything, squares, SLACK if force else 1.0)
    best = judged[1]
    most = tried[best.natural_frequency, best.damping, best.force_rate][1]
    same = [w for (w, _, _), each in tried.items() if each[1] <= SAME**2 * most]
    return *judged, (min(same), max(same))


def chosen(
    proposed: dict[str, Poles], squares: Sequence[Sequence[Float[np.ndarray, "_ 2"]]], slack: float = 1.0
) -> tuple[tuple[Candidate, ...], Candidate]:
    """All candidates, and the one to take, by their squared distances by log to both estimates.

    Those that cannot be told from the nearest to the later rows, or are within the slack, are ordered by the smoother,
    and those that tie there too are taken in the order of `DESIGNS`.
    """
    names = list(proposed)
    means = np.array([np.concatenate(each).mean(axis=0) for each in squares])
    near = _ties(squares, range(len(names)), means, 0, slack)
    equal = _ties(squares, near, means, 1)
    order = (*DESIGNS, *names)
    judged = tuple(
        Candidate(name, w, z, float(mean[0]) ** 0.5, float(mean[1]) ** 0.5, r, k in near)
        for k, ((name, (w, z, r)), mean) in enumerate(zip(proposed.items(), means, strict=True))
    )
    return judged, judged[min(equal, key=lambda k: order.index(names[k]))]


def _ties(squares: Sequence, among: Sequence[int], means: np.ndarray, judge: int, slack: float = 1.0) -> list[int]:
    """Those of `among` that are not clearly farther than the nearest, or no farther than the slack."""
    best = min(among, key=lambda k: means[k, judge])
    limit = slack**2 * means[best, judge]

    def told(k: int) -> bool:
        return ErrorRatio.of(*([each[:, judge] for each in squares[which]] for which in (k, best))).is_worse

    return [k for k in among if means[k, judge] <= limit or not told(k)]


def _observer(model: MechanicalSystem, z: np.ndarray, rate: float):
    return constant_gains(model, float(np.exp(z[0])) * rate, float(np.exp(z[1])))


def _descend(cost: Callable[[np.ndarray], float], start: np.ndarray, most: int) -> tuple[np.ndarray, float]:
    """Minimise over the logarithms of frequency and damping, within their bounds."""
    from scipy.optimize import minimize

    bounds = [np.log(FREQUENCIES), np.log(DAMPINGS)]
    simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": most}
    best = minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    return best.x, float(best.fun)


def _within(value: float, bounds: tuple[float, float] | np.ndarray) -> float:
    return float(np.clip(value, bounds[0], bounds[1]))
