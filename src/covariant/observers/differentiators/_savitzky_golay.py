"""Causal Savitzky–Golay filter: the slope at the last sample of a polynomial fitted to the latest samples; no model.

Source: Savitzky & Golay 1964, Analytical Chemistry 36(8), one-sided; solved again in each step, for irregular stamps.
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
from covariant.observers.base import outcome
from covariant.observers.differentiators._model_free import AbstractLinearFilter, FilterInfo
from scalargraph.errors import InputError


class WindowState(NamedTuple):
    """State of a `SavitzkyGolay` filter: its window of samples and the estimate.

    Attributes:
        age: Ages (k,) of the latest k samples, newest last [s].
        y: Positions (k, n) of these samples, NaN where missing.
        q: Estimated position (n,) [rad or m].
        v: Estimated velocity (n,) [rad/s or m/s].

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> observers.SavitzkyGolay(window=3).init(np.array([0.5])).y.tolist()
        [[nan], [nan], [0.5]]
    """

    age: Float[Array, "k"]
    y: Float[Array, "k n"]
    q: Vector
    v: Vector


class SavitzkyGolay(AbstractLinearFilter):
    """Value and slope, at the last sample, of the least-squares polynomial over a window of samples.

    A sample that has left the window has no influence any more. A longer window reduces the noise of the slope as its
    length to the power −3/2, and biases motions that are not polynomials of this order within it. It stores `window`
    samples for each coordinate; a recursive filter such as `JointKalman` needs less memory.

    Attributes:
        window: Number of samples k in the window.
        order: Degree of the polynomial; 2 by default.
        circles: Indices of the coordinates that are angles on a full circle, which are differentiated modulo a turn;
            none by default.

    Raises:
        ValueError: The window is not longer than the order, or the order is less than 1.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = observers.run(observers.SavitzkyGolay(window=7), Record(t, y=t[:, None] ** 2))
        >>> run.estimate[-1].round(3).tolist()  # a parabola is fitted without error
        [1.0, 2.0]
    """

    window: int = eqx.field(static=True)
    order: int = eqx.field(default=2, static=True)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)

    def __check_init__(self):
        if not self.window > self.order >= 1:
            raise InputError(
                f"SavitzkyGolay: window {self.window} must exceed order {self.order}, and order be 1 or more"
            )

    def init(self, y: Vector, t: Number = 0.0) -> WindowState:
        past = jnp.full((self.window - 1, y.shape[0]), jnp.nan, y.dtype)
        age = jnp.zeros(self.window, y.dtype)
        return WindowState(age, jnp.concatenate([past, y[None]]), y, jnp.zeros_like(y))

    def estimate(self, state: WindowState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def predict(self, state: WindowState, u: Float[Array, "m"], dt: Scalar) -> WindowState:
        """Shift the window by one sample, which is still missing, and extrapolate the position.

        Args:
            state: State after the previous sample.
            u: Input (m,), without influence.
            dt: Length of the step [s].

        Returns:
            The state dt later, before a measurement.
        """
        # The newest sample counts as missing until `correct` enters it; dt = 0 adds no sample.
        age = jnp.where(dt > 0, jnp.append(state.age[1:] + dt, 0.0), state.age)
        samples = jnp.where(dt > 0, jnp.concatenate([state.y[1:], jnp.full_like(state.y[:1], jnp.nan)]), state.y)
        return WindowState(age, samples, state.q + dt * state.v, state.v)

    def correct(self, state: WindowState, u: Float[Array, "m"], y: Vector) -> tuple[WindowState, FilterInfo]:
        """Enter the measurement in the window, and fit the polynomial.

        Args:
            state: State that `predict` returned.
            u: Input (m,), without influence.
            y: Measured positions (n,) [rad or m], NaN where missing.

        Returns:
            The new state and the info.
        """
        difference = wrap(self.circles, y - state.q)
        # The turn nearest to the expected angle is used, so that the window has no jumps by 2π.
        samples = jnp.concatenate([state.y[:-1], (state.q + difference)[None]])
        q, v = self._fit(state.age, samples, state.q, state.v)
        info = FilterInfo(self.innovation(state, u, y), outcome(q, v, y))
        return WindowState(state.age, samples, q, v), info

    def innovation(self, state: WindowState, u: Float[Array, "m"], y: Vector) -> Vector:
        return jnp.where(jnp.isnan(y), 0.0, wrap(self.circles, y - state.q))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        """Weights of the measured positions in the slope of the polynomial at the newest.

        Args:
            rate: Rate of even sampling [Hz].

        Returns:
            Weights (k,) [1/s], newest first.
        """
        ages = -np.arange(self.window) / rate
        # Row 1 of the pseudoinverse gives the coefficient of the linear term, the slope at age zero.
        return np.linalg.pinv(np.vander(ages, self.order + 1, increasing=True))[1]

    def _fit(self, age, samples, expected: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Value and slope at age zero; a weak prior (expected, v) matters only if there are too few samples."""
        span = jnp.maximum(age[0], jnp.finfo(age.dtype).tiny)
        # Ages are in units of the window; otherwise the powers would differ by orders of magnitude.
        powers = jnp.stack([(-age / span) ** k for k in range(self.order + 1)], axis=1)
        # The prior is negligible against squares of order 1 in a window with samples, and regularises an empty one.
        prior = 1e-9 * jnp.eye(self.order + 1, dtype=samples.dtype)

        def fit(column, start, slope):
            present = ~jnp.isnan(column)
            residual = jnp.nan_to_num(column - start + age * slope)
            weighted = powers * present[:, None].astype(powers.dtype)
            return solve(weighted.T @ powers + prior, weighted.T @ residual)

        # The polynomial fits the residuals from the prior, and its slope is per window length.
        coefficients = jax.vmap(fit)(samples.T, expected, v)
        value, slope = coefficients[:, 0], coefficients[:, 1]
        return expected + value, v + slope / span
