"""Updates by encoders that count ticks: a reading is an interval, and a change of reading marks a passed edge.

A reading y of an encoder with tick s means `|y − q| ≤ s/2`. Independent Gaussian noise at every sample would use the
same interval many times while the joint crosses it. Here an interval only limits the variance, to that of a uniform
distribution, and keeps the mean inside. An edge is more informative: at some time between the last two samples, the
joint was exactly at the border between two readings.
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
    """Posterior distribution of an error.

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
    """Encoder readings of one sample, relative to the prediction.

    Attributes:
        offset: Difference (n,) from the expected to the read position of each joint [rad or m].
        moved: Change (n,) of each reading since the previous one [rad or m].
        age: Time (n,) since the previous reading [s].
        speed: Expected velocity (n,) [rad/s or m/s].
        step: One tick (n,) of each encoder [rad or m].
        noise: Variance (n,) of the position of an edge [rad² or m²].
        used: Whether each reading is used (n,).
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
    """Update an error with zero mean and covariance `prior priorᵀ` by the encoders' readings, one after the other."""
    offset, moved, age, speed, step, noise, used = encoded
    state = Believed(jnp.zeros_like(prior[0]), prior)
    for i in range(len(step)):
        position, velocity = rows[0][i], rows[1][i]
        half = step[i] / 2
        # step²/12 is the variance of a uniform distribution over one tick.
        uniform = half * half / 3
        # Two readings differ by a whole number of ticks; `round` removes floating-point errors.
        ticks = jnp.round(jnp.abs(moved[i]) / step[i])
        edge, still = ticks == 1, ticks == 0
        variance = jnp.sum((position @ state.root) ** 2)
        # The joint passed the edge at an unknown time, distributed uniformly since the last reading.
        since_edge = jnp.where(edge, age[i] / 2, 0.0)
        mean_square_speed = speed[i] ** 2 + jnp.sum((velocity @ state.root) ** 2)
        # Without an edge, this noise reduces a variance above the uniform one to exactly that.
        wider = variance > uniform
        interval_noise = 1 / jnp.where(wider, 1 / uniform - 1 / jnp.where(wider, variance, 1.0), 1.0)
        # The time of the edge has the variance age²/12; it is multiplied by the mean square of the speed.
        r = noise[i] + jnp.where(edge, mean_square_speed * age[i] ** 2 / 12, jnp.where(still, interval_noise, uniform))
        # The edge is half a tick before the new reading; on average, the joint was there `since_edge` seconds ago.
        measured = offset[i] - jnp.where(edge, jnp.sign(moved[i]) * half - since_edge * speed[i], 0.0)
        state = _update_by_scalar(state, position - since_edge * velocity, measured, r, used[i] & (wider | ~still))
        state = _clamp_mean(state, position, offset[i], half + jnp.sqrt(noise[i]), used[i])
    return state


def _update_by_scalar(state: Believed, row: Vector, value: Scalar, noise: Scalar, used: Array) -> Believed:
    """Update by one scalar measurement, in the square-root form of Potter (Bierman 1977, chapter V)."""
    projected = row @ state.root
    square = projected @ projected + noise
    weight = jnp.where(used, 1 / square, 0.0)
    gain = state.root @ projected
    root = state.root - jnp.outer(gain, projected) * weight / (1 + jnp.sqrt(noise / square))
    return Believed(state.error + gain * weight * (value - row @ state.error), root)


def _clamp_mean(state: Believed, row: Vector, centre: Scalar, half: Scalar, used: Array) -> Believed:
    """Shift the mean into the interval, along the gain of a position measurement; the covariance is unchanged."""
    residual = centre - row @ state.error
    outside = jnp.where(used, residual - jnp.clip(residual, -half, half), 0.0)
    projected = row @ state.root
    return state._replace(error=state.error + state.root @ projected / (projected @ projected) * outside)
