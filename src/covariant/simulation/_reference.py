"""References for a craft to follow: a position and its first and second derivative, as functions of time.

Source: Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, section 10.2, for the filter.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Numbers, Scalar, Vector


class Reference(NamedTuple):
    """Desired position (n,), velocity and acceleration."""

    position: Vector
    velocity: Vector
    acceleration: Vector


Path = Callable[[Array], Reference]
"""A reference as a function of time, `t -> Reference`."""


def follow(position: Callable[[Array], Array]) -> Path:
    """The reference given by a smooth function of time `t -> (n,)`, differentiated automatically."""

    def at(t: Scalar) -> Reference:
        one = jnp.ones_like(t)

        def moving(s):
            return jax.jvp(position, (s,), (one,))

        (where, velocity), (_, acceleration) = jax.jvp(moving, (t,), (one,))
        return Reference(where, velocity, acceleration)

    return at


def set_point(start: Numbers, goal: Numbers, bandwidth: Numbers, begin: float = 0.0) -> Path:
    """From rest at `start` (n,) to rest at `goal` (n,), beginning at `begin` [s], without a jump in acceleration.

    It is the closed-form response of three equal poles at `bandwidth` [rad/s], one number or n. Raises `ValueError`
    where the bandwidth is not positive or the shapes differ.
    """
    a, b = np.asarray(start, float), np.asarray(goal, float)
    w = np.broadcast_to(np.asarray(bandwidth, float), a.shape)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"set_point: start and goal must be vectors of one length; got {a.shape} and {b.shape}")
    if not (w > 0).all():
        raise ValueError(f"set_point: bandwidth must be positive [rad/s]; got {bandwidth}")

    def at(t: Scalar) -> Reference:
        rate, change = jnp.asarray(w, t.dtype), jnp.asarray(b - a, t.dtype)
        s = rate * jnp.maximum(t - begin, 0.0)
        left = jnp.exp(-s)
        gone = 1 - left * (1 + s + s**2 / 2)
        return Reference(
            jnp.asarray(a, t.dtype) + change * gone,
            change * rate * left * s**2 / 2,
            change * rate**2 * left * (s - s**2 / 2),
        )

    return at


def lissajous(centre: Numbers, amplitude: Numbers, frequency: Numbers, phase: Numbers = 0.0) -> Path:
    """`centre + amplitude · sin(frequency · t + phase)`, each (n,): circles, figures of eight, and test motions.

    Frequencies in rad/s, phases in rad.
    """
    shapes = [np.atleast_1d(np.asarray(a, float)) for a in (centre, amplitude, frequency, phase)]
    c, a, w, p = np.broadcast_arrays(*shapes)

    def position(t: Scalar) -> Float[Array, "n"]:
        centre, size, rate, shift = (jnp.asarray(x, t.dtype) for x in (c, a, w, p))
        return centre + size * jnp.sin(rate * t + shift)

    return follow(position)
