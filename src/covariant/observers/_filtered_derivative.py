"""Backward difference through a first-order low-pass filter, as in most drives. It uses no model."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import wrap
from covariant.observers._model_free import AbstractLinearFilter, FilterInfo
from covariant.observers._protocol import as_gain, check_positive, outcome


class FilteredState(NamedTuple):
    """Last measured position, filtered velocity, and the age [s] of that measurement, per coordinate."""

    q: Vector
    v: Vector
    age: Vector


class FilteredDerivative(AbstractLinearFilter):
    """`v' = ω (Δy/Δt − v)`, exact for irregular stamps; `bandwidth` ω [rad/s], `circles` as in `Lagrangian`.

    Raises `ValueError` for a bandwidth that is not positive and finite.
    """

    bandwidth: Scalar = eqx.field(converter=as_gain)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)

    def __check_init__(self):
        check_positive("FilteredDerivative", bandwidth=self.bandwidth)

    def init(self, y: Vector, t: Number = 0.0) -> FilteredState:
        return FilteredState(y, jnp.zeros_like(y), jnp.zeros_like(y))

    def estimate(self, state: FilteredState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q + state.age * state.v, state.v])

    def predict(self, state: FilteredState, u: Float[Array, "m"], dt: Scalar) -> FilteredState:
        return state._replace(age=state.age + dt)

    def correct(self, state: FilteredState, u: Float[Array, "m"], y: Vector) -> tuple[FilteredState, FilterInfo]:
        age, (present, moved) = state.age, self._moved(state, y)
        slope = moved / jnp.where(age > 0, age, 1.0)
        v = state.v + jnp.where(present, -jnp.expm1(-self.bandwidth * age) * (slope - state.v), 0.0)
        q = state.q + moved
        new = FilteredState(q, v, jnp.where(present, 0.0, age))
        return new, FilterInfo(self.innovation(state, u, y), outcome(q, v, y))

    def innovation(self, state: FilteredState, u: Float[Array, "m"], y: Vector) -> Vector:
        present, moved = self._moved(state, y)
        return jnp.where(present, moved - state.age * state.v, 0.0)

    def _moved(self, state: FilteredState, y: Vector) -> tuple[Bool[Array, "n"], Vector]:
        """Which coordinates are measured anew, and how far they are from the last measurement of each."""
        present = ~jnp.isnan(y) & (state.age > 0)
        return present, wrap(self.circles, jnp.where(present, y - state.q, 0.0))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        bandwidth = float(self.bandwidth)
        decay = np.exp(-bandwidth / rate)
        difference = (1 - decay) * decay ** np.arange(min(2000, int(12 * rate / bandwidth) + 2)) * rate
        return np.append(difference, 0.0) - np.append(0.0, difference)
