"""A curve as a line and dots: with gaps where samples are missing, and long logs thinned without losing extremes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

LIMIT = 5000
"""Largest number of points drawn of one curve; panels have fewer pixels than that."""

_DRAWABLE = 1e30
"""Larger values, or on a log axis values below its inverse, count as missing: drawing would overflow in float32."""

Samples = Float[np.ndarray, "T"]
Thinned = tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]


class Polyline(NamedTuple):
    """A curve ready to be drawn: a line with NaN at its gaps, and dots for samples without a neighbour."""

    line: Thinned
    dots: Thinned


def polyline(t: Samples, values: Samples, log: bool) -> Polyline:
    """Line and dots of one curve; on a log axis a value that is not positive is a gap."""
    shown = np.where(drawable(values, log), values, np.nan)
    alone = _alone(~np.isnan(shown))
    joined = np.where(alone, np.nan, shown)
    some = len(t) if np.isfinite(joined).any() else 1  # an empty line needs a single gap only
    return Polyline(thin(t[:some], joined[:some]), thin(t[alone], shown[alone]))


def thin(t: Samples, values: Samples, limit: int = LIMIT) -> Thinned:
    """At most `limit` samples: of each interval the smallest, the largest, and its first gap (or first sample)."""
    if len(t) <= limit:
        return t, values
    size = -(-len(t) // (limit // 3))
    rows = np.pad(values, (0, -len(t) % size), mode="edge").reshape(-1, size)
    gap = np.isnan(rows)
    smallest, largest = np.where(gap, np.inf, rows).argmin(1), np.where(gap, -np.inf, rows).argmax(1)
    within = np.stack([smallest, largest, gap.argmax(1)]) + size * np.arange(len(rows))
    keep = np.unique(np.minimum(within, len(t) - 1))
    return t[keep], values[keep]


def drawable(values: Samples, log: bool) -> Bool[np.ndarray, "T"]:
    """Which samples can be drawn on a linear or logarithmic axis."""
    least = 1 / _DRAWABLE if log else -_DRAWABLE
    return (values > least) & (values < _DRAWABLE)


def _alone(present: Bool[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    edged = np.pad(present, 1)
    return present & ~edged[:-2] & ~edged[2:]
