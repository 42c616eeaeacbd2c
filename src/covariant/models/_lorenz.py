"""The convection cell of Lorenz 1963, Deterministic nonperiodic flow: the classical chaotic system."""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace

_SOURCE = "Lorenz 1963, section 7"


def lorenz(prandtl: float = 10.0, rayleigh: float = 28.0, geometry: float = 8 / 3) -> StateSpace:
    """Lorenz 1963, equations (25)–(27), dimensionless: convection x, temperatures y and z; x is measured.

    The `prandtl` number σ, the ratio `rayleigh` r of the Rayleigh number to the critical one, and the `geometry` b of
    the cell must be positive; raises `ValueError` otherwise. The box holds the attractor of the default parameters.
    """
    parameters = {
        "prandtl": Parameter(prandtl, "1", _SOURCE),
        "rayleigh": Parameter(rayleigh, "1", _SOURCE),
        "geometry": Parameter(geometry, "1", _SOURCE),
    }
    return StateSpace(
        Parametric(_f, **values(check_parameters("lorenz", parameters))),
        _h,
        coordinates=("x", "y", "z"),
        units=("1", "1", "1"),
        outputs=("x",),
        box=((-20.0, 20.0), (-30.0, 30.0), (0.0, 50.0)),
        parameters=parameters,
    )


def _f(t, state, u, prandtl, rayleigh, geometry):
    x, y, z = state
    return jnp.stack([prandtl * (y - x), x * (rayleigh - z) - y, x * y - geometry * z])


def _h(t, state, u):
    return state[:1]
