"""Smoothing of a log without phase, on a grid of even times: positions, velocities and accelerations."""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant import scoring
from covariant._typing import Numbers
from covariant.signals import Record

HALF = 10
"""Points of the grid in half a window."""
ORDER = 3
FEWEST = 5.0
"""Least number of samples in half a window, as long as the motion is no faster."""
NARROWEST = 3.0
"""The same for a motion that changes from row to row: seven samples determine the four coefficients, the outer two
with hardly any weight."""
FULL = 0.6
"""Fraction of the usual number of samples that a window must hold to be used."""

ZEROS = (0.0, 1 / 3, 2 / 3)
"""Zeros of an encoder, in ticks, over which the error of its ticks is averaged."""


class Smooth(NamedTuple):
    """A smoothed log on a grid of K times.

    Attributes:
        t: Times (K,) [s].
        q: Positions (K, n).
        v: Velocities (K, n).
        a: Accelerations (K, n).
        u: Inputs (K, m), averaged between points.
        used: Points (K,) whose windows are full.
        kernel: Weights (2 HALF + 1,): `a` is the true acceleration averaged with them over the neighbouring points.
        noise: Standard deviation (n,) of a measurement.
        removed: Usual size (n,) of what smoothing removes from a measurement, noise or motion, whatever the outliers.
        a_noise: Standard deviation (n,) of `a` that this noise causes.
        half: Half width of a window [s].
        step: Time between points of the grid [s].
    """

    t: Float[np.ndarray, "K"]
    q: Float[np.ndarray, "K n"]
    v: Float[np.ndarray, "K n"]
    a: Float[np.ndarray, "K n"]
    u: Float[np.ndarray, "K m"]
    used: Bool[np.ndarray, "K"]
    kernel: Float[np.ndarray, "k"]
    noise: Float[np.ndarray, "n"]
    removed: Float[np.ndarray, "n"]
    a_noise: Float[np.ndarray, "n"]
    half: float
    step: float


def smooth(
    record: Record,
    half: float,
    circles: tuple[int, ...],
    delay: Numbers = 0.0,
    ticks: Numbers = 0.0,
    fewest: float = FEWEST,
) -> Smooth:
    """Smooth a record in coordinates by polynomials of degree 3 over windows of ±`half`, or of `fewest` samples."""
    t, u = np.asarray(record.t), np.asarray(record.u)
    y = scoring.unwrap(np.asarray(record.y), circles)
    n, delay = y.shape[1], np.broadcast_to(delay, y.shape[1:])
    spacing = slowest(t, y)
    half = max(half, fewest * spacing)
    step = half / HALF
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step) + 1)
    c, used = np.empty((len(grid), ORDER + 1, n)), (grid >= t[0] + half) & (grid <= t[-1] - half)
    for shift in np.unique(delay):
        same = np.flatnonzero(delay == shift)
        c[:, :, same] = scoring.local_polynomials(t - shift, y[:, same], grid, half, ORDER)
    for i in range(n):
        seen = t[np.isfinite(y[:, i])] - delay[i]
        held = np.searchsorted(seen, grid + half) - np.searchsorted(seen, grid - half)
        used &= held >= FULL * 2 * half / spacing
    noise, removed = _noise(t, y, grid, c, delay)
    # Coefficient c is the c-th derivative divided by c!.
    q, v, a, held = c[:, 0], c[:, 1], 2 * c[:, 2], held_inputs(t, u, grid, step)
    of_ticks = _tick_noise(t, y, grid, c, delay, half, np.broadcast_to(ticks, n), used)
    a_noise = np.maximum(gain(half, spacing, 2) * noise, of_ticks)
    return Smooth(grid, q, v, a, held, used, _kernel(half), noise, removed, a_noise, half, step)


