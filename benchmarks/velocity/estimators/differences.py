"""Differences, an adaptive window and a Kalman filter of constant acceleration: each joint by itself, no model."""

from collections.abc import Sequence

import numpy as np

from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, until
from covariant.scoring import unwrap

LONGEST = 100
"""Longest adaptive window [rows]."""


def readings(case: Case, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (R,) and positions (R, n), continuous across full turns; a missing one repeats the last."""
    count = until(rows)
    y = unwrap(np.asarray(case.loaded.record.y), case.model.circles)[:count].copy()
    for column in y.T:
        known = np.isfinite(column)
        column[:] = column[np.maximum.accumulate(np.where(known, np.arange(count), np.argmax(known)))]
    return case.t[:count], y


class Difference(AbstractEstimator):
    """Last difference over the last interval."""

    name, source = "difference", "common practice"

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        t, y = readings(case, rows)
        v = np.diff(y, axis=0, prepend=y[:1]) / np.diff(t, prepend=t[0] - 1)[:, None]
        return [Estimate(v) for _ in numbers]

    def operations(self, case: Case, numbers: Numbers) -> int | None:
        return 1 + 2 * case.loaded.file.dimension


class AdaptiveWindow(AbstractEstimator):
    """Slope of the longest window whose end points' line is within a bound of all its readings."""

    name = "adaptive-window"
    source = "Janabi-Sharifi, Hayward & Chen 2000, end-fit first-order adaptive windowing"

    def ranges(self, case: Case) -> dict[str, tuple[float, float]]:
        std = case.loaded.file.typical_std
        return {"bound": (0.3 * std, 100 * std)}

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        t, y = readings(case, rows)
        return [Estimate(self._slopes(t, y, one["bound"])) for one in numbers]

    def _slopes(self, t: np.ndarray, y: np.ndarray, bound: float) -> np.ndarray:
        v, grows = np.zeros_like(y), np.ones(y.shape, bool)
        for size in range(1, min(LONGEST, len(t) - 1) + 1):
            slope = (y[size:] - y[:-size]) / (t[size:] - t[:-size])[:, None]
            fits = np.ones(slope.shape, bool)
            for age in range(1, size):
                at = slice(size - age, len(t) - age)
                line = y[size:] - slope * (t[size:] - t[at])[:, None]
                fits &= np.abs(line - y[at]) <= bound
            grows[size:] &= fits
            grows[:size] = False
            if not grows.any():
                break
            v[size:] = np.where(grows[size:], slope, v[size:])
        return v


class ConstantAcceleration(AbstractEstimator):
    """Kalman filter of a joint whose jerk is white noise."""

    name, source = "constant-acceleration", "Bar-Shalom, Li & Kirubarajan 2001, 6.2.3"

    def ranges(self, case: Case) -> dict[str, tuple[float, float]]:
        size = case.acceleration
        return {"jerk_density": (1e-2 * size, 1e3 * size)}

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        t, y = readings(case, rows)
        noise = np.broadcast_to(np.asarray(case.loaded.file.typical_std) ** 2, y.shape[1])
        # All joints and all sets of numbers at once: (set, joint) before the three states.
        density = np.array([one["jerk_density"] for one in numbers])[:, None, None, None] ** 2
        x = np.zeros((len(numbers), y.shape[1], 3))
        x[..., 0] = y[0]
        cov = np.zeros((*x.shape, 3)) + np.diag([noise.max(), (10 * case.acceleration) ** 2, case.acceleration**2])
        v, std = np.zeros((2, len(t), *x.shape[:2]))
        for k in range(1, len(t)):
            h = t[k] - t[k - 1]
            step = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
            grown = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
            x, cov = x @ step.T, step @ cov @ step.T + density * grown
            gain = cov[..., 0] / (cov[..., 0, 0] + noise)[..., None]
            x = x + gain * (y[k] - x[..., 0])[..., None]
            cov = cov - gain[..., :, None] * cov[..., 0, None, :]
            v[k], std[k] = x[..., 1], np.sqrt(cov[..., 1, 1])
        return [Estimate(v[:, k], std[:, k]) for k in range(len(numbers))]


ESTIMATORS = [Difference(), AdaptiveWindow(), ConstantAcceleration()]
