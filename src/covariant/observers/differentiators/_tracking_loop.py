"""Tracking loops: extrapolate position, velocity and perhaps acceleration as a polynomial, and correct at samples.

A loop of k integrators is specified in continuous time by its poles λ. Between samples the error of the extrapolation
obeys the integrators alone. The correction at a sample is chosen such that the sampled loop has the poles exp(λ dt). It
is exact for motions that are polynomials of degree k − 1, also at irregular stamps, and stable for every dt.

Source: Kalata 1984, The tracking index, IEEE TAES 20(2); Brookner 1998, Tracking and Kalman Filtering Made Easy,
for three equal poles.
"""

import abc
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import wrap
from covariant.observers.base import AbstractObserver, outcome
from covariant.observers.differentiators._model_free import FilterInfo, response

Gains = Callable[[Vector, Vector], Array]
"""`(dt, error) -> (k, n)`: factors of the error (n,) of the extrapolated position, a time dt [s] (n,) after the last
measurement, in the correction of position, velocity and so on."""


class LoopState(NamedTuple):
    """State of a tracking loop of k integrators for each coordinate.

    Attributes:
        x: Position, velocity and, for k = 3, acceleration (k, n), extrapolated to the present.
        age: Time (n,) since the last measurement of each coordinate [s].

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> pll = observers.PLL(bandwidth=20.0)
        >>> state = pll.predict(pll.init(np.array([0.5])), np.zeros(0), 0.01)
        >>> state.x.tolist(), state.age.tolist()
        ([[0.5], [0.0]], [0.01])
    """

    x: Float[Array, "k n"]
    age: Vector


class AbstractTrackingLoop(AbstractObserver):
    """A loop of integrators for each coordinate, corrected at samples by its `gains`.

    Attributes:
        order: Number of integrators k: 2 for position and velocity, 3 with acceleration.
        circles: Indices of the coordinates that are angles on a full circle, which are followed modulo a turn; none by
            default.

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> loop = observers.HighGain(bandwidth=20.0)
        >>> loop.order, loop.init(np.array([1.0])).x.tolist()
        (3, [[1.0], [0.0], [0.0]])
    """

    order = 2  # not a field: of some loops it is one, and of others a constant
    circles: tuple[int, ...] = eqx.field(default=(), static=True, kw_only=True)

    @abc.abstractmethod
    def gains(self, dt: Vector, error: Vector) -> Float[Array, "k n"]:
        """Gains of the correction, for each coordinate."""

    def init(self, y: Vector, t: Number = 0.0) -> LoopState:
        """State of the loop at rest at the measured positions."""
        return standing(self.order, y)

    def estimate(self, state: LoopState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.x[0], state.x[1]])

    def predict(self, state: LoopState, u: Float[Array, "m"], dt: Scalar) -> LoopState:
        """Extrapolate the polynomial of each coordinate."""
        return LoopState(extrapolated(state.x, dt), state.age + dt)

    def correct(self, state: LoopState, u: Float[Array, "m"], y: Vector) -> tuple[LoopState, FilterInfo]:
        """Correct each measured coordinate by its gains times its innovation."""
        # A coordinate that was measured at this same stamp is not measured anew: its gains would divide by zero.
        present, error = ~jnp.isnan(y) & (state.age > 0), self.innovation(state, u, y)
        x = state.x + self.gains(jnp.where(present, state.age, 1.0), error) * error[None]
        return LoopState(x, jnp.where(present, 0.0, state.age)), FilterInfo(error, outcome(x[0], x[1], y))

    def innovation(self, state: LoopState, u: Float[Array, "m"], y: Vector) -> Vector:
        present = ~jnp.isnan(y) & (state.age > 0)
        return wrap(self.circles, jnp.where(present, y - state.x[0], 0.0))


def standing(order: int, y: Vector) -> LoopState:
    """State of a loop at rest."""
    return LoopState(jnp.concatenate([y[None], jnp.zeros((order - 1, y.shape[0]), y.dtype)]), jnp.zeros_like(y))


def extrapolated(x: Float[Array, "k n"], dt: Scalar) -> Float[Array, "k n"]:
    """Value and derivatives of a polynomial after a time, by its Taylor series."""
    k = x.shape[0]
    return jnp.stack([sum(x[j] * dt ** (j - i) / math.factorial(j - i) for j in range(i, k)) for i in range(k)])


@eqx.filter_jit
def sampled(gains: Gains, dt: Scalar) -> tuple[Array, Array]:
    """Transition and gain over one sample of a loop whose gains do not depend on the error."""
    gain = gains(dt[None], jnp.zeros(1))[:, 0]
    return extrapolated(jnp.eye(len(gain)), dt), gain


def loop_weights(gains: Gains, rate: float) -> Float[np.ndarray, "k"]:
    """Weights of the positions in the velocity of a loop whose gains do not depend on the error."""
    return response(*map(np.asarray, sampled(gains, jnp.asarray(1 / rate))))


def triple_pole(decay: Vector, dt: Vector) -> Float[Array, "3 n"]:
    """Gains that give a loop of three integrators three equal sampled poles `p = exp(−decay)`.

    They are `1 − p³`, `3(1 − p)²(1 + p)/2dt` and `(1 − p)³/dt²`.
    """
    # Computing 1 − p by expm1, and 1 − p³ as its multiple, loses no digits for a small decay.
    p, complement = jnp.exp(-decay), -jnp.expm1(-decay)
    return jnp.stack([complement * (1 + p + p**2), 1.5 * complement**2 * (1 + p) / dt, complement**3 / dt**2])
