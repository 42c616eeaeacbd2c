"""The harmonic oscillator of Aghannan & Rouchon 2003, section III-B, in two charts: one system."""

import jax.numpy as jnp

from covariant.models._mechanical import Lagrangian, Parameter


def oscillator(chart: str = "q", stiffness: float = 1.0) -> Lagrangian:
    """Unit mass [kg] on a spring [N/m], in the coordinate q [m] or in r = exp(q) with metric 1/r².

    Raises `ValueError` for any other chart. The input is a force on q [N]; in r its covector is u/r.
    """
    parameters = {"stiffness": Parameter(stiffness, "N/m", "Aghannan & Rouchon 2003, section III-B")}
    if chart == "q":
        return Lagrangian(
            lambda q: jnp.eye(1, dtype=q.dtype),
            lambda q: stiffness * q[0] ** 2 / 2,
            coordinates=("q",),
            units=("m",),
            parameters=parameters,
        )
    if chart == "r":
        return Lagrangian(
            lambda r: 1 / r[None] ** 2,
            lambda r: stiffness * jnp.log(r[0]) ** 2 / 2,
            lambda t, r, u: u / r,
            coordinates=("r",),
            units=("1",),
            parameters=parameters,
        )
    raise ValueError(f"oscillator: chart must be 'q' or 'r'; got {chart!r}")
