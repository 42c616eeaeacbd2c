"""References that a craft follows: a position and its first and second derivatives, as functions of time.

Source: Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, section 10.2, for the filter.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Numbers, Scalar, Vector
from scalargraph.errors import InputError


class Reference(NamedTuple):
    """Desired motion at one time.

    Attributes:
        position: Desired position (n,), in the craft's coordinates.
        velocity: Its first time derivative (n,).
        acceleration: Its second time derivative (n,).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.simulation import follow
        >>> reference = follow(lambda t: jnp.stack([t**2]))(jnp.asarray(3.0))
        >>> reference.velocity.tolist(), reference.acceleration.tolist()
        ([6.0], [2.0])
    """

    position: Vector
    velocity: Vector
    acceleration: Vector


Path = Callable[[Array], Reference]
"""A reference as a function of time, `t -> Reference`."""


def follow(position: Callable[[Array], Array]) -> Path:
    """Reference along a smooth function of time, differentiated automatically.

    Use it to give a controller such as `Backstepping` a reference whose velocity and acceleration agree with its
    position. The function must be twice differentiable: a corner would make the velocity jump. Use `set_point` for a
    move between two points.

    Args:
        position: Function `t -> (n,)` of the time [s], in JAX.

    Returns:
        A function `t -> Reference`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.simulation import follow
        >>> follow(lambda t: jnp.stack([2.0 * t]))(jnp.asarray(3.0)).position.tolist()
        [6.0]
    """

    def at(t: Scalar) -> Reference:
        one = jnp.ones_like(t)

        def moving(s):
            return jax.jvp(position, (s,), (one,))

        # Forward mode twice: the time derivatives of position and velocity are velocity and acceleration.
        (where, velocity), (_, acceleration) = jax.jvp(moving, (t,), (one,))
        return Reference(where, velocity, acceleration)

    return at


def set_point(start: Numbers, goal: Numbers, bandwidth: Numbers, begin: float = 0.0) -> Path:
    """Reference from rest at one point to rest at another, with continuous acceleration.

    It is the closed-form step response of three equal poles.

    Position, velocity and acceleration are continuous, and a controller can use them as feedforward. The motion settles
    in about ten times 1/bandwidth. Use `follow` for any other path.

    Args:
        start: Initial position (n,).
        goal: Final position (n,).
        bandwidth: Magnitude of the poles [rad/s], one number or n.
        begin: Time [s] at which the motion begins.

    Returns:
        A function `t -> Reference`.

    Raises:
        ValueError: The bandwidth is not positive, or the shapes differ.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.simulation import set_point
        >>> path = set_point([0.0], [1.0], 2.0, begin=1.0)
        >>> [round(path(jnp.asarray(t)).position.item(), 2) for t in (0.0, 2.0, 10.0)]
        [0.0, 0.32, 1.0]
    """
    a, b = np.asarray(start, float), np.asarray(goal, float)
    w = np.broadcast_to(np.asarray(bandwidth, float), a.shape)
    if a.shape != b.shape or a.ndim != 1:
        raise InputError(f"set_point: start and goal must be vectors of one length; got {a.shape} and {b.shape}")
    if not (w > 0).all():
        raise InputError(f"set_point: bandwidth must be positive [rad/s]; got {bandwidth}")

    def at(t: Scalar) -> Reference:
        rate, change = jnp.asarray(w, t.dtype), jnp.asarray(b - a, t.dtype)
        s = rate * jnp.maximum(t - begin, 0.0)
        # Step response of w³/(p + w)³ and its derivatives, as functions of s = w (t − begin); zero before `begin`.
        left = jnp.exp(-s)
        gone = 1 - left * (1 + s + s**2 / 2)
        return Reference(
            jnp.asarray(a, t.dtype) + change * gone,
            change * rate * left * s**2 / 2,
            change * rate**2 * left * (s - s**2 / 2),
        )

    return at


def lissajous(centre: Numbers, amplitude: Numbers, frequency: Numbers, phase: Numbers = 0.0) -> Path:
    """Sinusoidal reference for circles, figures of eight and tests: `centre + amplitude · sin(frequency · t + phase)`.

    Args:
        centre: Mean position (n,).
        amplitude: Amplitudes (n,).
        frequency: Angular frequencies (n,) [rad/s].
        phase: Phases (n,) [rad], 0 by default.

    Returns:
        A function `t -> Reference`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.simulation import lissajous
        >>> path = lissajous([0.0, 1.0], [2.0, 0.5], [1.0, 2.0])
        >>> path(jnp.zeros(())).velocity.tolist()
        [2.0, 1.0]
    """
    shapes = [np.atleast_1d(np.asarray(a, float)) for a in (centre, amplitude, frequency, phase)]
    c, a, w, p = np.broadcast_arrays(*shapes)

    def position(t: Scalar) -> Float[Array, "n"]:
        centre, size, rate, shift = (jnp.asarray(x, t.dtype) for x in (c, a, w, p))
        return centre + size * jnp.sin(rate * t + shift)

    return follow(position)
