"""All estimators for the same task, tuned from the same data sheet for the least predicted velocity error."""

import functools
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant.calibration._data_sheet import DataSheet, Trial
from covariant.calibration._filters import filter_bandwidth, jerk_bound, joint_noise, polynomial
from covariant.calibration._gains import Gains, gains
from covariant.models import MechanicalSystem, StateSpace
from covariant.observers import (
    OBSERVER_NAMES,
    REGISTRY,
    STATE_OBSERVER_NAMES,
    STATE_REGISTRY,
    AbstractObserver,
    Entry,
    Gated,
    Noise,
    external_force,
)

ESTIMATORS = OBSERVER_NAMES
"""Names of all estimators of mechanical systems: those in `covariant.observers.REGISTRY`."""
STATE_ESTIMATORS = STATE_OBSERVER_NAMES
"""Names of all estimators of state-space models: those in `covariant.observers.STATE_REGISTRY`."""


def observer_gains(sheet: DataSheet, rate: float) -> Gains:
    """`gains` for a data sheet at a sampling rate [Hz]."""
    return gains(
        sheet.measurement_std,
        rate,
        sheet.acceleration_std,
        sheet.correlation_time,
        sheet.damping,
        sheet.natural_frequency,
    )


@functools.singledispatch
def estimators(model: Any) -> tuple[str, ...]:
    """Names of the estimators that fit a mechanical or state-space model; the first is the one to begin with."""
    return tuple(entry.name for entry in REGISTRY if entry.fits(model))


@estimators.register
def _(model: StateSpace) -> tuple[str, ...]:
    return STATE_ESTIMATORS


@functools.singledispatch
def with_gains(model: Any, alpha: float, beta: float) -> dict[str, AbstractObserver]:
    """The observers that take the gains α [1/s] and β [1/s²], by name; none for a state-space model.

    Salcudean's observer has α and β exactly only for an inertia that is the same in all directions; otherwise they hold
    for the mean of the principal inertias.
    """
    fitting = (entry for entry in REGISTRY if entry.tuned_by == "gains" and entry.fits(model))
    return {entry.name: entry.make(model, alpha, beta) for entry in fitting}


@with_gains.register
def _(model: StateSpace, alpha: float, beta: float) -> dict[str, AbstractObserver]:
    return {}


class Known(NamedTuple):
    """What is known when an estimator is tuned: n velocities, the data sheet, the rate [Hz], and perhaps a trial."""

    n: int
    sheet: DataSheet
    rate: float
    trial: Trial | None


def tuned_estimators(
    model: MechanicalSystem,
    n: int,
    sheet: DataSheet,
    rate: float,
    trial: Trial | None = None,
    names: Collection[str] = ESTIMATORS,
) -> dict[str, AbstractObserver]:
    """The `estimators` by name, for a model of n velocities sampled at `rate` [Hz]; only those in `names`.

    Filters without a model are tuned by the data sheet too or, where there is a `trial`, to what is best on it. What
    has no gate of its own is `gated`. Raises `ValueError` for numbers of the data sheet that are not positive.
    """
    for name in ("motion_std", "motion_time"):
        if not 0 < getattr(sheet, name) < np.inf:
            raise ValueError(f"tuned_estimators: {name} must be a positive number; got {getattr(sheet, name)}")
    known = Known(n, sheet, rate, trial)
    fitting = (entry for entry in REGISTRY if entry.name in names and entry.fits(model))
    made = {entry: entry.make(model, *TUNINGS[entry.tuned_by](entry, known)) for entry in fitting}
    bare = {entry.name for entry in made if entry.has_gate or sheet.speed is None}
    return {entry.name: each if entry.name in bare else gated(each, model, sheet) for entry, each in made.items()}


def tuned_state_estimators(
    model: StateSpace, noise: Noise, names: Collection[str] = STATE_ESTIMATORS
) -> dict[str, AbstractObserver]:
    """The `estimators` of a state-space model by name, for what it does not know; only those in `names`.

    Raises `ValueError` for one that cannot be made where the first estimate is.
    """
    return {entry.name: entry.make(model, noise) for entry in STATE_REGISTRY if entry.name in names}


def gated(observer: AbstractObserver, model: MechanicalSystem, sheet: DataSheet) -> Gated:
    """The observer behind a gate for the noise and the speed of a data sheet, or else `motion_std · motion_time`."""
    std = sheet.coordinate_stds or sheet.measurement_std
    return Gated(observer, model, jnp.asarray(std, float), jnp.asarray(sheet.speeds))


def _gains(entry: Entry, known: Known) -> tuple:
    chosen = observer_gains(known.sheet, known.rate)
    return chosen.alpha, chosen.beta


def _noise(entry: Entry, known: Known) -> tuple:
    sheet = known.sheet
    time = 1 / (2 * known.rate) if sheet.correlation_time is None else sheet.correlation_time
    process_cov = 2 * sheet.acceleration_std**2 * time * jnp.eye(known.n)
    std = jnp.broadcast_to(jnp.asarray(sheet.coordinate_stds or sheet.measurement_std, float), known.n)
    return process_cov, jnp.diag(std**2), sheet.motion_std * sheet.motion_time


def _ticks(entry: Entry, known: Known) -> tuple:
    sheet, slow = known.sheet, known.sheet.slow
    if sheet.external_force is not None:
        slow += (external_force(sheet.external_force**2 * jnp.eye(known.n)),)
    return *_noise(entry, known), sheet.quantum, slow


def _bandwidth(entry: Entry, known: Known) -> tuple:
    kind: Any = entry.observer
    return (filter_bandwidth(known.sheet, known.rate, known.trial, kind),)


TUNINGS: dict[str, Callable[[Entry, Known], tuple]] = {
    "gains": _gains,
    "noise": _noise,
    "noise or ticks": _ticks,
    "bandwidth": _bandwidth,
    "window": lambda entry, known: polynomial(known.sheet, known.rate, known.trial),
    "motion": lambda entry, known: joint_noise(known.sheet, known.rate, known.trial),
    "jerk": lambda entry, known: (jerk_bound(known.sheet, known.trial),),
}
"""How the numbers are found that an entry of the registry is `tuned_by`."""
