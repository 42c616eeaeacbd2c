"""Filters that know no model, tuned by the least velocity error: as the data sheet predicts it, or found on a trial.

Each has one number that is searched: a bandwidth, a window, how strong the motion is beside the noise, a bound on the
jerk. A linear filter is judged by its weights, without being run; another is run on the trial.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration._data_sheet import DataSheet, Trial
from covariant.observers import (
    AbstractLinearFilter,
    AbstractObserver,
    FilteredDerivative,
    JointKalman,
    Levant,
    SavitzkyGolay,
)

LONGEST_WINDOW = 120
"""Samples; a polynomial that would want more is limited to this many."""


def filter_bandwidth(
    sheet: DataSheet,
    rate: float,
    trial: Trial | None = None,
    kind: Callable[[float], AbstractLinearFilter] = FilteredDerivative,
) -> float:
    """Bandwidth [rad/s] of a linear filter, `kind(bandwidth)`, with the least velocity error at a rate [Hz]."""
    return _best((np.geomspace(0.005, 3.0, 80) * rate).tolist(), kind, sheet, rate, trial)


def window_length(sheet: DataSheet, rate: float, order: int = 2, trial: Trial | None = None) -> int:
    """Window [samples] of the causal Savitzky–Golay filter with the least velocity error, likewise."""
    windows = range(order + 1, LONGEST_WINDOW + 1)
    return _best(windows, lambda window: SavitzkyGolay(window, order), sheet, rate, trial)


def polynomial(sheet: DataSheet, rate: float, trial: Trial | None = None) -> tuple[int, int]:
    """Window [samples] and order, 2 or 3, of the causal Savitzky–Golay filter with the least velocity error."""
    candidates = [(window_length(sheet, rate, order, trial), order) for order in (2, 3)]
    return _best(candidates, lambda candidate: SavitzkyGolay(*candidate), sheet, rate, trial)


def joint_noise(sheet: DataSheet, rate: float, trial: Trial | None = None) -> tuple[float, float, float]:
    """Standard deviation and time of the accelerations, and standard deviation of a sample, for a `JointKalman`.

    Those of the data sheet, for which it is the best linear filter; on a trial, with the accelerations that are best.
    """

    def kind(motion_std):
        return JointKalman(motion_std, sheet.motion_time, sheet.measurement_std)

    stds = [sheet.motion_std] if trial is None else (sheet.motion_std * np.geomspace(1e-3, 1e3, 61)).tolist()
    return _best(stds, kind, sheet, rate, trial), sheet.motion_time, sheet.measurement_std


def jerk_bound(sheet: DataSheet, trial: Trial | None = None) -> float:
    """Bound on the jerk [rad/s³] for a `Levant` differentiator: how fast the accelerations of the data sheet change.

    On a trial the one with the least velocity error of the differentiator itself, run on it.
    """
    typical = sheet.motion_std / sheet.motion_time
    if trial is None:
        return typical
    bounds = typical * np.geomspace(1e-3, 1e3, 61)
    y, late = trial.y.copy(), _late(trial.t)
    y[0] = [column[np.isfinite(column)][0] for column in y.T]  # from where it starts
    found = _run(Levant, *map(jnp.asarray, (bounds, np.diff(trial.t), y)))
    errors = [relative_error(v[late], trial.v[late]) for v in np.asarray(found)]
    return float(bounds[np.argmin(errors)])


@eqx.filter_jit
def _run(kind: Callable[[Array], AbstractObserver], numbers: Array, dt: Array, y: Array) -> Float[Array, "k T n"]:
    """Velocities of the filters that each number makes, along positions y (T, n) with steps dt (T − 1,)."""

    def follow(number):
        observer = kind(number)

        def step(state, sample):
            state, _ = observer.step(state, jnp.zeros(0), *sample)
            return state, jnp.split(observer.estimate(state), 2)[1]

        return jax.lax.scan(step, observer.init(y[0]), (y[1:], dt))[1]

    v = jax.vmap(follow)(numbers)
    return jnp.concatenate([jnp.zeros_like(v[:, :1]), v], axis=1)


def _best(candidates: Iterable, kind: Callable, sheet: DataSheet, rate: float, trial: Trial | None):
    """The candidate whose filter leaves the least velocity error."""
    return min(candidates, key=lambda candidate: filter_error(kind(candidate).weights(rate), sheet, rate, trial))


def filter_error(weights: Float[np.ndarray, "k"], sheet: DataSheet, rate: float, trial: Trial | None = None) -> float:
    """Velocity error of a linear filter: as the data sheet predicts it, or found on a trial as if its stamps were even.

    On a trial it is a part of the velocity, over all coordinates, its first second left out.
    """
    if trial is None:
        return linear_filter_error(weights, sheet, rate)
    t = np.asarray(trial.t)
    even = np.arange(t[0], t[-1], 1 / rate)
    late = _late(even)
    found, true = [], []
    for y, v in zip(np.transpose(trial.y), np.transpose(trial.v), strict=True):
        known = np.isfinite(y)
        found.append(filtered(weights, np.interp(even, t[known], y[known]))[late])
        true.append(np.interp(even, t, v)[late])
    return relative_error(np.transpose(found), np.transpose(true))


def relative_error(found: Float[np.ndarray, "T n"], true: Float[np.ndarray, "T n"]) -> float:
    """Root mean square over all coordinates of the error of each as a part of its velocity."""
    size = np.maximum(np.mean(true**2, axis=0), np.finfo(float).tiny)
    return float(np.sqrt(np.mean(np.mean((found - true) ** 2, axis=0) / size)))


def _late(t: np.ndarray) -> np.ndarray:
    """Which stamps are after the first second, or the first half of what is shorter than two."""
    return t > min(t[0] + 1.0, t[0] + (t[-1] - t[0]) / 2)


def filtered(weights: Float[np.ndarray, "k"], x: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """What weights that annihilate constants make of samples, the first of which has been there forever."""
    x = x - x[0]
    if len(weights) < 100:
        return np.convolve(x, weights)[: len(x)]
    size = 1 << (len(x) + len(weights)).bit_length()
    return np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(weights, size), size)[: len(x)]


def linear_filter_error(weights: np.ndarray, sheet: DataSheet, rate: float) -> float:
    """Predicted standard deviation of the velocity `Σ w_i y(t − i/rate)`: sensor noise plus lag.

    The weights annihilate constants and return slopes, so what remains of a motion is its acceleration a(t − r),
    weighted by `h(r) = Σ_{s_i > r} w_i (s_i − r)`; a has exponential correlation.
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
