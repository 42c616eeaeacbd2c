"""Reproduces example 2 of Jouffroy & Fossen 2004: the ship with K2 as printed and as corrected, and its convergence."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant import geometry
from covariant.models import marine
from covariant.observers import PassiveShip, lyapunov_gains, lyapunov_rate, printed_rate
from covariant.simulation import observe


def ship_eigenvalues() -> dict[str, float]:
    """Largest real part of the virtual system (53) with K1 = I and K2 as printed in (54) and as corrected.

    A supply vessel at ψ = 0, in the Bis system: lengths by L, times by √(L/g).

    Returns:
        Real parts with K2 as `printed` and as `corrected`.
    """
    station = marine.Station(marine.supply_vessel(length=1.0, mass=1.0, gravity=1.0))
    signs = {"printed": -1.0, "corrected": 1.0}
    slopes = {name: np.asarray(_virtual_slope(station, jnp.asarray(sign))) for name, sign in signs.items()}
    return {name: float(np.linalg.eigvals(slope).real.max()) for name, slope in slopes.items()}


@eqx.filter_jit
def _virtual_slope(station: marine.Station, sign: Array) -> Array:
    def flow(x):
        turn = marine.yaw_rotation(jnp.zeros(()))
        copy = station.derivative(jnp.zeros(()), x, jnp.zeros(3))
        return copy - jnp.concatenate([x[:3], sign * turn.T @ x[:3]])

    return jax.jacfwd(flow)(jnp.zeros(6))


def ship_decay(duration: float = 600.0) -> dict[str, Any]:
    """Decay of V along a turning motion: observer (43)–(44) of the moored supply vessel, with gains from (48)–(50).

    Args:
        duration: Length of the simulation [s].

    Returns:
        Stamps `t` (T,), `lyapunov` V (T,), the guaranteed `rate` α of `V ≤ e^(−2αt) V(0)`, the rate `printed` in (47),
        and the `fitted` one [1/s].
    """
    station = _moored_vessel()
    mass = np.asarray(station.ship.mass)
    gains = lyapunov_gains(station, mass * 1e-2, mass * 1e-3)
    t = jnp.linspace(0.0, duration, 301)
    error = np.asarray(_turning_errors(PassiveShip(station, gains), t))
    p1, p2 = np.asarray(gains.stiffness), np.asarray(gains.inertia)
    value = np.einsum("ti,ij,tj->t", error[:, :3], p1, error[:, :3]) / 2
    value = value + np.einsum("ti,ij,tj->t", error[:, 3:], p2, error[:, 3:]) / 2
    # V is quadratic in the error, hence the half; in the first fifth, faster modes still decay.
    fitted = -np.polyfit(np.asarray(t)[60:], np.log(value)[60:], 1)[0] / 2
    rates = {"rate": lyapunov_rate(station, gains), "printed": printed_rate(station, gains), "fitted": float(fitted)}
    return {"t": np.asarray(t), "lyapunov": value, **rates}


@functools.cache  # the same object at each call, so that compiled programs are reused
def _moored_vessel() -> marine.Station:
    return marine.Station(marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7])))


@eqx.filter_jit
def _turning_errors(observer: PassiveShip, t: Array) -> Array:
    x0 = jnp.array([0.0, 0.0, 0.3, 0.5, -0.2, 0.004])
    start = observer.init(jnp.array([10.0, -5.0, 0.4]))

    def input_at(s, x):
        return jnp.array([5e4, -3e4, 2e6]) * jnp.sin(0.02 * s + jnp.array([0.0, 1.0, 2.0]))

    x, state = observe(observer.station.model(), observer, x0, start, t, input_at)
    return jax.vmap(lambda e: geometry.wrap((2,), e))(x - state.x)
