"""Differentiates positions by a backward difference and a first-order low-pass filter, as in most drives; no model."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import wrap
from covariant.observers.base import as_gain, check_positive, outcome
from covariant.observers.differentiators._model_free import AbstractLinearFilter, FilterInfo


class FilteredState(NamedTuple):
    """State of a `FilteredDerivative`.

    Attributes:
        q: Last measured position (n,) [rad or m].
        v: Filtered velocity (n,) [rad/s or m/s].
        age: Time (n,) since the last measurement of each coordinate [s].

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> derivative = observers.FilteredDerivative(bandwidth=20.0)
        >>> state = derivative.predict(derivative.init(np.array([0.5])), np.zeros(0), 0.01)
        >>> state.q.tolist(), state.v.tolist(), state.age.tolist()
        ([0.5], [0.0], [0.01])
    """

    q: Vector
    v: Vector
    age: Vector


class FilteredDerivative(AbstractLinearFilter):
    """Backward difference through a first-order low-pass filter: `v' = ω (Δy/Δt − v)`, exact for irregular stamps.

    It is the usual filter of drives, and the choice if there is no model and little computing power. The velocity lags
    by about 1/ω, and a larger bandwidth trades this lag for noise. `PLL` has no lag at a steady speed, and
    `JointKalman` is better if the noise and the usual accelerations are known.

    Attributes:
        bandwidth: Bandwidth ω of the filter [rad/s].
        circles: Indices of the coordinates that are angles on a full circle, which are differentiated modulo a turn;
            none by default.

    Raises:
        ValueError: The bandwidth is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = observers.run(observers.FilteredDerivative(bandwidth=20.0), Record(t, y=2.0 * t[:, None]))
        >>> run.estimate[-1].round(3).tolist()
        [2.0, 2.0]
    """

    bandwidth: Scalar = eqx.field(converter=as_gain)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)

    def __check_init__(self):
        check_positive("FilteredDerivative", bandwidth=self.bandwidth)

    def init(self, y: Vector, t: Number = 0.0) -> FilteredState:
        return FilteredState(y, jnp.zeros_like(y), jnp.zeros_like(y))

    def estimate(self, state: FilteredState) -> Float[Array, "two_n"]:
        """Position extrapolated from the last measurement with the filtered velocity, and this velocity.

        Args:
            state: State of the filter.

        Returns:
            The estimate (2n,): positions, then velocities.
        """
        return jnp.concatenate([state.q + state.age * state.v, state.v])

    def predict(self, state: FilteredState, u: Float[Array, "m"], dt: Scalar) -> FilteredState:
        return state._replace(age=state.age + dt)

    def correct(self, state: FilteredState, u: Float[Array, "m"], y: Vector) -> tuple[FilteredState, FilterInfo]:
        """Filter the slope from the last measurement of each coordinate to the new one.

        Args:
            state: State that `predict` returned.
            u: Input (m,), without influence.
            y: Measured positions (n,) [rad or m], NaN where missing.

        Returns:
            The new state and the info.
        """
        age, (present, displacement) = state.age, self._displacement(state, y)
        # A coordinate with age 0 has no new measurement; the divisor 1 avoids 0/0.
        slope = displacement / jnp.where(age > 0, age, 1.0)
        # The exact solution of v' = ω (slope − v) over the age; expm1 keeps the digits if ω · age is small.
        v = state.v + jnp.where(present, -jnp.expm1(-self.bandwidth * age) * (slope - state.v), 0.0)
        q = state.q + displacement
        new = FilteredState(q, v, jnp.where(present, 0.0, age))
        return new, FilterInfo(self.innovation(state, u, y), outcome(q, v, y))

    def innovation(self, state: FilteredState, u: Float[Array, "m"], y: Vector) -> Vector:
        present, displacement = self._displacement(state, y)
        return jnp.where(present, displacement - state.age * state.v, 0.0)

    def _displacement(self, state: FilteredState, y: Vector) -> tuple[Bool[Array, "n"], Vector]:
        """Which coordinates (n,) have a new measurement, and its differences (n,) from the last one."""
        present = ~jnp.isnan(y) & (state.age > 0)
        return present, wrap(self.circles, jnp.where(present, y - state.q, 0.0))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        bandwidth = float(self.bandwidth)
        decay = np.exp(-bandwidth / rate)
        # The series is cut off after 12 time constants, when e⁻¹² remains, or after 2000 samples.
        difference = (1 - decay) * decay ** np.arange(min(2000, int(12 * rate / bandwidth) + 2)) * rate
        # A slope contributes to the newer position with its weight, and to the older one with the negative weight.
        return np.append(difference, 0.0) - np.append(0.0, difference)