def slowest(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"]) -> float:
    """Usual time [s] between readings of the slowest sensor, whose cells are empty in between: it fills the windows."""
    return max(float(np.median(np.diff(t[np.isfinite(column)]))) for column in y.T)


def _noise(t, y, grid, c, delay):
    """Standard deviation (n,) of the measurements about the smoothed positions, and one that few of them decide."""
    std, usual = np.empty((2, y.shape[1]))
    for i, shift in enumerate(delay):
        seen = np.isfinite(y[:, i])
        error = y[seen, i] - _along(t[seen] - shift, grid, c[:, :, i])
        # Of normal errors 90 % are below 1.645 standard deviations.
        std[i], usual[i] = np.sqrt(np.mean(error**2)), np.quantile(np.abs(error), 0.9) / 1.645
    return std, usual


def _along(t, grid, c):
    """Smoothed positions at some times, from the coefficients (K, ORDER + 1) of one coordinate."""
    nearest = np.clip(np.rint((t - grid[0]) / (grid[1] - grid[0])).astype(int), 0, len(grid) - 1)
    return sum(c[nearest, k] * (t - grid[nearest]) ** k for k in range(ORDER + 1))


def _tick_noise(t, y, grid, c, delay, half, ticks, used):
    """Standard deviation (n,) of the accelerations that ticks cause: those of the smoothed motion, read in such ticks.

    Between two ticks a reading does not change, so that its errors are alike over many rows, and no white noise.
    """
    std = np.zeros(len(ticks))
    for i in np.flatnonzero(ticks > 0) if used.any() else ():
        seen = np.isfinite(y[:, i])
        at = t[seen] - delay[i]
        counts = _along(at, grid, c[:, :, i]) / ticks[i]
        errors = np.stack([np.round(counts + zero) - zero - counts for zero in ZEROS], axis=1)
        a = 2 * ticks[i] * scoring.local_polynomials(at, errors, grid, half, ORDER)[used, 2]
        std[i] = np.sqrt(np.mean(a**2))
    return std


def held_inputs(t, u, grid, step):
    """Average, around each point of the grid, inputs that act from their stamp to the next."""
    summed = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u[:-1] * np.diff(t)[:, None], axis=0)])

    def integral(at):
        # The integral of a held input is linear between stamps, so that interpolation is exact.
        return np.array([np.interp(at, t, column) for column in summed.T]).reshape(u.shape[1], len(at)).T

    return (integral(grid + step / 2) - integral(grid - step / 2)) / step


def derivative_weights(offsets, half, order=2):
    """Weights of samples at some offsets in a derivative at zero of the polynomial through a window."""
    coefficients = scoring.local_polynomials(offsets, np.eye(len(offsets)), np.zeros(1), half, ORDER)[0]
    # Coefficient c is the c-th derivative divided by c!.
    return (1, 1, 2)[order] * coefficients[order]


@functools.lru_cache  # the search for delays smooths a log a dozen times over windows of the same width
def gain(half: float, spacing: float, order: int) -> float:
    """Ratio of the standard deviation of a derivative to that of a measurement."""
    count = max(int(half / spacing), ORDER)
    # A weighted sum of independent readings has the root of the sum of squared weights as its gain.
    return float(np.linalg.norm(derivative_weights(spacing * np.arange(-count, count + 1), half, order)))


def acceleration_kernel(half: float, count: int) -> np.ndarray:
    """Weights (2 count + 1,) of true accelerations, at points of a grid, in a smoothed acceleration.

    A sum of positions that is zero for motions at constant velocity is a sum of their second differences; its weights
    are the double sums of those of the positions.
    """
    weights = derivative_weights(half / count * np.arange(-count, count + 1), half)
    # Two sums by parts turn Σ w y into Σ (ΣΣw) Δ²y, and Δ²y ≈ step² a.
    return (half / count) ** 2 * np.concatenate([[0.0], np.cumsum(np.cumsum(weights))[:-1]])


@functools.lru_cache
def _kernel(half: float) -> np.ndarray:
    """The kernel on the grid of a smoothed log."""
    kernel = acceleration_kernel(half, HALF)
    kernel.flags.writeable = False  # the cache shares it among all callers
    return kernel
