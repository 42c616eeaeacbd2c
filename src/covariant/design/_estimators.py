"""All estimators for the same task, tuned from the same data sheet for the least predicted velocity error."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.design._gains import Gains, gains
from covariant.models import MechanicalSystem
from covariant.observers import REGISTRY, AbstractObserver

LONGEST_WINDOW = 120
"""Longest window [samples] of a filter without a model, where the data sheet alone would ask for a longer one."""

ESTIMATORS = tuple(entry.name for entry in REGISTRY)
"""Names of all estimators: those in `covariant.observers.REGISTRY`."""


class DataSheet(NamedTuple):
    """What is known of sensor, model and motion before any log is recorded; in units of the coordinates and seconds.

    On a group each number holds for every component of a vector in the body frame, in rad and, for positions, m.

    - `measurement_std`: standard deviation of the noise of one sample.
    - `acceleration_std`, `correlation_time`: standard deviation and correlation time of the acceleration that the model
      does not explain; None for one that is independent at each sample.
    - `motion_std`, `motion_time`: the same of the acceleration of the motion itself, for filters that use no model.
    - `damping`: damping ratio ζ of the observers.
    """

    measurement_std: float
    acceleration_std: float
    correlation_time: float | None = None
    motion_std: float = 10.0
    motion_time: float = 0.1
    damping: float = 0.5**0.5


class Trial(NamedTuple):
    """Part of a log on which the filters without a model are tuned.

    - `t` (T,): stamps [s].
    - `y` (T, n): positions, continuous across full turns; entries may be missing (NaN).
    - `v` (T, n): velocities to compare with.
    """

    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]


def observer_gains(sheet: DataSheet, rate: float) -> Gains:
    """`gains` for a data sheet at a sampling rate [Hz]."""
    return gains(sheet.measurement_std, rate, sheet.acceleration_std, sheet.correlation_time, sheet.damping)


def estimators(model: MechanicalSystem) -> tuple[str, ...]:
    """Names of the estimators that fit a model; the first is the one to begin with."""
    return tuple(entry.name for entry in REGISTRY if entry.fits(model))


def with_gains(model: MechanicalSystem, alpha: float, beta: float) -> dict[str, AbstractObserver]:
    """The observers that take the gains α [1/s] and β [1/s²], by name.

    Salcudean's observer has α and β exactly only for an inertia that is the same in all directions; otherwise they hold
    for the mean of the principal inertias.
    """
    fitting = (entry for entry in REGISTRY if entry.tuned_by == "gains" and entry.fits(model))
    return {entry.name: entry.make(model, alpha, beta) for entry in fitting}


def tuned_estimators(
    model: MechanicalSystem, n: int, sheet: DataSheet, rate: float, trial: Trial | None = None
) -> dict[str, AbstractObserver]:
    """The `estimators` by name, for a model of n velocities sampled at `rate` [Hz].

    Filters without a model are tuned by the data sheet too or, where there is a `trial`, to what is best on it.
    Raises `ValueError` for numbers of the data sheet that are not positive.
    """
    for name in ("motion_std", "motion_time"):
        if not 0 < getattr(sheet, name) < np.inf:
            raise ValueError(f"tuned_estimators: {name} must be a positive number; got {getattr(sheet, name)}")
    chosen = observer_gains(sheet, rate)
    time = 1 / (2 * rate) if sheet.correlation_time is None else sheet.correlation_time
    process_cov = 2 * sheet.acceleration_std**2 * time * jnp.eye(n)
    measurement_cov = sheet.measurement_std**2 * jnp.eye(n)
    numbers = {
        "gains": (chosen.alpha, chosen.beta),
        "noise": (process_cov, measurement_cov, sheet.motion_std * sheet.motion_time),
        "motion": (filter_bandwidth(sheet, rate, trial), *polynomial(sheet, rate, trial)),
    }
    return {entry.name: entry.make(model, *numbers[entry.tuned_by]) for entry in REGISTRY if entry.fits(model)}


def filter_bandwidth(sheet: DataSheet, rate: float, trial: Trial | None = None) -> float:
    """Bandwidth [rad/s] of the filtered derivative with the least velocity error: predicted, or found on a trial."""
    candidates = np.geomspace(0.005, 3.0, 80) * rate
    return float(min(candidates, key=lambda w: filter_error(derivative_weights(w, rate), sheet, rate, trial)))


def window_length(sheet: DataSheet, rate: float, order: int = 2, trial: Trial | None = None) -> int:
    """Window [samples] of the causal Savitzky–Golay filter with the least velocity error: predicted, or on a trial."""
    candidates = range(order + 1, LONGEST_WINDOW + 1)
    return min(candidates, key=lambda k: filter_error(polynomial_weights(k, order, rate), sheet, rate, trial))


def polynomial(sheet: DataSheet, rate: float, trial: Trial | None = None) -> tuple[int, int]:
    """Window [samples] and order (2 or 3) of the causal Savitzky–Golay filter with the least velocity error."""
    candidates = [(window_length(sheet, rate, order, trial), order) for order in (2, 3)]
    return min(candidates, key=lambda c: filter_error(polynomial_weights(*c, rate), sheet, rate, trial))


def filter_error(weights: np.ndarray, sheet: DataSheet, rate: float, trial: Trial | None) -> float:
    """Velocity error of a linear filter: predicted from the data sheet, or measured on a trial.

    On a trial, stamps are treated as evenly spaced. The error then is relative to the velocity, over all coordinates,
    without the first second.
    """
    if trial is None:
        return linear_filter_error(weights, sheet, rate)
    t = np.asarray(trial.t)
    even = np.arange(t[0], t[-1], 1 / rate)
    late = even > min(t[0] + 1.0, t[0] + (t[-1] - t[0]) / 2)
    squares = []
    for y, v in zip(np.transpose(trial.y), np.transpose(trial.v), strict=True):
        known, true = np.isfinite(y), np.interp(even, t, v)[late]
        smooth = np.interp(even, t[known], y[known])
        padded = np.concatenate([np.full(len(weights) - 1, smooth[0]), smooth])
        found = np.convolve(padded, weights, "valid")[late]
        squares.append(np.mean((found - true) ** 2) / max(np.mean(true**2), np.finfo(float).tiny))
    return float(np.sqrt(np.mean(squares)))


def derivative_weights(bandwidth: float, rate: float) -> np.ndarray:
    """Weights (k,), newest first, with which the filtered derivative computes a velocity from positions."""
    decay = np.exp(-bandwidth / rate)
    difference = (1 - decay) * decay ** np.arange(min(2000, int(12 * rate / bandwidth) + 2)) * rate
    return np.append(difference, 0.0) - np.append(0.0, difference)


def polynomial_weights(window: int, order: int, rate: float) -> np.ndarray:
    """Weights (window,), newest first, of the slope at the newest sample of a polynomial fitted to the window."""
    ages = -np.arange(window) / rate
    return np.linalg.pinv(np.vander(ages, order + 1, increasing=True))[1]


def linear_filter_error(weights: np.ndarray, sheet: DataSheet, rate: float) -> float:
    """Predicted standard deviation of the velocity `Σ w_i y(t − i/rate)`: sensor noise plus lag.

    The weights annihilate constants and give the exact slope of a straight line, so what remains of a motion is its
    acceleration a(t − r), weighted by `h(r) = Σ_{s_i > r} w_i (s_i − r)`; a has exponential correlation.
    """
    ages = np.arange(len(weights)) / rate
    tail = np.cumsum(weights[::-1])[::-1]
    moment = np.cumsum((weights * ages)[::-1])[::-1]
    lag = (moment - tail * ages) / rate
    lag[0] /= 2  # trapezoid rule over r; h ends at 0 on the other side
    decay = np.exp(-1 / (rate * sheet.motion_time))
    carried, lagged = 0.0, 0.0
    for value in lag:  # Σ_ij lag_i lag_j decay^|i−j| in one pass
        lagged += value * (value + 2 * decay * carried)
        carried = value + decay * carried
    return float(np.sqrt(sheet.measurement_std**2 * weights @ weights + sheet.motion_std**2 * max(lagged, 0.0)))
