"""Filters without a model, tuned for the least velocity error: predicted from the data sheet, or measured on a trial.

Each filter has one number to optimise: a bandwidth, a window, the strength of the motion beside the noise, a bound on
the jerk. A linear filter is judged by its weights, without a run; others are run on the trial.
"""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration.tuning._data_sheet import DataSheet, Trial
from covariant.calibration.tuning._gains import gains
from covariant.calibration.tuning._judge import relative_squares
from covariant.observers import (
    AbstractLinearFilter,
    FilteredDerivative,
    IntrinsicForce,
    JointKalman,
    Levant,
    SavitzkyGolay,
)

LONGEST_WINDOW = 120
"""Longest window [samples] of a polynomial filter."""
LOOPS = (0.02, 1.5, 18)
"""Least and largest bandwidth of a loop on a group, in radians a sample, and how many are tried."""
COARSE = 8
"""Steps of a first search: the error falls and rises once as a filter becomes faster."""


def filter_bandwidth(
    sheet: DataSheet,
    rate: float,
    trial: Trial | None = None,
    kind: Callable[[float], AbstractLinearFilter] = FilteredDerivative,
) -> float:
    """Bandwidth [rad/s] of a linear filter with the least velocity error, between 0.005 and 3 radians a sample."""
    # From a memory of 200 samples to a filter that all but follows the last difference.
    return _nearby((np.geomspace(0.005, 3.0, 80) * rate).tolist(), kind, sheet, rate, trial)


def polynomial(sheet: DataSheet, rate: float, trial: Trial | None = None) -> tuple[int, int]:
    """Window [samples] and order, 2 or 3, of the causal Savitzky–Golay filter with the least velocity error."""
    candidates = [(window, order) for order in (2, 3) for window in range(order + 1, LONGEST_WINDOW + 1)]
    return _best(candidates, lambda candidate: SavitzkyGolay(*candidate), sheet, rate, trial)


def joint_noise(sheet: DataSheet, rate: float, trial: Trial | None = None) -> tuple[float, float, float]:
    """Noise levels for a `JointKalman`: strength and correlation time [s] of the accelerations, std of a sample.

    With those of the data sheet it is the best linear filter; on a trial the accelerations are optimised.
    """

    rest = sheet.motion_time, sheet.measurement_std
    # Steps of a tenth of a decade: the error is flat about its minimum.
    stds = [sheet.motion_std] if trial is None else (sheet.motion_std * np.geomspace(1e-3, 1e3, 61)).tolist()
    return _nearby(stds, lambda std: JointKalman(std, *rest), sheet, rate, trial), *rest


def jerk_bound(sheet: DataSheet, trial: Trial | None = None) -> float:
    """Bound on the jerk [rad/s³] for a `Levant` differentiator: of the data sheet, or the best near it on a trial."""
    typical = sheet.motion_std / sheet.motion_time
    if trial is None:
        return typical
    return _best_by_runs(Levant, typical * np.geomspace(1e-3, 1e3, 61), trial)


def loop_bandwidth(sheet: DataSheet, rate: float, trial: Trial | None, kind: Callable[[Any], IntrinsicForce]) -> float:
    """Bandwidth [rad/s] of a loop on a group: that for the motion of the data sheet, or the best one on a trial."""
    if trial is None:
        return gains(sheet.measurement_std, rate, sheet.motion_std, sheet.motion_time).beta ** 0.5
    return _best_by_runs(kind, np.geomspace(*LOOPS) * rate, trial)


def _best_by_runs(kind: Callable[[Any], Any], numbers: np.ndarray, trial: Trial) -> float:
    """The number whose filter has the least velocity error on a trial when it is run."""
    y, late = trial.y.copy(), _late(trial.t)
    y[0] = np.reshape([each[np.isfinite(each)][0] for each in y.reshape(len(y), -1).T], y.shape[1:])  # where it starts
    velocities = _run_filters(kind, *map(jnp.asarray, (numbers, np.diff(trial.t), y)))
    errors = [relative_error(v[late], trial.v[late]) for v in np.asarray(velocities)]
    return float(numbers[np.argmin(errors)])


@eqx.filter_jit
def _run_filters(kind: Callable[[Array], Any], numbers: Array, dt: Array, y: Array) -> Float[Array, "k T n"]:
    """Velocities of the filters that each number parametrises, along positions y (T, *n) with steps dt (T − 1,)."""

    def follow(number):
        observer = kind(number)
        model = getattr(observer, "model", None)
        u = jnp.zeros(0 if model is None else model.inputs)

        def step(state, sample):
            state, _ = observer.step(state, u, *sample)
            estimate = observer.estimate(state)
            return state, jnp.split(estimate, 2)[1] if model is None else model.motion(estimate).v

        return jax.lax.scan(step, observer.init(y[0]), (y[1:], dt))[1]

    v = jax.vmap(follow)(numbers)
    return jnp.concatenate([jnp.zeros_like(v[:, :1]), v], axis=1)


