"""Encoders that count ticks: a reading is an interval, and a change of it is an edge passed a moment ago.

A reading y of an encoder with step s says that `|y − q| ≤ s/2`. Taken as Gaussian noise at every sample, one interval
would be counted many times while the joint crosses it. Here an interval bounds the variance, to that of a uniform
distribution, and the mean stays inside. An edge is more informative: somewhere between the last two samples the joint
was exactly between two readings.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Scalar, Vector


class Readings(NamedTuple):
    """Last reading of each encoder.

    Attributes:
        y: Readings (n,) [rad or m].
        age: Time (n,) since each of them [s].

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1.0, 1e-6, 1.0, quantum=0.01)
        >>> kalman.init(np.array([0.5])).readings.y.tolist()
        [0.5]
    """

    y: Vector
    age: Vector


class Believed(NamedTuple):
    """Posterior of an error.

    Attributes:
        error: Mean (N,).
        root: Square root (N, N) of the covariance.

    Example:
        >>> import numpy as np
        >>> from covariant.observers.base._ticks import Believed
        >>> Believed(np.zeros(2), np.eye(2)).root.shape
        (2, 2)
    """

    error: Vector
    root: Float[Array, "N N"]


class Encoded(NamedTuple):
    """What encoders show at a sample, beside what was expected.

    Attributes:
        offset: Difference (n,) from the expected to the read position of each joint [rad or m].
        moved: Change (n,) of each reading since the previous one [rad or m].
        age: Time (n,) since the previous reading [s].
        speed: Expected velocity (n,) [rad/s or m/s].
        step: One tick (n,) of each encoder [rad or m].
        noise: Variance (n,) of the position of an edge [rad² or m²].
        used: Which readings are used (n,).
    """

    offset: Vector
    moved: Vector
    age: Vector
    speed: Vector
    step: Vector
    noise: Vector
    used: Bool[Array, "n"]


def take(
    prior: Float[Array, "N N"], rows: tuple[Float[Array, "n N"], Float[Array, "n N"]], encoded: Encoded
) -> Believed:
    """Posterior of an error of mean zero after readings of encoders that count ticks."""
    offset, moved, age, speed, step, noise, used = encoded
    state = Believed(jnp.zeros_like(prior[0]), prior)
    for i in range(len(step)):
        position, velocity = rows[0][i], rows[1][i]
        half = step[i] / 2
        # The variance step²/12 of a uniform distribution over one tick.
        uniform = half * half / 3
        # Rounded, since the difference of two multiples of a tick is a whole number of ticks but for its last digits.
        ticks = jnp.round(jnp.abs(moved[i]) / step[i])
        edge, still = ticks == 1, ticks == 0
        variance = jnp.sum((position @ state.root) ** 2)
        # An edge was passed at a time uniform since the last reading, where the position was between the readings.
        back = jnp.where(edge, age[i] / 2, 0.0)
        mean_square_speed = speed[i] ** 2 + jnp.sum((velocity @ state.root) ** 2)
        # Without an edge the noise is such that the variance becomes the uniform one, if it was larger.
        wider = variance > uniform
        interval = 1 / jnp.where(wider, 1 / uniform - 1 / jnp.where(wider, variance, 1.0), 1.0)
        # The time of an edge is uniform over the age: its variance age²/12, times the mean square of the speed.
        r = noise[i] + jnp.where(edge, mean_square_speed * age[i] ** 2 / 12, jnp.where(still, interval, uniform))
        # The edge is half a tick before the new reading, at the position that was `back` seconds ago.
        measured = offset[i] - jnp.where(edge, jnp.sign(moved[i]) * half - back * speed[i], 0.0)
        state = _scalar(state, position - back * velocity, measured, r, used[i] & (wider | ~still))
        state = _clamp_mean(state, position, offset[i], half + jnp.sqrt(noise[i]), used[i])
    return state


def _scalar(state: Believed, row: Vector, value: Scalar, noise: Scalar, used: Array) -> Believed:
    """The update by one scalar measurement, in the square-root form of Potter (Bierman 1977, chapter V)."""
    shown = row @ state.root
    square = shown @ shown + noise
    weight = jnp.where(used, 1 / square, 0.0)
    gain = state.root @ shown
    root = state.root - jnp.outer(gain, shown) * weight / (1 + jnp.sqrt(noise / square))
    return Believed(state.error + gain * weight * (value - row @ state.error), root)


def _clamp_mean(state: Believed, row: Vector, centre: Scalar, half: Scalar, used: Array) -> Believed:
    """Shift of the mean into the interval, along the gain of a measurement of this position; the covariance stays."""
    residual = centre - row @ state.error
    outside = jnp.where(used, residual - jnp.clip(residual, -half, half), 0.0)
    shown = row @ state.root
    return state._replace(error=state.error + state.root @ shown / (shown @ shown) * outside)
