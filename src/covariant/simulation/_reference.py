"""References for a craft to follow: a position and its first and second derivative, as functions of time."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Numbers, Scalar, Vector


class Reference(NamedTuple):
    """Desired motion at one time.

    Attributes:
        position: Desired position (n,), in the craft's coordinates; on a group an element (N, N), and then the
            derivatives are those of its entries.
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
    position. The function must be twice differentiable: a corner makes a jump in the velocity.

    Args:
        position: Function `t -> (n,)` of the time [s], in JAX; for `GroupTracking` `t -> (N, N)`.

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