def _best(candidates: Iterable, kind: Callable, sheet: DataSheet, rate: float, trial: Trial | None):
    """The candidate whose filter leaves the least velocity error."""
    return min(candidates, key=lambda candidate: filter_error(kind(candidate).weights(rate), sheet, rate, trial))


def _nearby(candidates: list[float], kind: Callable, sheet: DataSheet, rate: float, trial: Trial | None) -> float:
    """As `_best`, of candidates in order: every eighth one, then those beside the best of these."""
    coarse = candidates[::COARSE]
    at = coarse.index(_best(coarse, kind, sheet, rate, trial)) * COARSE
    return _best(candidates[max(0, at - COARSE + 1) : at + COARSE], kind, sheet, rate, trial)


def filter_error(weights: Float[np.ndarray, "k"], sheet: DataSheet, rate: float, trial: Trial | None = None) -> float:
    """Velocity error of a linear filter: predicted from a data sheet, or measured on a trial as a part of the velocity.

    Use it to compare filters without a model: it costs a convolution, and no compilation.

    Args:
        weights: Weights (k,) [1/s] of the newest and earlier samples.
        sheet: The data sheet.
        rate: Sampling rate [Hz].
        trial: Part of a log, whose first second is left out; its stamps are made even.

    Returns:
        The predicted standard deviation [rad/s or m/s]; of a trial the root mean square over the coordinates.

    Example:
        >>> from covariant.calibration import DataSheet, filter_error
        >>> from covariant.observers import SavitzkyGolay
        >>> sheet = DataSheet(measurement_std=1e-3, acceleration_std=0.5)
        >>> long, short = (filter_error(SavitzkyGolay(window).weights(100.0), sheet, 100.0) for window in (8, 3))
        >>> long < short
        True
    """
    if trial is None:
        return linear_filter_error(weights, sheet, rate)
    even, found = even_velocity(weights, rate, trial.t, trial.y)
    true = np.stack([np.interp(even, trial.t, v) for v in np.transpose(trial.v)], axis=1)
    late = _late(even)
    return relative_error(found[late], true[late])


def even_velocity(
    weights: Float[np.ndarray, "k"], rate: float, t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"]
) -> tuple[Float[np.ndarray, "E"], Float[np.ndarray, "E n"]]:
    """Velocities of a linear filter from positions that are interpolated to even stamps."""
    even, columns = np.arange(t[0], t[-1], 1 / rate), []
    for column in np.transpose(y):
        measured = np.isfinite(column)
        columns.append(filtered(weights, np.interp(even, t[measured], column[measured])))
    return even, np.stack(columns, axis=1)


def relative_error(found: Float[np.ndarray, "T n"], true: Float[np.ndarray, "T n"]) -> float:
    """Error of velocities (T, n) as a fraction of the reference's, RMS over the coordinates; 1 for an estimate of 0."""
    return float(np.sqrt(np.mean(relative_squares(found, true))))


def _late(t: np.ndarray) -> np.ndarray:
    """Which stamps are after the first second, or after the first half where all span less than two."""
    return t > min(t[0] + 1.0, t[0] + (t[-1] - t[0]) / 2)


def filtered(weights: Float[np.ndarray, "k"], x: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Filter samples by a response that annihilates constants; the first is taken to have been there for ever."""
    # `scipy.signal`, which has both, takes seconds to import.
    x = x - x[0]
    # A short sum is quicker than three transforms.
    if len(weights) < 100:
        return np.convolve(x, weights)[: len(x)]
    # At least the length of the full convolution, so that the transform does not wrap around.
    size = 1 << (len(x) + len(weights)).bit_length()
    return np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(weights, size), size)[: len(x)]


def linear_filter_error(weights: np.ndarray, sheet: DataSheet, rate: float) -> float:
    """Predicted standard deviation of the velocity `Σ w_i y(t − i/rate)`: sensor noise plus lag.

    The weights annihilate constants and return slopes, so what remains of a motion is its acceleration a(t − r),
    weighted by `h(r) = Σ_{s_i > r} w_i (s_i − r)`; a has exponential correlation.
    """
    from scipy.linalg import matmul_toeplitz

    ages = np.arange(len(weights)) / rate
    # With tail sums W = Σ w and moments Σ w s over s_i ≥ r, h(r) = Σ w_i s_i − r Σ w_i.
    tail = np.cumsum(weights[::-1])[::-1]
    moment = np.cumsum((weights * ages)[::-1])[::-1]
    lag = (moment - tail * ages) / rate
    lag[0] /= 2  # trapezoid rule over r; h ends at 0 on the other side
    lagged = lag @ matmul_toeplitz(np.exp(-ages / sheet.motion_time), lag)
    return float(np.sqrt(sheet.measurement_std**2 * weights @ weights + sheet.motion_std**2 * max(lagged, 0.0)))
