"""Converts a curve to a line and dots, with gaps at missing samples, and a band to its outline or to polygons."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_DRAWABLE = 1e30
"""Larger values, and on a log axis values below the inverse, count as missing: drawing would overflow in float32."""

Samples = Float[np.ndarray, "T"]
Points = tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]


class Polyline(NamedTuple):
    """A curve ready to be drawn.

    Attributes:
        line: Points of the line, with NaN at gaps.
        dots: Samples without a neighbour, which would be invisible as a line.
    """

    line: Points
    dots: Points


def polyline(t: Samples, values: Samples, log: bool) -> Polyline:
    """Split a curve into a line and dots."""
    shown = np.where(drawable(values, log), values, np.nan)
    alone = _alone(~np.isnan(shown))
    joined = np.where(alone, np.nan, shown)
    some = len(t) if np.isfinite(joined).any() else 1  # an empty line needs only a single gap
    return Polyline((t[:some], joined[:some]), (t[alone], shown[alone]))


def polygons(t: Samples, low: Samples, high: Samples) -> Points:
    """Convert a band to closed polygons, one for each run of existing samples, with gaps between them."""
    there = np.pad(np.isfinite(low) & np.isfinite(high), 1).astype(int)
    ends = zip(np.flatnonzero(np.diff(there) > 0), np.flatnonzero(np.diff(there) < 0), strict=True)
    x, y = [], []
    for first, last in ends:
        run = slice(first, last)
        # The polygon goes along the lower edge and back along the upper one; NaN separates it from the next.
        x += [t[run], t[run][::-1], t[last - 1 : last]]
        y += [low[run], high[run][::-1], [np.nan]]
    return (np.concatenate(x), np.concatenate(y)) if x else (t[:0], low[:0])


def drawable(values: Float[np.ndarray, "*T"], log: bool) -> Bool[np.ndarray, "*T"]:
    """Mask of the samples that can be drawn."""
    least = 1 / _DRAWABLE if log else -_DRAWABLE
    # Every comparison with NaN is false, so NaN is not drawable.
    return (values > least) & (values < _DRAWABLE)


def _alone(present: Bool[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    edged = np.pad(present, 1)
    return present & ~edged[:-2] & ~edged[2:]
