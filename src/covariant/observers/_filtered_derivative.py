"""Backward difference through a first-order low-pass filter, as in most drives. It uses no model."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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

    def advance(
        self, state: FilteredState, u: Float[Array, "m"], y: Vector, dt: Scalar
    ) -> tuple[FilteredState, FilterInfo]:
        age = state.age + dt
        present = ~jnp.isnan(y) & (age > 0)
        moved = wrap(self.circles, jnp.where(present, y - state.q, 0.0))
        slope = moved / jnp.where(age > 0, age, 1.0)
        v = state.v + jnp.where(present, -jnp.expm1(-self.bandwidth * age) * (slope - state.v), 0.0)
        q = state.q + moved
        innovation = jnp.where(present, moved - age * state.v, 0.0)
        new = FilteredState(q, v, jnp.where(present, 0.0, age))
        return new, FilterInfo(innovation, outcome(q, v, y))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        bandwidth = float(self.bandwidth)
        decay = np.exp(-bandwidth / rate)
        difference = (1 - decay) * decay ** np.arange(min(2000, int(12 * rate / bandwidth) + 2)) * rate
        return np.append(difference, 0.0) - np.append(0.0, difference)
