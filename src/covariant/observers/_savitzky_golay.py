"""Causal Savitzky–Golay filter: the slope, at the last sample, of a polynomial fitted to the latest ones. No model.

Source: Savitzky & Golay 1964, Analytical Chemistry 36(8), one-sided; solved anew in each step for irregular stamps.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Number, Scalar, Vector
from covariant.geometry import wrap
from covariant.observers._model_free import AbstractLinearFilter, FilterInfo
from covariant.observers._protocol import outcome


class WindowState(NamedTuple):
    """Ages [s] (k,) and positions (k, n) of the latest samples, newest last, NaN where missing; and q and v."""

    age: Float[Array, "k"]
    y: Float[Array, "k n"]
    q: Vector
    v: Vector


class SavitzkyGolay(AbstractLinearFilter):
    """Least-squares polynomial over the last `window` samples; `order` its degree, `circles` as in `Lagrangian`.

    Raises `ValueError` when the window is not longer than the order.
    """

    window: int = eqx.field(static=True)
    order: int = eqx.field(default=2, static=True)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)

    def __check_init__(self):
        if not self.window > self.order >= 1:
            raise ValueError(
                f"SavitzkyGolay: window {self.window} must exceed order {self.order}, and order be 1 or more"
            )

    def init(self, y: Vector, t: Number = 0.0) -> WindowState:
        past = jnp.full((self.window - 1, y.shape[0]), jnp.nan, y.dtype)
        age = jnp.zeros(self.window, y.dtype)
        return WindowState(age, jnp.concatenate([past, y[None]]), y, jnp.zeros_like(y))

    def estimate(self, state: WindowState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def predict(self, state: WindowState, u: Float[Array, "m"], dt: Scalar) -> WindowState:
        # The newest sample is missing until it comes.
        age = jnp.append(state.age[1:] + dt, 0.0)
        samples = jnp.concatenate([state.y[1:], jnp.full_like(state.y[:1], jnp.nan)])
        return WindowState(age, samples, state.q + dt * state.v, state.v)

    def correct(self, state: WindowState, u: Float[Array, "m"], y: Vector) -> tuple[WindowState, FilterInfo]:
        difference = wrap(self.circles, y - state.q)
        samples = jnp.concatenate([state.y[:-1], (state.q + difference)[None]])
        q, v = self._fit(state.age, samples, state.q, state.v)
        info = FilterInfo(self.innovation(state, u, y), outcome(q, v, y))
        return WindowState(state.age, samples, q, v), info

    def innovation(self, state: WindowState, u: Float[Array, "m"], y: Vector) -> Vector:
        return jnp.where(jnp.isnan(y), 0.0, wrap(self.circles, y - state.q))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        ages = -np.arange(self.window) / rate
        return np.linalg.pinv(np.vander(ages, self.order + 1, increasing=True))[1]

    def _fit(self, age, samples, expected: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Value and slope at age zero; a weak prior (expected, v) decides only where there are too few samples."""
        span = jnp.maximum(age[0], jnp.finfo(age.dtype).tiny)
        powers = jnp.stack([(-age / span) ** k for k in range(self.order + 1)], axis=1)
        faint = 1e-9 * jnp.eye(self.order + 1, dtype=samples.dtype)

        def fit(column, start, slope):
            present = ~jnp.isnan(column)
            residual = jnp.nan_to_num(column - start + age * slope)
            weighted = powers * present[:, None].astype(powers.dtype)
            return solve(weighted.T @ powers + faint, weighted.T @ residual)

        found = jax.vmap(fit)(samples.T, expected, v)
        value, slope = found[:, 0], found[:, 1]
        return expected + value, v + slope / span
