"""Chooses the initial range of a panel's y axis: the steady part of the estimates, without the tip of an overshoot."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.report._panels import Quantity, shorten
from covariant.report._polylines import drawable

_TRANSIENT = 0.25
"""Fraction of the record, from its start, in which an estimate may still converge; this part does not set the axis."""

_LOST = 10.0
"""An estimate whose range exceeds the range of the motion and of the first estimate by this factor does not set the
axis."""

_GAIN = (1.6, 1e4)
"""Samples are left off the scale only if this enlarges the rest by a factor in this range. A smaller factor gains too
little; a larger one occurs in exact simulations, in which the transient is the only thing to see."""

_FEW = 20
"""With fewer samples than this after the transient, all samples determine the axis."""

Samples = Float[np.ndarray, "T"]


class AxisRange(NamedTuple):
    """Limits of a y axis.

    Attributes:
        low: Lower end, in the unit of the data.
        high: Upper end.
        outside: A sentence on the samples outside the limits, or "".
    """

    low: float
    high: float
    outside: str


class _Range(NamedTuple):
    """Ends along the axis (logarithms on a log axis) of all samples of a curve, and of those that must be shown."""

    label: str
    backdrop: bool
    low: float
    high: float
    wanted_low: float
    wanted_high: float


def axis_range(quantity: Quantity, column: int, hidden: Collection[str] = ()) -> AxisRange | None:
    """Choose the limits of the y axis of one panel, by the curves that are not hidden.

    Backdrops are shown in full. An estimate is shown from the end of its transient (on a log axis, from the start),
    without single spikes that are farther from its central 99.5 % than the width of these, and only if it has not
    diverged.
    """
    shown = tuple(curve for curve in quantity.curves if curve.label not in hidden)
    ranges = _ranges(quantity._replace(curves=shown), column)
    if not ranges:
        return None
    shown = ranges if quantity.log else _drop_diverged(ranges, quantity.scale[column])
    low, high = _pad_range(min(r.wanted_low for r in shown), max(r.wanted_high for r in shown), quantity.log)
    lowest, highest = _pad_range(min(r.low for r in shown), max(r.high for r in shown), quantity.log)
    if not _GAIN[0] < (highest - lowest) / (high - low) < _GAIN[1]:  # _pad_range makes both differences positive
        low, high = lowest, highest
    outside = _outside(ranges, low, high, quantity.log)
    return AxisRange(10**low, 10**high, outside) if quantity.log else AxisRange(low, high, outside)


def _ranges(quantity: Quantity, column: int) -> list[_Range]:
    ranges = []
    for curve in quantity.curves:
        if curve.role in ("raw", "mark"):
            continue
        t, values = curve.t, curve.values[:, column]
        if curve.below is not None:
            t, values = np.tile(t, 2), np.concatenate([curve.below[:, column], values])
        visible = drawable(values, quantity.log)
        if visible.any():
            y = values[visible]
            y = np.log10(y) if quantity.log else y
            ends = float(y.min()), float(y.max())
            late = y if quantity.log else y[_late(t)[visible]]
            wanted = ends if curve.backdrop else _core(late if len(late) >= _FEW else y)
            # The initial width of a band is not informative, so it does not set the axis.
            ends = wanted if curve.role == "bounds" else ends
            ranges.append(_Range(curve.label, curve.backdrop, *ends, *wanted))
    return ranges


def _late(t: Samples) -> Bool[np.ndarray, "T"]:
    return t >= t[0] + _TRANSIENT * (t[-1] - t[0])


def _core(y: Samples) -> tuple[float, float]:
    """Ends of the samples, without spikes that are farther off than the width of their central 99.5 %."""
    low, high = np.quantile(y, [0.0025, 0.9975])
    # 2 low − high is the width of the central range below it, and 2 high − low that above it.
    return float(max(y.min(), 2 * low - high)), float(min(y.max(), 2 * high - low))


def _drop_diverged(ranges: list[_Range], scale: float) -> list[_Range]:
    """The backdrops, the first estimate, and those estimates whose range is not far larger than theirs."""
    first = next((r for r in ranges if not r.backdrop), ranges[0])
    most = _LOST * max(first.wanted_high - first.wanted_low, scale)
    return [r for r in ranges if r.backdrop or r is first or r.wanted_high - r.wanted_low <= most]


def _pad_range(low: float, high: float, log: bool) -> tuple[float, float]:
    """Ends with a margin; if they are equal up to rounding, the margin shows their level."""
    size = max(abs(low), abs(high))
    level = 0.5 if log else 0.1 * size or 1.0
    # Ends that agree to nine digits differ by rounding only, which would otherwise fill the panel with noise.
    air = 0.06 * (high - low) if high - low > 1e-9 * size else level
    return low - air, high + air


def _outside(ranges: list[_Range], low: float, high: float, log: bool) -> str:
    """A note on how far the worst curve leaves the panel, and how many others do."""
    beyond = [r for r in ranges if r.low < low or r.high > high]
    if not beyond:
        return ""
    worst = max(beyond, key=lambda r: max(low - r.low, r.high - high))
    end = worst.low if low - worst.low > worst.high - high else worst.high
    others = len({r.label for r in beyond}) - 1
    more = f", {others} more" if others else ""
    return f"off scale: {shorten(worst.label, 20)} {_number(10**end if log else end)}{more}"


def _number(value: float) -> str:
    return format(value, ".0f" if 1e3 <= abs(value) < 1e6 else ".3g").replace("-", "−")
