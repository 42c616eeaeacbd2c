"""Residual accelerations of a smoothed log: the measured ones minus those of the model."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._smooth import Smooth
from covariant.lowering import on_batches
from covariant.models import MechanicalSystem, acceleration

POINTS = 2048
"""Points of the grid at once: for a model without a graph one compiled program serves all logs."""
CLEAR = 10.0
"""Ratio of the mean square of accelerations to that of the noise, from which they count as more than noise."""


class Residual(NamedTuple):
    """Accelerations on the grid of a smoothed log: measured ones, and those of the model averaged in the same way.

    Attributes:
        measured: Measured accelerations (K, n).
        modelled: Accelerations (K, n) of the model.
        used: Points (K,) at which both are known.
        noise: Standard deviation (n,) of the measured ones.
    """

    measured: Float[np.ndarray, "K n"]
    modelled: Float[np.ndarray, "K n"]
    used: Bool[np.ndarray, "K"]
    noise: Float[np.ndarray, "n"]

    @property
    def left(self) -> Float[np.ndarray, "J n"]:
        """Residual accelerations (J, n), measured minus modelled, at the J points that are used."""
        return (self.measured - self.modelled)[self.used]

    @property
    def told(self) -> Bool[np.ndarray, "n"]:
        """Coordinates (n,) whose accelerations exceed the noise; none with fewer than two blocks of points."""
        if self.used.sum() < 2 * POINTS_OF_A_BLOCK:
            return np.zeros(self.measured.shape[1], bool)
        return np.mean(self.measured[self.used] ** 2, axis=0) > CLEAR * self.noise**2

    def misfits(self, blocks: int = 1) -> Float[np.ndarray, "b n"]:
        """Unexplained fractions of the accelerations, in blocks of equal length.

        The sum of squares of the residuals, without that of the noise, over the mean of those of measured and modelled
        accelerations over the whole log, so that neither a tiny nor a huge unit makes it small.

        Args:
            blocks: Number b of blocks.

        Returns:
            The fractions (b, n): 0 for a model that is right, 1 or more for one that is unrelated.
        """
        left, measured, modelled = self.left, self.measured[self.used], self.modelled[self.used]
        scale = (np.mean(measured**2, axis=0) + np.mean(modelled**2, axis=0)) / 2
        # The expected square of a residual is that of the model's error plus that of the noise.
        parts = np.array_split(left**2 - self.noise**2, blocks)
        return np.array([part.mean(axis=0) for part in parts]) / np.where(scale > 0, scale, 1.0)

    @property
    def misfit(self) -> float:
        """Mean unexplained fraction of the coordinates whose accelerations exceed the noise; NaN for none."""
        told = self.told
        return float(np.maximum(self.misfits()[0, told], 0.0).mean()) if told.any() else float("nan")


POINTS_OF_A_BLOCK = 30


def residual(model: MechanicalSystem, log: Smooth, force: Any = None) -> Residual:
    """Compare the accelerations of a model with those of a smoothed log.

    Args:
        model: The mechanical system.
        log: The smoothed log, on a grid of K points.
        force: Further generalised force (K, n); None for none.

    Returns:
        Measured and modelled accelerations.
    """
    modelled = averaged(log, accelerations(model, log, force))
    used = log.used & np.isfinite(modelled).all(axis=1) & np.isfinite(log.a).all(axis=1)
    return Residual(log.a, modelled, used, log.a_noise)


def averaged(log: Smooth, values: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "K n"]:
    """Average values on the grid with the weights that smoothing applies to the true accelerations.

    Args:
        log: The smoothed log.
        values: Values (K, n).

    Returns:
        The averages (K, n).
    """
    # The same weights on both sides: what smoothing does to a true acceleration it does to the model's.
    return np.stack([np.convolve(column, log.kernel, "same") for column in values.T], axis=1)


def accelerations(model: MechanicalSystem, log: Smooth, force: Any = None) -> Float[np.ndarray, "K n"]:
    """Accelerations of the model on the grid.

    Args:
        model: The mechanical system.
        log: The smoothed log, on a grid of K points.
        force: Further generalised force (K, n); None for none.

    Returns:
        The accelerations (K, n).
    """
    data = (log.t, log.q, log.v, log.u, np.zeros_like(log.q) if force is None else force)
    chunks = []
    for start in range(0, len(log.t), POINTS):
        part = [array[start : start + POINTS] for array in data]
        count = len(part[0])
        padded = [np.concatenate([array, np.repeat(array[-1:], POINTS - count, axis=0)]) for array in part]
        chunks.append(_accelerations(model, log.q.shape[1], log.u.shape[1])(*padded)[:count])
    return np.concatenate(chunks)


@functools.lru_cache(maxsize=4)  # a check compares one model with many logs
def _accelerations(model: MechanicalSystem, n: int, m: int) -> Callable:
    def at(t, q, v, u, force):
        return acceleration(model, t, q, v, u) + model.space.raise_(q, force)

    return on_batches(at, np.zeros(()), np.zeros(n), np.zeros(n), np.zeros(m), np.zeros(n))
