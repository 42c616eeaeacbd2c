"""Models the harmonic oscillator with unknown frequency of Sanfelice & Praly 2015, equation (16)."""

import jax.numpy as jnp

from covariant.models._state_space import StateSpace


def unknown_frequency() -> StateSpace:
    """Harmonic oscillator of unknown frequency: x1 [m], its velocity x2 [m/s] and x3 = ω² [1/s²]; y = x1.

    `f = (x2, −x3 x1, 0)`. The box is the grid of section III of the paper. At x1 = x2 = 0 the frequency is not
    observable. Source: Sanfelice & Praly 2015, equation (16).

    Returns:
        The system with three states and no input.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.unknown_frequency().f(0.0, jnp.array([1.0, 2.0, 4.0]), jnp.zeros(0)).tolist()
        [2.0, -4.0, 0.0]
    """
    return StateSpace(
        _f,
        _h,
        coordinates=("x1", "x2", "x3"),
        units=("m", "m/s", "1/s^2"),
        outputs=("x1",),
        box=((0.0, 1.0), (1.0, 1.5), (0.5, 1.5)),
    )


def _f(t, x, u):
    return jnp.stack([x[1], -x[2] * x[0], jnp.zeros_like(x[0])])


def _h(t, x, u):
    return x[:1]
