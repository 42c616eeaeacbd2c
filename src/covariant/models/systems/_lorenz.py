"""The convection cell of Lorenz 1963, Deterministic nonperiodic flow: the classical chaotic system."""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace

_SOURCE = "Lorenz 1963, section 7"


def lorenz(prandtl: float = 10.0, rayleigh: float = 28.0, geometry: float = 8 / 3) -> StateSpace:
    """Lorenz system, equations (25)–(27) of 1963, dimensionless: convection x, temperatures y and z; x is measured.

    The box contains the attractor of the default parameters.

    Args:
        prandtl: Prandtl number σ.
        rayleigh: Ratio r of the Rayleigh number to the critical one.
        geometry: Geometry b of the cell.

    Returns:
        The system with three states and no input.

    Raises:
        ValueError: A parameter is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.lorenz(prandtl=10.0, rayleigh=28.0).f(0.0, jnp.array([1.0, 2.0, 0.0]), jnp.zeros(0)).tolist()
        [10.0, 26.0, 2.0]
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
