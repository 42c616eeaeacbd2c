"""What a model leaves unexplained of a smoothed log: the measured accelerations less those that the model gives."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._smooth import Smooth
from covariant.models import MechanicalSystem, acceleration

POINTS = 2048
"""Points that the compiled program evaluates at a time, so that one program serves all logs."""
CLEAR = 10.0
"""Accelerations are told from noise where their mean square is so many times that of the noise."""


class Residual(NamedTuple):
    """Accelerations (K, n) on the grid: measured ones, and those of the model averaged in the same way.

    - `used` (K,): where both are known; `noise` (n,): standard deviation of the measured ones.
    """

    measured: Float[np.ndarray, "K n"]
    modelled: Float[np.ndarray, "K n"]
    used: Bool[np.ndarray, "K"]
    noise: Float[np.ndarray, "n"]

    @property
    def left(self) -> Float[np.ndarray, "J n"]:
        """What the model leaves, where it is known."""
        return (self.measured - self.modelled)[self.used]

    @property
    def told(self) -> Bool[np.ndarray, "n"]:
        """Coordinates whose accelerations are more than noise."""
        if self.used.sum() < 2 * POINTS_OF_A_BLOCK:
            return np.zeros(self.measured.shape[1], bool)
        return np.mean(self.measured[self.used] ** 2, axis=0) > CLEAR * self.noise**2

    def misfits(self, blocks: int = 1) -> Float[np.ndarray, "b n"]:
        """Fractions of the accelerations that are unexplained, in blocks of equal length: 0 right, 1 or more unrelated.

        The sum of squares of what is left, without that of the noise, over the mean of those of measured and modelled
        accelerations over the whole log, so that neither a tiny nor a huge unit makes it small.
        """
        left, measured, modelled = self.left, self.measured[self.used], self.modelled[self.used]
        scale = (np.mean(measured**2, axis=0) + np.mean(modelled**2, axis=0)) / 2
        parts = np.array_split(left**2 - self.noise**2, blocks)
        return np.array([part.mean(axis=0) for part in parts]) / np.where(scale > 0, scale, 1.0)

    @property
    def misfit(self) -> float:
        """The mean of the unexplained fractions of the coordinates whose accelerations are more than noise."""
        told = self.told
        return float(np.maximum(self.misfits()[0, told], 0.0).mean()) if told.any() else float("nan")


POINTS_OF_A_BLOCK = 30


def residual(model: MechanicalSystem, log: Smooth, force: Any = None) -> Residual:
    """Compare a model with a smoothed log; `force` (K, n) is a further generalised force."""
    modelled = averaged(log, accelerations(model, log, force))
    used = log.used & np.isfinite(modelled).all(axis=1) & np.isfinite(log.a).all(axis=1)
    return Residual(log.a, modelled, used, log.a_noise)


def averaged(log: Smooth, values: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "K n"]:
    """Values on the grid, averaged as smoothing averages the true accelerations."""
    return np.stack([np.convolve(column, log.kernel, "same") for column in values.T], axis=1)


def accelerations(model: MechanicalSystem, log: Smooth, force: Any = None) -> Float[np.ndarray, "K n"]:
    """Accelerations of the model on the grid, with a further generalised force (K, n)."""
    given = (log.t, log.q, log.v, log.u, np.zeros_like(log.q) if force is None else force)
    found = []
    for start in range(0, len(log.t), POINTS):
        part = [array[start : start + POINTS] for array in given]
        count = len(part[0])
        padded = [np.concatenate([array, np.repeat(array[-1:], POINTS - count, axis=0)]) for array in part]
        found.append(np.asarray(_accelerations(model, *padded))[:count])
    return np.concatenate(found)


@eqx.filter_jit
def _accelerations(model, t, q, v, u, force):
    def at(t, q, v, u, force):
        return acceleration(model, t, q, v, u) + model.space.raise_(q, force)

    return jax.vmap(at)(t, q, v, u, force)
