"""The harmonic oscillator of Aghannan & Rouchon 2003, section III-B, in two charts that describe the same system."""

import jax.numpy as jnp

from covariant._typing import Number
from covariant.models._mechanical import Lagrangian
from covariant.models._parameters import Parameter, Parametric
from scalargraph.errors import InputError


def oscillator(chart: str = "q", stiffness: Number = 1.0) -> Lagrangian:
    """Harmonic oscillator: a unit mass [kg] on a spring, in the coordinate q [m] or in r = exp(q) with metric 1/r².

    The input u is a force on q [N]; as a covector in r it is u/r. Source: Aghannan & Rouchon 2003, section III-B.

    Args:
        chart: Coordinate of the system, "q" (default) or "r".
        stiffness: Stiffness of the spring [N/m], 1 by default.

    Returns:
        The system with n = 1.

    Raises:
        ValueError: The chart is another one.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.oscillator(stiffness=2.0).potential(jnp.array([3.0])).item()
        9.0
        >>> models.oscillator("r").metric(jnp.array([2.0])).tolist()
        [[0.25]]
    """
    parameters = {"stiffness": Parameter(stiffness, "N/m", "Aghannan & Rouchon 2003, section III-B")}
    if chart == "q":
        return Lagrangian(
            _unit_mass,
            Parametric(_spring, stiffness=stiffness),
            coordinates=("q",),
            units=("m",),
            parameters=parameters,
        )
    if chart == "r":
        return Lagrangian(
            _unit_mass_in_r,
            Parametric(_spring_in_r, stiffness=stiffness),
            _force_in_r,
            coordinates=("r",),
            units=("1",),
            parameters=parameters,
        )
    raise InputError(f"oscillator: chart must be 'q' or 'r'; got {chart!r}")


def _unit_mass(q):
    return jnp.eye(1, dtype=q.dtype)


def _spring(q, stiffness):
    return stiffness * q[0] ** 2 / 2


def _unit_mass_in_r(r):
    # q = ln r, so q' = r'/r and the energy ½q'² is ½r'²/r².
    return 1 / r[None] ** 2


def _spring_in_r(r, stiffness):
    return stiffness * jnp.log(r[0]) ** 2 / 2


def _force_in_r(t, r, u):
    # The power u q' is (u/r) r'.
    return u / r
