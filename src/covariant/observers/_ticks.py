"""Encoders that count ticks: a reading is an interval, and a change of it is an edge passed a moment ago.

A reading y of an encoder with step s says that `|y − q| ≤ s/2`. Taken as Gaussian noise at every sample, one interval
would be counted many times while the joint crosses it. Here an interval bounds the variance, to that of a uniform
distribution, and holds the mean inside; what tells more is an edge: somewhere between the last two samples the joint
was exactly between two readings.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Scalar, Vector


class Readings(NamedTuple):
    """The last reading of each encoder, and how long ago it was [s]; both (n,)."""

    y: Vector
    age: Vector


class Believed(NamedTuple):
    """An error (N,) that is believed, and a square root (N, N) of its covariance."""

    error: Vector
    root: Float[Array, "N N"]


def take(
    prior: Float[Array, "N N"],
    offset: Vector,
    moved: Vector,
    age: Vector,
    speed: Vector,
    rows: tuple[Float[Array, "n N"], Float[Array, "n N"]],
    step: Vector,
    noise: Vector,
    used: Bool[Array, "n"],
) -> Believed:
    """What readings tell of an error whose mean is zero and whose covariance has the root `prior`.

    - `offset` (n,): from the expected to the read position of each joint; `moved` (n,): by how much the reading has
      changed since the one before, `age` [s] ago; `speed` (n,): the expected velocity.
    - `rows`: the positions and the velocities as linear functions of the error.
    - `step` (n,): one tick; `noise` (n,): variance of the place of an edge; `used` (n,): readings that are taken in.
    """
    state = Believed(jnp.zeros_like(prior[0]), prior)
    for i in range(len(step)):
        position, velocity = rows[0][i], rows[1][i]
        half = step[i] / 2
        uniform = half * half / 3
        ticks = jnp.round(jnp.abs(moved[i]) / step[i])
        edge, still = ticks == 1, ticks == 0
        variance = jnp.sum((position @ state.root) ** 2)
        # An edge was passed at a time uniform since the last reading; what was read there is between the readings.
        back = jnp.where(edge, age[i] / 2, 0.0)
        fastest = speed[i] ** 2 + jnp.sum((velocity @ state.root) ** 2)
        # Without an edge the interval tells what is left of it: the variance becomes the uniform one, if it was larger.
        unknown = variance > uniform
        interval = 1 / jnp.where(unknown, 1 / uniform - 1 / jnp.where(unknown, variance, 1.0), 1.0)
        r = noise[i] + jnp.where(edge, fastest * age[i] ** 2 / 12, jnp.where(still, interval, uniform))
        seen_at = offset[i] - jnp.where(edge, jnp.sign(moved[i]) * half - back * speed[i], 0.0)
        state = _scalar(state, position - back * velocity, seen_at, r, used[i] & (unknown | ~still))
        state = _inside(state, position, offset[i], half + jnp.sqrt(noise[i]), used[i])
    return state


def _scalar(state: Believed, row: Vector, value: Scalar, noise: Scalar, used: Array) -> Believed:
    """The update by one number, in the square-root form of Potter (Bierman 1977, chapter V)."""
    shown = row @ state.root
    square = shown @ shown + noise
    weight = jnp.where(used, 1 / square, 0.0)
    gain = state.root @ shown
    root = state.root - jnp.outer(gain, shown) * weight / (1 + jnp.sqrt(noise / square))
    return Believed(state.error + gain * weight * (value - row @ state.error), root)


def _inside(state: Believed, row: Vector, centre: Scalar, half: Scalar, used: Array) -> Believed:
    """The mean moved, as a measurement of this position would, into the interval; the covariance as it is."""
    left = centre - row @ state.error
    outside = jnp.where(used, left - jnp.clip(left, -half, half), 0.0)
    shown = row @ state.root
    return state._replace(error=state.error + state.root @ shown / (shown @ shown) * outside)
