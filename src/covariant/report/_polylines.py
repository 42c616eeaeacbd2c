"""How a curve is drawn as a line and dots: gaps left open, long logs thinned without losing an extreme."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

LIMIT = 5000
"""Most points drawn of one curve; panels have fewer pixels than that."""

_DRAWABLE = 1e30
"""Values beyond this, or below its inverse on a log axis, count as missing: drawing overflows in single precision."""

Samples = Float[np.ndarray, "T"]
Thinned = tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]


class Polyline(NamedTuple):
    """A curve made ready: a line with NaN at its gaps, and dots for samples without a neighbour to be joined with."""

    line: Thinned
    dots: Thinned


def polyline(t: Samples, values: Samples, log: bool) -> Polyline:
    """Line and dots of one curve; on a log axis what is not positive is a gap."""
    shown = np.where(drawable(values, log), values, np.nan)
    alone = _alone(~np.isnan(shown))
    joined = np.where(alone, np.nan, shown)
    some = len(t) if np.isfinite(joined).any() else 1  # one gap says as much as many
    return Polyline(thin(t[:some], joined[:some]), thin(t[alone], shown[alone]))


def thin(t: Samples, values: Samples, limit: int = LIMIT) -> Thinned:
    """At most `limit` samples: of each interval the smallest, the largest, and the first gap (or the first sample)."""
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
