"""A continuous stirred-tank bioreactor: microbes that feed on a substrate, which inhibits them at high concentration.

Source: Bastin & Dochain 1990, On-line estimation and adaptive control of bioreactors, chapter 1; numbers of Bequette
1998, Process dynamics, module 8, who uses hours in place of seconds.
"""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace

_SOURCE = "Bequette 1998, Process dynamics, module 8"


def bioreactor(
    growth: float = 0.53 / 3600,
    saturation: float = 0.12,
    inhibition: float = 0.4545,
    conversion: float = 0.4,
    feed: float = 4.0,
) -> StateSpace:
    """Bioreactor with biomass and substrate [kg/m³] as states, of which the substrate is measured.

    The input u is the dilution rate [1/s], flow over volume. The growth rate is
    `μ(s) = growth s/(saturation + s + inhibition s²)`: Haldane's kinetics, and Monod's where `inhibition` is zero. To
    work in hours, or any other unit of time, give `growth` and u in that unit.

    The biomass is observable from the substrate, by the rate of its consumption, wherever s > 0. The substrate would
    not be observable from the biomass: two concentrations, below and above that of the fastest growth, give the same
    growth rate.

    Args:
        growth: Coefficient of the growth rate [1/s].
        saturation: Saturation constant [kg/m³].
        inhibition: Inhibition constant [m³/kg], not negative.
        conversion: Biomass grown for substrate consumed [1].
        feed: Concentration of the substrate in the feed [kg/m³].

    Returns:
        The system with states (biomass, substrate) and one input.

    Raises:
        ValueError: A parameter is not positive, or `inhibition` is negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> washout = models.bioreactor().f(0.0, jnp.array([0.0, 4.0]), jnp.array([1e-4]))
        >>> washout.tolist()  # without biomass the tank is at the concentration of the feed
        [0.0, 0.0]
    """
    parameters = {
        "growth": Parameter(growth, "1/s", _SOURCE),
        "saturation": Parameter(saturation, "kg/m^3", _SOURCE),
        "inhibition": Parameter(inhibition, "m^3/kg", _SOURCE),
        "conversion": Parameter(conversion, "1", _SOURCE),
        "feed": Parameter(feed, "kg/m^3", _SOURCE),
    }
    check_parameters("bioreactor", parameters, may_vanish=("inhibition",))
    return StateSpace(
        Parametric(_f, **values(parameters)),
        _h,
        coordinates=("biomass", "substrate"),
        units=("kg/m^3", "kg/m^3"),
        outputs=("substrate",),
        inputs=1,
        # z = biomass + conversion·substrate obeys z' = u (conversion·feed − z), so states do not stay above these
        # bounds.
        box=tuple((high / 50, high) for high in (conversion * feed, feed)),  # unobservable without substrate
        parameters=parameters,
    )


def _f(t, x, u, conversion, feed, **kinetics):
    biomass, substrate = x
    production = _growth_rate(substrate, **kinetics) * biomass
    return jnp.stack([production - u[0] * biomass, u[0] * (feed - substrate) - production / conversion])


def _growth_rate(substrate, growth, saturation, inhibition):
    """μ(s) [1/s]."""
    return growth * substrate / (saturation + substrate + inhibition * substrate**2)


def _h(t, x, u):
    return x[1:]
