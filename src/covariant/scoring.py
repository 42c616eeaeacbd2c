"""How good a velocity estimate is, against the truth or against a reference made from the recorded positions."""

import numpy as np
from jaxtyping import Float

NumpyArray = np.ndarray


def zero_phase_velocity(
    t: Float[NumpyArray, "T"],
    y: Float[NumpyArray, "T n"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
) -> Float[NumpyArray, "K n"]:
    """Slopes at the stamps `at` [s] of local polynomials over ±`half` [s] of the positions, with tricube weights.

    It looks ahead, so it is for scoring only. Missing positions (NaN) are left out, column by column.
    """
    return np.stack([_slopes(t, column, at, half, order) for column in np.asarray(y, float).T], axis=1)


def _slopes(t, y, at, half, order):
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    if len(t) < order + 3:
        raise ValueError(f"a reference of order {order} needs {order + 3} measurements; there are {len(t)}")
    first = np.searchsorted(t, at - half)
    last = np.searchsorted(t, at + half, side="right")
    few = last - first < order + 3
    first = np.where(few, np.maximum(0, first - order - 3), first)
    last = np.where(few, np.minimum(len(t), last + order + 3), last)
    slopes = np.empty(len(at))
    for i, (a, b, now) in enumerate(zip(first, last, at, strict=True)):
        s = t[a:b] - now
        reach = max(half, np.abs(s).max())
        weight = (1 - np.minimum(np.abs(s) / reach, 1) ** 3) ** 1.5 + 1e-6
        basis = np.vander(s / reach, order + 1, increasing=True) * weight[:, None]
        slopes[i] = np.linalg.lstsq(basis, y[a:b] * weight, rcond=None)[0][1] / reach
    return slopes


def unwrap(y: Float[NumpyArray, "T n"], circles: tuple[int, ...]) -> Float[NumpyArray, "T n"]:
    """The positions with the jumps of 2π taken out of the columns that are angles on a circle; NaN stays."""
    y = np.array(y, float)
    for column in circles:
        present = np.isfinite(y[:, column])
        y[present, column] = np.unwrap(y[present, column])
    return y


def scored_window(t: Float[NumpyArray, "T"], skip: float = 1.0, tail: float = 0.2) -> np.ndarray:
    """Mask (T,) of the stamps that count: after the observer has settled and before the reference runs out.

    A log too short for that is scored over its second half.
    """
    mask = (t > t[0] + skip) & (t < t[-1] - tail)
    return mask if mask.sum() >= 10 else t >= (t[0] + t[-1]) / 2


def rmse(estimate: Float[NumpyArray, "K n"], reference: Float[NumpyArray, "K n"]) -> Float[NumpyArray, "n"]:
    """Root mean square error a coordinate."""
    return np.sqrt(np.mean((np.asarray(estimate) - np.asarray(reference)) ** 2, axis=0))
