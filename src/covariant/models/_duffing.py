"""The oscillator of Duffing 1918 with a cubic spring: by default a buckled beam, with two potential wells."""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace

_SOURCE = "Guckenheimer & Holmes 1983, section 2.2"


def duffing(damping: float = 0.25, stiffness: float = -1.0, cubic: float = 1.0) -> StateSpace:
    """`q̈ + damping q̇ + stiffness q + cubic q³ = u` for a unit mass [kg], with x = (q, q̇) [m, m/s] and y = q.

    `damping` [N s/m], not negative; `stiffness` [N/m] and `cubic` [N/m³] of any sign. The input u is a force [N], zero
    where none is given. Raises `ValueError` for other parameters.
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
        box=((-2.0, 2.0), (-2.0, 2.0)),
        parameters=parameters,
    )


def _f(t, x, u, damping, stiffness, cubic):
    q, v = x
    return jnp.stack([v, u[0] - damping * v - stiffness * q - cubic * q**3])


def _h(t, x, u):
    return x[:1]
