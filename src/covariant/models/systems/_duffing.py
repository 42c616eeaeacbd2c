"""The oscillator of Duffing 1918 with a cubic spring: by default a buckled beam, with two potential wells."""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace

_SOURCE = "Guckenheimer & Holmes 1983, section 2.2"


def duffing(damping: float = 0.25, stiffness: float = -1.0, cubic: float = 1.0) -> StateSpace:
    """Duffing oscillator `q̈ + damping q̇ + stiffness q + cubic q³ = u` of a unit mass [kg]; y = q [m], x = (q, q̇).

    The input u is a force [N], zero if none is given.

    Use it to try observers of state-space models: with negative stiffness, a periodic force can make it chaotic. The
    default values have two potential wells, at q = ±1 m.

    Args:
        damping: Viscous damping [N s/m], not negative.
        stiffness: Linear stiffness [N/m] of any sign; negative for two potential wells.
        cubic: Cubic stiffness [N/m³] of any sign.

    Returns:
        The system with states (q, q_dot) and one input.

    Raises:
        ValueError: The damping is negative, or a parameter is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> at_the_well = jnp.array([1.0, 0.0])
        >>> bool((models.duffing().f(0.0, at_the_well, jnp.zeros(1)) == 0).all())
        True
    """
    parameters = {
        "damping": Parameter(damping, "N s/m", _SOURCE),
        "stiffness": Parameter(stiffness, "N/m", _SOURCE),
        "cubic": Parameter(cubic, "N/m^3", _SOURCE),
    }
    check_parameters("duffing", parameters, ("stiffness", "cubic"), ("damping",))
    return StateSpace(
        Parametric(_f, **values(parameters)),
        _h,
        coordinates=("q", "q_dot"),
        units=("m", "m/s"),
        outputs=("q",),
        inputs=1,
        # The wells are at ±√(−stiffness/cubic) = ±1; the orbit through the saddle between them reaches ±√2.
        box=((-2.0, 2.0), (-2.0, 2.0)),
        parameters=parameters,
    )


def _f(t, x, u, damping, stiffness, cubic):
    q, v = x
    return jnp.stack([v, u[0] - damping * v - stiffness * q - cubic * q**3])


def _h(t, x, u):
    return x[:1]
