"""What inputs may be while they are missing: mean, size and correlation of each, as a log shows them."""

import numpy as np

from covariant.observers import MissingInputs
from covariant.scoring import find_holes, longest_step
from covariant.signals import Record

LAGS = 60
"""Number of lags, up to the longest of the hole or a tenth of the log, at which correlations are compared."""


def missing_inputs(record: Record) -> MissingInputs | None:
    """What inputs may be while they are missing, from those that a log has.

    A process is found for each input whose correlation over the times that matter, those of the longest hole, is that
    of the log. Give it to `IntrinsicKalman` as `inputs`, so that the filter is as uncertain after a hole as it is.

    Args:
        record: A log, with NaN where an input is missing; a hole is also where rows are.

    Returns:
        The process; None for a log whose inputs never are missing, or never change.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.calibration import missing_inputs
        >>> t = np.delete(np.arange(0.0, 20.0, 0.01), slice(700, 750))
        >>> inputs = missing_inputs(Record(t, np.sin(3 * t)[:, None], np.zeros((len(t), 1))))
        >>> [round(x.item(), 2) for x in (inputs.std[0], inputs.square[0], inputs.hold)]
        [0.71, 9.27, 0.03]
    """
    t, u = np.asarray(record.t, float), np.asarray(record.u, float)
    known = np.isfinite(u)
    holes = find_holes(t, np.asarray(known.all(1)))
    if not u.shape[1] or not known.any(0).all() or not (len(holes) or not known.all()):
        return None
    mean, std = np.nanmean(u, axis=0), np.nanstd(u, axis=0)
    if not std.any():
        return None
    step, longest = float(np.median(np.diff(t))), float(np.max(np.diff(holes), initial=0.0))
    lags = np.unique(np.round(np.linspace(1, max(longest / step, 4), LAGS)).astype(int))
    lags = lags[lags < len(t) // 3]
    kernels = [_kernel(lags * step, _correlation(t, column, step, lags)) for column in u.T]
    decay, square = np.array(kernels).T
    return MissingInputs(mean, std, decay, square, longest_step(t))


def _correlation(t: np.ndarray, u: np.ndarray, step: float, lags: np.ndarray) -> np.ndarray:
    """Correlations (L,) of a held input at some lags, on an even grid of which holes are left out."""
    grid = np.arange(t[0], t[-1], step)
    at = np.searchsorted(t, grid, side="right") - 1
    z = np.where(grid - t[at] <= longest_step(t), u[at], np.nan)
    z = z - np.nanmean(z)
    pairs = [(z[:-lag], z[lag:]) for lag in lags]
    # Of the same pairs, so that an input that is not quite stationary has no correlation beyond one.
    powers = [np.nansum(np.where(np.isfinite(a * b), a**2 + b**2, 0.0)) for a, b in pairs]
    products = [2 * np.nansum(a * b) for a, b in pairs]
    # An input that never changes, such as the switch of a servo that stays on, has none.
    return np.array([product / power if power else np.nan for product, power in zip(products, powers, strict=True)])


def _kernel(times: np.ndarray, correlation: np.ndarray) -> tuple[float, float]:
    """Decay and squared frequency whose correlation is closest to that of a log, among a grid of both."""
    paces = np.geomspace(0.2 / times[-1], 2.0 / times[0], 80)
    dampings = np.geomspace(0.02, 20.0, 40)
    pace, damping = (each.ravel() for each in np.meshgrid(paces, dampings))
    decay, square = damping * pace, pace**2 * (1 - damping**2)
    if not np.isfinite(correlation).all():
        return 1 / times[-1], 0.0
    errors = [np.sum((correlate(a, b, times) - correlation) ** 2) for a, b in zip(decay, square, strict=True)]
    best = int(np.argmin(errors))
    return float(decay[best]), float(square[best])


def correlate(decay: float, square: float, times: np.ndarray) -> np.ndarray:
    """Correlation of a process of second order after some times."""
    b = np.sqrt(max(abs(square), (1e-3 * decay) ** 2))
    if square > 0:
        return np.exp(-decay * times) * (np.cos(b * times) + decay / b * np.sin(b * times))
    up, down = np.exp(-(decay - b) * times) / 2, np.exp(-(decay + b) * times) / 2
    return up + down + decay / b * (up - down)
