"""Simulates dynamic positioning of a supply vessel in waves, and compares three estimators of its velocity."""

import functools
import math
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import geometry
from covariant._integrate import rk4
from covariant.metrics import Equation
from covariant.models import marine
from covariant.observers import AbstractObserver, FilteredDerivative, InformationEKF, PassiveShip, notch_gains, run
from covariant.signals import Record


class Sea(NamedTuple):
    """A log of dynamic positioning: north, east and heading with noise, gaps and wave motion, and the truth.

    Attributes:
        record: Commanded force (T, 3) [N, N m], measurement (T, 3) [m, rad] with NaN if it is missing, and true
            state.
        station: Model of the ship and its disturbances.
        observers: The estimators that are compared, by their key in the results.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> from covariant.models import marine
        >>> from covariant.papers.jouffroy_fossen import Sea
        >>> record = Record(np.arange(2.0), np.zeros((2, 3)), np.zeros((2, 3)))
        >>> derivative = observers.FilteredDerivative(0.1, (2,))
        >>> list(Sea(record, marine.Station(marine.supply_vessel()), {"filtered derivative": derivative}).observers)
        ['filtered derivative']
    """

    record: Record
    station: marine.Station
    observers: dict[str, AbstractObserver]


STEP, DURATION, GAPS = 0.1, 1200.0, ((400.0, 460.0), (800.0, 830.0))
"""Sampling period of the compass, length of the log, and gaps of GNSS [s]."""
GNSS, COMPASS = 0.5, math.radians(0.1)
"""Standard deviations of a measured position [m] and heading [rad]."""


def sea(seed: int = 0) -> Sea:
    """Simulate a supply vessel in waves of 0.8 m (standard deviation), with slowly varying forces, under PD control.

    Compass at 10 Hz, GNSS at 1 Hz with gaps of 60 and 30 s.

    Args:
        seed: Seed of the waves, forces and measurement noise.

    Returns:
        The log, of 1200 s.
    """
    station = _station()
    random = np.random.default_rng(seed)
    t = np.arange(round(DURATION / STEP) + 1) * STEP
    # A first-order process with time constant T has the variance q T/2, hence the density q = 2σ²/T.
    slow = np.array([3e4, 3e4, 1e6]) / math.sqrt(1000.0 / 2)  # N/√s and N m/√s: 30 kN and 1 MN m in the long run
    # White noise of density 1 that is constant over a step has the variance 1/step.
    noise = random.normal(size=(len(t), 6)) / math.sqrt(STEP) * np.concatenate([np.ones(3), slow])
    x, tau, y = (np.asarray(a) for a in _station_keeping(station, jnp.asarray(t), jnp.asarray(noise)))
    y = y + random.normal(size=y.shape) * np.array([GNSS, GNSS, COMPASS])
    # GNSS has one sample per second, the compass one per step.
    missing = np.arange(len(t)) % round(1 / STEP) != 0
    for begin, end in GAPS:
        missing |= (t >= begin) & (t < end)
    y[missing, :2] = np.nan
    observers = {
        "passive observer": passive_observer(station),
        "extended Kalman filter": sea_filter(station, y[0]),
        "filtered derivative": FilteredDerivative(0.1, (2,)),
    }
    return Sea(Record(t, tau, y, x), station, observers)


@functools.cache  # the same object at each call, so that compiled programs are reused
def _station() -> marine.Station:
    waves = marine.Waves((0.8, 0.8, 0.8), (0.1, 0.1, 0.1), (0.8, 0.8, math.radians(1.0)))
    return marine.Station(marine.supply_vessel(), waves, bias_time=1000.0)


@eqx.filter_jit
def _station_keeping(station: marine.Station, t: Array, noise: Array):
    """True states, commanded forces and noise-free outputs under a PD controller that knows the true state."""
    model, mass = station.model(noise=True), jnp.diag(jnp.asarray(station.ship.mass))

    def goal(s):
        return jnp.where(s < 600.0, jnp.zeros(3), jnp.array([20.0, -10.0, math.radians(30.0)]))

    def step(x, sample):
        now, drive = sample
        eta, nu = x[:3], x[3:6]
        error = geometry.wrap((2,), eta - goal(now))
        # A PD controller of 0.05 rad/s with a damping ratio of 0.8.
        wanted = -mass * (0.05**2 * (marine.yaw_rotation(eta[2]).T @ error) + 2 * 0.8 * 0.05 * nu)
        tau = jnp.clip(wanted, -jnp.array([3e5, 3e5, 1e7]), jnp.array([3e5, 3e5, 1e7]))
        u = jnp.concatenate([tau, drive])
        return rk4(lambda s, x: model.f(s, x, u), now, x, STEP, 1), (x, tau)

    x0 = jnp.zeros(station.order).at[12:15].set(jnp.array([2e4, -1e4, 5e5]))
    _, (x, tau) = jax.lax.scan(step, x0, (t, noise))
    return x, tau, jax.vmap(station.output)(x)


