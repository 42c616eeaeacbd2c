"""Computes the autocorrelation of innovations; if those of a filter are correlated, its model is wrong."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LAGS = 40
"""Number of lags, in samples, at which the autocorrelation is computed."""

NORMAL_95 = 1.96
"""For white noise, 95 % of correlations are within this over the root of the number of samples (Bartlett 1946)."""


class Autocorrelation(NamedTuple):
    """Correlations (L, c) of c signals with themselves at some lags (L,) [s], and the 95 % bound of white noise."""

    lags: Float[np.ndarray, "L"]
    values: Float[np.ndarray, "L c"]
    bound: float


def autocorrelation(t: Float[np.ndarray, "T"], signal: Float[np.ndarray, "T c"]) -> Autocorrelation | None:
    """Correlate signals with themselves; NaN is left out. Returns None if there are too few samples or no variation."""
    present = np.isfinite(signal)
    count = int(present.all(axis=1).sum())
    most = min(LAGS, count // 4)
    if most < 1:
        return None
    mean = np.nanmean(np.where(present, signal, np.nan), axis=0)
    e = np.where(present, signal - mean, 0.0)
    power = np.sum(e**2, axis=0) / present.sum(axis=0)
    if not np.all(power > 0) or not np.all(np.isfinite(power)):
        return None
    # Missing samples leave fewer pairs for some lags, so each sum is divided by its own count.
    pairs = [(e[:-lag] * e[lag:], present[:-lag] & present[lag:]) for lag in range(1, most + 1)]
    values = np.array([product.sum(0) / np.maximum(both.sum(0), 1) for product, both in pairs]) / power
    step = float(np.median(np.diff(t)))
    return Autocorrelation(step * np.arange(1, most + 1), values, NORMAL_95 / math.sqrt(count))
