"""Reduces long logs for a page: fewer samples of each curve, and a running RMS for errors of several estimates."""

import numpy as np
from jaxtyping import Bool, Float, Int

from covariant.report._panels import Curve, Quantity
from covariant.report._polylines import drawable

MOST_SAMPLES = 2000
"""Largest number of samples for which errors of several estimates are drawn one by one; more would be a solid bar."""

MOST_INTERVALS = 600
"""Number of intervals of a running RMS: no panel has more distinguishable pixels."""

NUMBERS = 200_000
"""Largest number of values in all curves of a report together, so that its page stays below 3 MB."""

RUNNING = 1 / 60
"""Fraction of the log over which a running RMS is taken."""

Columns = Float[np.ndarray, "T c"]


def condensed(found: dict[str, Quantity], numbers: int = NUMBERS) -> dict[str, Quantity]:
    """Replace the curves of a long log by curves with fewer points.

    Up to `numbers` samples are all kept, so that one can zoom; of more, each curve keeps the smallest and the largest
    in each short interval. Errors of several estimates become their running RMS, on a logarithmic axis.
    """
    samples = len(next(iter(found.values())).curves[0].t)
    if samples > MOST_SAMPLES:
        found = {name: _running_rms_of(quantity) for name, quantity in found.items()}
    curves = [curve for quantity in found.values() for curve in quantity.curves]
    whole = sum(curve.values.size * (1 if curve.below is None else 2) for curve in curves)
    if whole <= numbers:
        return found
    # Each interval keeps two samples; −(−a // b) rounds a/b up.
    size = -(-2 * whole // numbers)
    return {name: _thin_quantity(quantity, size) for name, quantity in found.items()}


def _thin_quantity(quantity: Quantity, size: int) -> Quantity:
    curves = tuple(
        curve if len(curve.t) <= MOST_SAMPLES else _thin(curve, size, quantity.log) for curve in quantity.curves
    )
    return quantity._replace(curves=curves)


def _thin(curve: Curve, size: int, log: bool) -> Curve:
    """The smallest and the largest sample of each interval, in the order of time."""
    if curve.role == "mark":
        return curve
    t = _middles(curve.t, size)
    quarter = np.diff(t, append=2 * t[-1] - t[-2]) / 4
    stamps = np.stack([t - quarter, t + quarter], axis=1).ravel()
    (low, early), (high, late) = (_extremes(curve.values, size, log, sign) for sign in (1, -1))
    if curve.below is not None:
        low = _extremes(curve.below, size, log, 1)[0]
        upper, lower = (np.repeat(edge, 2, axis=0) for edge in (high, low))
        return curve._replace(t=stamps, values=upper, below=lower)
    rising = early <= late
    pairs = np.where(rising, low, high), np.where(rising, high, low)
    return curve._replace(t=stamps, values=np.stack(pairs, axis=1).reshape(-1, low.shape[1]))


def _extremes(
    values: Columns, size: int, log: bool, sign: int
) -> tuple[Float[np.ndarray, "k c"], Int[np.ndarray, "k c"]]:
    """The smallest (sign 1) or largest (−1) sample of each interval and its index; NaN if the interval has none."""
    filled, seen = _intervals(values, size, log)
    place = np.where(seen, sign * filled, np.inf).argmin(axis=1)
    chosen = np.take_along_axis(filled, place[:, None], axis=1)[:, 0]
    return np.where(seen.any(axis=1), chosen, np.nan), place


def _running_rms_of(quantity: Quantity) -> Quantity:
    """Replace the errors of several estimates by their running RMS; other quantities are returned unchanged."""
    lines = tuple(curve for curve in quantity.curves if curve.role == "estimate")
    if not quantity.deviation or len(lines) < 2:
        return quantity
    t = lines[0].t
    size = -(-len(t) // MOST_INTERVALS)
    run = max(1, round(RUNNING * len(t) / size))
    length = (t[-1] - t[0]) * size * run / len(t)
    rms = tuple(_running_rms(curve, size, run, quantity.log) for curve in lines)
    return quantity._replace(curves=rms, title=f"{quantity.title}, RMS over {length:.2g} s", log=True)


def _running_rms(curve: Curve, size: int, run: int, log: bool) -> Curve:
    """The RMS of the samples in `run` intervals around each interval."""
    values, seen = _intervals(curve.values, size, log)
    squares, count = np.where(seen, values, 0.0) ** 2, seen.astype(float)
    squares, count = (_moving_sum(each.sum(axis=1), run) for each in (squares, count))
    absent = ~seen.any(axis=1)
    rms = np.sqrt(squares / np.where(absent, 1.0, count))
    return curve._replace(t=_middles(curve.t, size), values=np.where(absent, np.nan, rms))


def _intervals(values: Columns, size: int, log: bool) -> tuple[np.ndarray, Bool[np.ndarray, "k size c"]]:
    """The samples by intervals (k, size, c), and a mask of those that exist and can be drawn."""
    # The last interval is padded with NaN, which cannot be drawn.
    filled = np.pad(values, ((0, -len(values) % size), (0, 0)), constant_values=np.nan)
    filled = filled.reshape(-1, size, values.shape[1])
    return filled, drawable(filled, log)


def _middles(t: Float[np.ndarray, "T"], size: int) -> Float[np.ndarray, "k"]:
    return np.pad(t, (0, -len(t) % size), mode="edge").reshape(-1, size).mean(axis=1)


def _moving_sum(values: Columns, run: int) -> Columns:
    ones = np.ones(run)  # at both ends fewer samples are summed, and they are counted in the same way
    return np.stack([np.convolve(column, ones, mode="same") for column in values.T], axis=1)
