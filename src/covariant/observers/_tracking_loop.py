"""Tracking loops: position, velocity and perhaps acceleration, carried on as a polynomial and corrected at samples.

A loop of k integrators is written in continuous time by its poles λ. Between samples the error of the extrapolation
obeys the integrators alone, and the correction at a sample is the one that gives the sampled loop the poles exp(λ dt):
exact for a motion that is a polynomial of degree k − 1, at irregular stamps too, and stable for every dt.

Source: Kalata 1984, The tracking index, IEEE TAES 20(2); Brookner 1998, Tracking and Kalman Filtering Made Easy,
for three equal poles.
"""

import abc
import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import wrap
from covariant.observers._model_free import FilterInfo, response
from covariant.observers._protocol import AbstractObserver, outcome

Gains = Callable[[Vector, Vector], Array]
"""`(dt, error) -> (k, n)`: what an error (n,) of the extrapolated position, dt [s] (n,) after the last measurement, is
multiplied by in the correction of position, velocity and so on."""


class LoopState(NamedTuple):
    """Position, velocity and perhaps acceleration `x` (k, n), and the `age` [s] (n,) of the last measurement."""

    x: Float[Array, "k n"]
    age: Vector


class AbstractTrackingLoop(AbstractObserver):
    """A loop of `order` integrators for each coordinate, corrected at samples by its `gains`."""

    order: ClassVar[int]
    circles: tuple[int, ...] = eqx.field(default=(), static=True, kw_only=True)

    @abc.abstractmethod
    def gains(self, dt: Vector, error: Vector) -> Float[Array, "k n"]:
        """The factors of an error (n,) in its correction, dt [s] (n,) after the last measurement."""

    def init(self, y: Vector, t: Number = 0.0) -> LoopState:
        return standing(self.order, y)

    def estimate(self, state: LoopState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.x[0], state.x[1]])

    def predict(self, state: LoopState, u: Float[Array, "m"], dt: Scalar) -> LoopState:
        return LoopState(extrapolated(state.x, dt), state.age + dt)

    def correct(self, state: LoopState, u: Float[Array, "m"], y: Vector) -> tuple[LoopState, FilterInfo]:
        present, error = ~jnp.isnan(y) & (state.age > 0), self.innovation(state, u, y)
        x = state.x + self.gains(jnp.where(present, state.age, 1.0), error) * error[None]
        return LoopState(x, jnp.where(present, 0.0, state.age)), FilterInfo(error, outcome(x[0], x[1], y))

    def innovation(self, state: LoopState, u: Float[Array, "m"], y: Vector) -> Vector:
        present = ~jnp.isnan(y) & (state.age > 0)
        return wrap(self.circles, jnp.where(present, y - state.x[0], 0.0))


def standing(order: int, y: Vector) -> LoopState:
    """The state of a loop of this order k at rest at y."""
    return LoopState(jnp.concatenate([y[None], jnp.zeros((order - 1, y.shape[0]), y.dtype)]), jnp.zeros_like(y))


def extrapolated(x: Float[Array, "k n"], dt: Scalar) -> Float[Array, "k n"]:
    """A polynomial's value and derivatives (k, n) after dt [s]."""
    k = x.shape[0]
    return jnp.stack([sum(x[j] * dt ** (j - i) / math.factorial(j - i) for j in range(i, k)) for i in range(k)])


@eqx.filter_jit
def sampled(gains: Gains, dt: Scalar) -> tuple[Array, Array]:
    """Transition (k, k) over dt [s], and gain (k,) at its end, of a loop whose gains do not depend on the error."""
    gain = gains(dt[None], jnp.zeros(1))[:, 0]
    return extrapolated(jnp.eye(len(gain)), dt), gain


def loop_weights(gains: Gains, rate: float) -> Float[np.ndarray, "k"]:
    """The weights of such a loop, newest first, at an even rate [Hz]."""
    return response(*map(np.asarray, sampled(gains, jnp.asarray(1 / rate))))


def triple_pole(decay: Vector, dt: Vector) -> Float[Array, "3 n"]:
    """Gains on position, velocity and acceleration that give a loop of three integrators three sampled poles
    `p = exp(−decay)`: `1 − p³`, `3(1 − p)²(1 + p)/2dt`, `(1 − p)³/dt²`."""
    p, gone = jnp.exp(-decay), -jnp.expm1(-decay)
    return jnp.stack([gone * (1 + p + p**2), 1.5 * gone**2 * (1 + p) / dt, gone**3 / dt**2])
