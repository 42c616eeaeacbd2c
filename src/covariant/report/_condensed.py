"""Long logs as they fit a screen: bands from the smallest to the largest sample of an interval, and running RMS.

Drawn sample by sample, thousands of samples of an oscillation or of noise are a solid bar.
"""

import numpy as np
from jaxtyping import Bool, Float

from covariant.report._panels import Curve, Quantity
from covariant.report._polylines import drawable

MOST_SAMPLES = 2000
"""Samples up to which a curve is drawn sample by sample."""

MOST_INTERVALS, FEWEST_INTERVALS = 600, 100
"""Intervals that a longer log is divided into: panels have no more pixels that one can tell apart."""

NUMBERS = 34_000
"""Numbers that all curves of a report may have together, so that its page stays small with many estimators."""

LEAST = 4
"""Samples of an interval, at least."""

RUNNING = 1 / 60
"""Part of the log over which a running RMS is taken."""

Columns = Float[np.ndarray, "T c"]


def condensed(found: dict[str, Quantity]) -> dict[str, Quantity]:
    """Replace the curves of a long log by ones with fewer points.

    Positions and velocities become bands, those of the backdrops and of the first estimate: the others are compared by
    their errors. Errors become their running RMS: of one estimate with its band behind, of several on a logarithmic
    axis, which shows small beside large.
    """
    samples = len(next(iter(found.values())).curves[0].t)
    whole = sum(len(quantity.curves) * len(quantity.labels) for quantity in found.values())
    if samples <= min(MOST_SAMPLES, max(FEWEST_INTERVALS, NUMBERS // whole)):
        return found
    found = {name: quantity._replace(curves=_curves_to_draw(quantity)) for name, quantity in found.items()}
    numbers = sum((2 + len(quantity.curves)) * len(quantity.labels) for quantity in found.values())
    # −(−a // b) rounds a/b up, so that there are no more intervals than allowed.
    size = max(LEAST, -(-samples // min(MOST_INTERVALS, max(FEWEST_INTERVALS, NUMBERS // numbers))))
    return {name: _condense_quantity(quantity, size) for name, quantity in found.items()}


def _curves_to_draw(quantity: Quantity) -> tuple[Curve, ...]:
    """The curves that are drawn of a long log."""
    if quantity.deviation:
        return quantity.curves
    first = sum(curve.backdrop for curve in quantity.curves)
    return quantity.curves[: first + 1]


def _condense_quantity(quantity: Quantity, size: int) -> Quantity:
    t = quantity.curves[0].t
    length = (t[-1] - t[0]) * size / len(t)
    bands = tuple(_band(curve, size, quantity.log) for curve in quantity.curves)
    if not quantity.deviation:
        return quantity._replace(curves=bands, title=f"{quantity.title}, range in every {length:.2g} s")
    run = max(1, round(RUNNING * len(bands[0].t)))
    lines = tuple(_running_rms(curve, size, run, quantity.log) for curve in quantity.curves)
    shown = lines if len(lines) > 1 else (*bands, *lines)
    title = f"{quantity.title}, RMS over {run * length:.2g} s"
    return quantity._replace(curves=shown, title=title, log=quantity.log or len(lines) > 1)


def _band(curve: Curve, size: int, log: bool) -> Curve:
    values, seen = _intervals(curve.values, size, log)
    low, high = np.where(seen, values, np.inf).min(axis=1), np.where(seen, values, -np.inf).max(axis=1)
    absent = ~seen.any(axis=1)
    low[absent] = high[absent] = np.nan  # else an interval without samples would keep ±∞
    return curve._replace(t=_middles(curve.t, size), values=high, below=low)


def _running_rms(curve: Curve, size: int, run: int, log: bool) -> Curve:
    """The RMS of the samples in `run` intervals around each."""
    values, seen = _intervals(curve.values, size, log)
    squares, count = np.where(seen, values, 0.0) ** 2, seen.astype(float)
    squares, count = (_moving_sum(each.sum(axis=1), run) for each in (squares, count))
    absent = ~seen.any(axis=1)
    rms = np.sqrt(squares / np.where(absent, 1.0, count))
    return curve._replace(t=_middles(curve.t, size), values=np.where(absent, np.nan, rms))


def _intervals(values: Columns, size: int, log: bool) -> tuple[np.ndarray, Bool[np.ndarray, "k size c"]]:
    """The samples by intervals (k, size, c), and which of them are there and can be drawn."""
    # The last interval is filled up with NaN, which counts as not drawable.
    filled = np.pad(values, ((0, -len(values) % size), (0, 0)), constant_values=np.nan)
    filled = filled.reshape(-1, size, values.shape[1])
    return filled, drawable(filled, log)


def _middles(t: Float[np.ndarray, "T"], size: int) -> Float[np.ndarray, "k"]:
    return np.pad(t, (0, -len(t) % size), mode="edge").reshape(-1, size).mean(axis=1)


def _moving_sum(values: Columns, run: int) -> Columns:
    ones = np.ones(run)  # at both ends fewer samples are summed; their count is summed alike
    return np.stack([np.convolve(column, ones, mode="same") for column in values.T], axis=1)
