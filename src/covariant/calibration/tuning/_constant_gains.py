"""Constant gains from logs: several candidates, of which the one is taken that predicts held-out measurements best.

The rule and the sampled design follow from the noise; the stationary gains are those that a Kalman filter with this
noise has in the mean along the log; two searches minimise innovations, and errors of predictions further ahead. No
reference velocity takes part: where the estimate is better than the reference, comparing with it misleads.

A force that the model does not know pushes every prediction the same way, and an estimate lags to that side: both add
up, so that predictions favour gains that are too fast. Where the noise has such a force, velocities are compared
instead with those of the smoother that estimates the force, which orders estimates as their errors do.

Source: Kalata 1984, The tracking index, IEEE TAES 20(2), for gains of the sampled filter; Ljung 1999, System
Identification, section 7.4, for prediction errors.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.identification import (
    ErrorModel,
    Filtered,
    NoiseLevels,
    errors_ahead,
    mean_square,
    rows_ahead,
    size,
)
from covariant.calibration.tuning._gains import predict_sampled_errors
from covariant.calibration.tuning._tuning_log import Runs, TuningLog, intrinsic
from covariant.models import MechanicalSystem, Motion
from covariant.signals import Record

FREQUENCIES, DAMPINGS = (2e-3, 3.0), (0.3, 3.0)
"""Bounds of natural frequencies, in radians a sample, and damping ratios. For white disturbances √½ is the best, for
others a larger or a smaller one; below 0.3 an error rings for so long that a log shows it by chance only."""
USUAL = 0.5**0.5
"""Damping ratio that is best for white disturbances."""
DESIGNS, SLACK = ("sampled design", "rule", "Kalman filter", "model file"), 1.05
"""Candidates that follow from the noise or are in place, the first ones best for velocities where the noise is right,
and the ratio of errors up to which they go before those that predict better."""
FAILED = 1e6


class Candidate(NamedTuple):
    """Constant gains, and how well they predict.

    Attributes:
        source: Where they are from: "model file", "rule", "sampled design", "Kalman filter", "innovations",
            "predictions" or "smoothed velocities".
        natural_frequency: ω [rad/s].
        damping: ζ.
        error: Root mean square error of held-out measurements predicted over the horizon [rad or m], or of velocities
            against the smoothed ones [rad/s or m/s]; geometric mean over the coordinates.

    Example:
        >>> from covariant.calibration import Candidate
        >>> Candidate("rule", 20.0, 0.7, error=1e-3).source
        'rule'
    """

    source: str
    natural_frequency: float
    damping: float
    error: float


def best_innovations(
    model: MechanicalSystem, logs: list[TuningLog], runs: Runs
) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Natural frequency [rad/s] and damping ratio with the least innovations, and the size (n,) of these."""
    rate, parts = logs[0].rate, [log.first_part for log in logs]
    pairs = list(zip(logs, parts, strict=True))
    measured = np.concatenate([_usable(model, part)[log.tuned[: len(part.t)]] for log, part in pairs])

    def usable(results):
        residuals = [np.asarray(done.info.innovation) for done in results]
        return np.concatenate([r[log.tuned[: len(r)]] for r, log in zip(residuals, logs, strict=True)])

    def innovations(z):
        return usable(runs([_observer(model, z, rate)], parts))

    def total(r):
        with np.errstate(all="ignore"):
            mean = [mean_square(column[mask]) for column, mask in zip(r.T, measured.T, strict=True)]
            value = float(np.sum(np.log(mean)))
        return value if np.isfinite(value) else FAILED

    starts = [np.array([w, np.log(USUAL)]) for w in np.linspace(np.log(0.02), np.log(2.0), 8)]
    tried = [runs([_observer(model, z, rate) for z in starts], [part]) for part in parts]  # by part, then by start
    start = starts[int(np.argmin([total(usable(results)) for results in zip(*tried, strict=True)]))]
    best, least = _descend(lambda z: total(innovations(z)), start, 60)
    if least >= FAILED:
        raise ValueError("no gains give a finite estimate; check units and signs by `covariant check`")
    sizes = [np.sqrt(mean_square(column[mask])) for column, mask in zip(innovations(best).T, measured.T, strict=True)]
    return float(np.exp(best[0])) * rate, float(np.exp(best[1])), np.array(sizes)