def passive_observer(station: marine.Station) -> PassiveShip:
    """The passive observer, tuned for this log."""
    return PassiveShip(station, notch_gains(station, (0.1, 0.1, 0.2)), memory=2.0)


def sea_filter(station: marine.Station, y0: np.ndarray) -> InformationEKF:
    """Extended Kalman filter with the spectral densities of all noise sources of the log.

    Args:
        station: Model of the ship and its disturbances.
        y0: First measurement (3,), at which the filter starts.

    Returns:
        The filter.
    """
    part, order = station.parts, station.order
    q = np.zeros(order)
    q[part["waves"]][3:] = np.asarray(station.waves.intensity) ** 2 if station.waves else 0.0
    q[part["bias"]] = (np.array([3e4, 3e4, 1e6]) ** 2) * 2 / 1000.0
    q[part["nu"]] = np.array([1e-6, 1e-6, 1e-9])
    variances = np.full(order, 1.0)
    variances[part["eta"]] = np.array([1.0, 1.0, 1e-3])
    variances[part["nu"]] = np.array([0.1, 0.1, 1e-4])
    variances[part["waves"]] = np.array([1.0, 1.0, 1e-3] * 2)
    variances[part["bias"]] = np.array([1e9, 1e9, 1e12])
    density = STEP * np.diag([GNSS**2, GNSS**2, COMPASS**2])
    start = jnp.zeros(order).at[:3].set(jnp.asarray(y0))
    return InformationEKF(
        station.model(),
        Equation(process_cov=jnp.diag(jnp.asarray(q)), measurement_cov=jnp.asarray(density)),
        start,
        jnp.diag(1 / jnp.asarray(variances)),
        substeps=5,  # the waves change its information matrix fast; with a single step it would be wrong by half
    )


def sea_errors(log: Sea) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Errors of the estimated velocities; row k uses measurements up to row k.

    Args:
        log: As from `sea`.

    Returns:
        Errors (T, 3) of surge, sway [m/s] and yaw rate [rad/s], by estimator.
    """
    record = log.record
    truth = np.asarray(record.x)[:, 3:6]
    passive, kalman, filtered = (np.asarray(run(o, record).estimate) for o in log.observers.values())
    derived = filtered[:, 3:]
    heading = np.asarray(record.x)[:, 2]
    # R(ψ)ᵀ converts velocities over ground to the frame of the ship, in which the other estimators work.
    turned = np.stack(
        [
            np.cos(heading) * derived[:, 0] + np.sin(heading) * derived[:, 1],
            -np.sin(heading) * derived[:, 0] + np.cos(heading) * derived[:, 1],
            derived[:, 2],
        ],
        axis=1,
    )
    estimates = (passive[:, 3:6], kalman[:, 3:6], turned)
    return {name: estimate - truth for name, estimate in zip(log.observers, estimates, strict=True)}


def sea_cost(log: Sea, samples: int = 1000) -> dict[str, float]:
    """Time per sample in the compiled loop on this machine, over the first samples of the log.

    Args:
        log: As from `sea`.
        samples: Number of samples.

    Returns:
        Times [µs], by estimator.
    """
    t, u, y, _ = log.record
    costs, record = {}, Record(t[:samples], u[:samples], y[:samples])
    for name, observer in log.observers.items():
        jax.block_until_ready(run(observer, record).estimate)
        began = time.perf_counter()
        jax.block_until_ready(run(observer, record).estimate)
        costs[name] = 1e6 * (time.perf_counter() - began) / len(record.t)
    return costs


SETTLED = 100.0
"""Length of the initial part of the log that is not scored [s]."""


def sea_table(log: Sea) -> dict[str, dict[str, float]]:
    """Velocity errors (RMSE) after the first 100 s, and in the gaps of GNSS.

    Args:
        log: As from `sea`.

    Returns:
        `surge`, `sway` [m/s], `yaw_rate` [rad/s] and `gaps` [m/s], by estimator.
    """
    t = np.asarray(log.record.t)
    gap = np.zeros(len(t), bool)
    for begin, end in GAPS:
        gap |= (t >= begin) & (t < end)
    table = {}
    for name, error in sea_errors(log).items():
        rms = np.sqrt(np.mean(error[t > SETTLED] ** 2, axis=0))
        worst = np.sqrt(np.mean(np.sum(error[gap, :2] ** 2, axis=1)))
        table[name] = {"surge": float(rms[0]), "sway": float(rms[1]), "yaw_rate": float(rms[2]), "gaps": float(worst)}
    return table
