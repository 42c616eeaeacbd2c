"""External forces without a filter: momentum observers and inverse dynamics, from filtered derivatives."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._gauss_markov import gauss_markov
from covariant.calibration import DataSheet, filter_bandwidth, gated
from covariant.models import MechanicalSystem
from covariant.observers import (
    AbstractForceObserver,
    FilteredDerivative,
    InverseDynamics,
    MomentumObserver,
    observed_forces,
    run,
)
from covariant.signals import Record

USUAL_GAIN = 25.0
"""Gain [1/s] of a momentum observer that nobody tuned."""
GAINS = np.geomspace(1.0, 300.0, 12)
"""Gains [1/s] of momentum observers, and bandwidths [rad/s] of accelerations, that are tried where they are tuned."""
BANDWIDTHS = 0.125, 0.25, 0.5, 1.0, 2.0, 4.0
"""Bandwidths of the velocity filter that are tried, as multiples of the one that is best for velocities."""
HIGH_PASSES = np.inf, 10.0, 3.0, 1.0, 0.3
"""Time constants [s] of a high-pass filter of the force that are tried; none first."""


class Rival(NamedTuple):
    """Forces by an estimator without a covariance.

    Attributes:
        name: Its name.
        force: Generalised forces (T, n) along the velocities [N or N m].
        design: How it was tuned.
    """

    name: str
    force: Float[np.ndarray, "T n"]
    design: str


def rivals(
    model: MechanicalSystem,
    record: Record,
    sheet: DataSheet,
    rate: float,
    true: Float[np.ndarray, "T n"],
    scored: Bool[np.ndarray, "T"],
) -> list[Rival]:
    """Estimate forces by the rivals of a filter."""
    if not model.manifold.commuting:
        return []
    log = record._replace(u=_held(np.asarray(record.u)))
    bandwidth = filter_bandwidth(sheet, rate)
    motion = _motion(model, log, sheet, bandwidth)
    usual = np.asarray(observed_forces(MomentumObserver(model, USUAL_GAIN), log.t, log.u, *motion))
    motions = {multiple * bandwidth: _motion(model, log, sheet, multiple * bandwidth) for multiple in BANDWIDTHS}
    return [
        Rival("momentum observer, usual", usual, f"{_of(bandwidth)}; gain {USUAL_GAIN:g} 1/s"),
        _tune_rival("momentum observer", MomentumObserver, model, log, motions, true, scored),
        _tune_rival("inverse dynamics", InverseDynamics, model, log, motions, true, scored),
    ]


def _tune_rival(
    name: str,
    kind: Callable[..., AbstractForceObserver],
    model: MechanicalSystem,
    log: Record,
    motions: dict[float, tuple[np.ndarray, np.ndarray]],
    true: np.ndarray,
    scored: np.ndarray,
) -> Rival:
    """The observer that is best for these forces, of all bandwidths, gains, high-passes and scales."""
    size = np.sqrt(np.mean(true[scored] ** 2, axis=0))
    weight = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    wanted, least, best = true[scored] * weight, np.inf, Rival("", true, "")
    for bandwidth, motion in motions.items():
        by_gain = np.asarray(_by_gain(kind, model, *(jnp.asarray(each) for each in (GAINS, log.t, log.u, *motion))))
        for (gain, force), time in itertools.product(zip(GAINS, by_gain, strict=True), HIGH_PASSES):
            passed = force if time == np.inf else force - np.asarray(_lagged(*map(jnp.asarray, (log.t, force, time))))
            seen = passed[scored] * weight
            scale = max(float(np.sum(seen * wanted) / max(np.sum(seen * seen), np.finfo(float).tiny)), 0.0)
            error = float(np.mean((scale * seen - wanted) ** 2))
            if error < least:
                high = "no high-pass" if time == np.inf else f"high-pass of {time:g} s"
                design = f"{_of(bandwidth)}; gain {gain:.3g} 1/s, {high}, scale {scale:.2g}: the best for this very log"
                least, best = error, Rival(f"{name}, tuned to the truth", scale * passed, design)
    return best


def _of(bandwidth: float) -> str:
    return f"velocities by filtered-derivative, {bandwidth:.3g} rad/s"


def _motion(model: MechanicalSystem, log: Record, sheet: DataSheet, bandwidth: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (T, n) by a filtered derivative behind a gate."""
    derivative = gated(FilteredDerivative(jnp.asarray(bandwidth), model.circles), model, sheet)
    q, v = np.split(np.asarray(run(derivative, log, ()).estimate), 2, axis=1)
    return q, v


def _held(u: Float[np.ndarray, "T m"]) -> Float[np.ndarray, "T m"]:
    """Inputs, each that is not finite replaced by the last one before it that is, or zero."""
    rows = np.maximum.accumulate(np.where(np.isfinite(u), np.arange(len(u))[:, None], 0), axis=0)
    return np.nan_to_num(np.take_along_axis(u, rows, axis=0))


@eqx.filter_jit
def _by_gain(
    kind: Callable[..., AbstractForceObserver],
    model: MechanicalSystem,
    gains: Array,
    t: Array,
    u: Array,
    q: Array,
    v: Array,
) -> Float[Array, "k T n"]:
    return jax.vmap(lambda gain: observed_forces(kind(model, gain), t, u, q, v))(gains)


@jax.jit
def _lagged(t: Array, x: Float[Array, "T n"], time: Array) -> Float[Array, "T n"]:
    """Signals behind a first-order lag, which starts at zero; each value acts over the step that leads to it."""

    def step(now, row):
        value, dt = row
        now = value + gauss_markov(dt / time)[1] * (now - value)
        return now, now

    return jax.lax.scan(step, jnp.zeros_like(x[0]), (x, jnp.diff(t, prepend=t[:1])))[1]