def candidates(
    noise: NoiseLevels, systems: Sequence[ErrorModel], filtered: Sequence[Filtered], rate: float
) -> dict[str, tuple[float, float]]:
    """Natural frequencies [rad/s] and damping ratios that follow from the noise, by design, brought to the bounds."""
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
    found = {
        "rule": (float(grid[at]), USUAL),
        "sampled design": sampled_design(std, max(float(density[at]), 1e-12 * std**2 * rate**3), rate),
        "Kalman filter": as_poles(float(mean[0]), float(mean[1]), rate),
    }
    return {name: (_within(w / rate, FREQUENCIES) * rate, _within(z, DAMPINGS)) for name, (w, z) in found.items()}


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


def best_gains(
    model: MechanicalSystem,
    logs: list[TuningLog],
    proposed: dict[str, tuple[float, float]],
    substeps: Sequence[int],
    runs: Runs,
    smooth: Sequence[Float[np.ndarray, "_ n"]] | None = None,
) -> tuple[Candidate, tuple[Candidate, ...], int]:
    """Judge candidates by the prediction of measurements, or by smoothed velocities, and search for better ones.

    Smoothed velocities judge where a force acts that the model does not know. The best candidate on the held-out rows,
    all of them, and the number of rows of the horizon; 0 where velocities were compared.
    """
    rate = logs[0].rate
    horizon = 0 if smooth is not None else rows_ahead(rate, proposed["innovations"][0])
    parts, records = [log.first_part for log in logs], [log.record for log in logs]

    def errors(gains: tuple[float, float], over: list[Record], masks: list[Bool[np.ndarray, "T"]]) -> list[np.ndarray]:
        found = []
        results = runs([intrinsic(model, *gains)], over)
        for k, (done, record, mask) in enumerate(zip(results, over, masks, strict=True)):
            motion = Motion(*model.motion(done.estimate)[:2])
            if smooth is None:
                found.append(errors_ahead(model, record, motion, mask, horizon, substeps[k]))
            else:
                found.append((np.asarray(motion.v) - smooth[k][: len(mask)])[mask, None])
        return found

    tuned = [log.tuned[: len(part.t)] for log, part in zip(logs, parts, strict=True)]
    first = {name: _total(errors(gains, parts, tuned)) for name, gains in proposed.items()}
    start = proposed[min(first, key=first.__getitem__)]
    z = np.log([start[0] / rate, start[1]])
    best, _ = _descend(lambda z: np.log(_total(errors((np.exp(z[0]) * rate, np.exp(z[1])), parts, tuned))), z, 30)
    searched = "predictions" if smooth is None else "smoothed velocities"
    everything = proposed | {searched: (float(np.exp(best[0])) * rate, float(np.exp(best[1])))}
    held_out = [log.held_out for log in logs]
    judged = tuple(
        Candidate(name, *gains, _total(errors(gains, records, held_out))) for name, gains in everything.items()
    )
    # The order of designs is for predictions; distances to smoothed velocities order good estimates too.
    return chosen(judged) if smooth is None else min(judged, key=lambda each: each.error), judged, horizon


def _total(errors: list[Float[np.ndarray, "_ _ n"]]) -> float:
    """Geometric mean over the coordinates of the root mean square errors."""
    with np.errstate(all="ignore"):
        value = float(np.exp(np.mean(np.log(size(errors)))))
    return value if np.isfinite(value) else FAILED


def chosen(judged: Sequence[Candidate]) -> Candidate:
    """The candidate to take: a design from the noise that predicts nearly as well as the best, else the best.

    Predictions confirm a design, and find out one whose noise is wrong. They do not order good ones: where the model
    errs for a while, positions are predicted best from velocities that err along with it, by gains that are too fast.
    What is worse than the gains of the model file is never taken.
    """
    best = min(judged, key=lambda each: each.error)
    errors = {each.source: each.error for each in judged}
    limit = min(SLACK * best.error, errors.get("model file", np.inf))
    design = next((name for name in DESIGNS if errors.get(name, np.inf) <= limit), best.source)
    return next(each for each in judged if each.source == design)


def _observer(model: MechanicalSystem, z: np.ndarray, rate: float):
    return intrinsic(model, float(np.exp(z[0])) * rate, float(np.exp(z[1])))


def _usable(model: MechanicalSystem, record) -> Bool[np.ndarray, "T n"]:
    return ~np.asarray(jax.vmap(model.manifold.missing)(jnp.asarray(record.y)))


def _descend(cost: Callable[[np.ndarray], float], start: np.ndarray, most: int) -> tuple[np.ndarray, float]:
    """Minimise over the logarithms of frequency and damping, within their bounds."""
    from scipy.optimize import minimize

    bounds = [np.log(FREQUENCIES), np.log(DAMPINGS)]
    simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": most}
    best = minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    return best.x, float(best.fun)


def _within(value: float, bounds: tuple[float, float]) -> float:
    return float(np.clip(value, *bounds))
