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
    """Biomass and substrate [kg/m³], with the dilution rate u [1/s] (flow over volume) as input; substrate is measured.

    The growth rate is `μ(s) = growth s/(saturation + s + inhibition s²)`: Haldane's kinetics, and Monod's where
    `inhibition` [m³/kg] is zero. `growth` [1/s], `saturation` [kg/m³], `conversion` of substrate into biomass [1], and
    the substrate in the `feed` [kg/m³] are positive; raises `ValueError` otherwise. To work in hours, or any other unit
    of time, give `growth` and u in that unit.

    The biomass is observable from the substrate, by the rate at which it is consumed, wherever s > 0. The substrate
    would not be observable from the biomass: two concentrations, below and above that of the fastest growth, give the
    same growth rate.
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
        box=tuple((high / 50, high) for high in (conversion * feed, feed)),  # unobservable without substrate
        parameters=parameters,
    )


def _f(t, x, u, growth, saturation, inhibition, conversion, feed):
    biomass, substrate = x
    grown = growth * substrate / (saturation + substrate + inhibition * substrate**2) * biomass
    return jnp.stack([grown - u[0] * biomass, u[0] * (feed - substrate) - grown / conversion])


def _h(t, x, u):
    return x[1:]
