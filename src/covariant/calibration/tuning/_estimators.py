"""Estimators tuned from one data sheet, each for the least predicted velocity error."""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from covariant._functional import Functional
from covariant._typing import Matrix, Vector
from covariant.calibration.tuning._data_sheet import DataSheet, Trial
from covariant.calibration.tuning._filters import filter_bandwidth, jerk_bound, joint_noise, loop_bandwidth, polynomial
from covariant.calibration.tuning._gains import Gains, gains
from covariant.geometry import AbstractSpace
from covariant.models import MechanicalSystem, StateSpace
from covariant.observers import (
    EKF,
    OBSERVER_NAMES,
    REGISTRY,
    STATE_OBSERVER_NAMES,
    AbstractObserver,
    Entry,
    Gated,
    StateNoise,
    external_force,
)
from scalargraph.errors import InputError

ESTIMATORS = OBSERVER_NAMES
"""Names of all estimators of mechanical systems: as in `covariant.observers.REGISTRY`."""
STATE_ESTIMATORS = STATE_OBSERVER_NAMES
"""Names of all estimators of state-space models: as in `covariant.observers.REGISTRY`."""


def observer_gains(sheet: DataSheet, rate: float, space: AbstractSpace | None = None) -> Gains:
    """Gains α and β for a data sheet, by `gains`, and with a space also the rate at which a force is learnt.

    Use it where the numbers are in a `DataSheet` already, as `covariant.estimate` does with the numbers of a model
    file. It returns one pair of gains for all coordinates. `tuned_estimators` returns complete observers.

    Args:
        sheet: The data sheet.
        rate: Sampling rate [Hz].
        space: Configuration space of the model, for gains of `IntrinsicForce`, whose unknown force accelerates the
            coordinates as it does at the origin, in the mean; None (default) for an observer without a force.

    Returns:
        The gains, and the errors that they should leave.

    Example:
        >>> from covariant.calibration import DataSheet, observer_gains
        >>> from covariant.models import oscillator
        >>> round(observer_gains(DataSheet(measurement_std=1e-3, acceleration_std=0.5), rate=100.0).beta)
        500
        >>> sheet = DataSheet(1e-3, 0.1, 0.5, external_force_std=1.0, external_force_time=0.5)
        >>> round(observer_gains(sheet, 100.0, oscillator().space).force_rate)
        16
    """
    return gains(
        sheet.measurement_std,
        rate,
        sheet.acceleration_std,
        sheet.correlation_time,
        sheet.damping,
        sheet.natural_frequency,
        **({} if space is None else _force_acceleration(sheet, space)),
    )


def _force_acceleration(sheet: DataSheet, space: AbstractSpace) -> dict[str, Any]:
    """The acceleration by an unknown force, its time constant, and the rate at which it is learnt, for `gains`."""
    force = sheet.external_force if sheet.external_force_std is None else sheet.external_force_std
    if force is None:
        return {"force_rate": sheet.force_rate}
    q = space.manifold.origin()
    inverse = np.linalg.inv(np.asarray(jax.jit(space)(q)))
    accelerations = np.linalg.norm(inverse * np.broadcast_to(force, len(inverse)), axis=1)
    return {
        "force_std": float(accelerations.mean()),
        "force_time": sheet.external_force_time,
        "force_rate": sheet.force_rate,
    }


def estimators(model: MechanicalSystem | StateSpace) -> tuple[str, ...]:
    """Names of the estimators that fit a model.

    Args:
        model: A mechanical or state-space model.

    Returns:
        The names; the first is the one to begin with.

    Example:
        >>> from covariant.calibration import estimators
        >>> from covariant.models import duffing, oscillator
        >>> estimators(oscillator())[0], estimators(duffing())[0]
        ('intrinsic', 'covariance-ekf')
    """
    return tuple(entry.name for entry in REGISTRY if entry.fits(model))


def with_gains(
    model: MechanicalSystem, alpha: ArrayLike, beta: ArrayLike, speed: ArrayLike | None = None
) -> dict[str, AbstractObserver]:
    """Observers with the constant gains α and β, by name.

    Gains (n,), one for each coordinate, and a bound of the speeds are for `measured-coefficients` alone.

    Salcudean's observer has α and β exactly only for an inertia that is the same in all directions; otherwise they hold
    for the mean of the principal inertias.

    Args:
        model: A mechanical system. For a state-space model the result is empty.
        alpha: Position gain α [1/s], one number or (n,).
        beta: Velocity gain β [1/s²], one number or (n,).
        speed: Bound of the true velocities [unit/s], one number or (n,).

    Returns:
        The observers of the registry that take these numbers and fit the model.

    Example:
        >>> from covariant.calibration import with_gains
        >>> from covariant.models import oscillator
        >>> list(with_gains(oscillator(), alpha=10.0, beta=50.0))
        ['intrinsic', 'intrinsic2', 'geodesic', 'lagrangian-metric', 'measured-coefficients', 'copy']
    """
    numbers = (alpha, beta) if speed is None else (alpha, beta, speed)
    kinds = ("gains", "gains and speed")[speed is not None or np.ndim(alpha) + np.ndim(beta) > 0 :]
    fitting = (entry for entry in REGISTRY if entry.tuned_by in kinds and entry.fits(model))
    return {entry.name: entry.construct(model, *numbers) for entry in fitting}


class _Known(NamedTuple):
    """Data from which an estimator of n velocities is tuned."""

    n: int
    sheet: DataSheet
    rate: float
    trial: Trial | None
    model: MechanicalSystem


def tuned_estimators(
    model: MechanicalSystem,
    n: int,
    sheet: DataSheet,
    rate: float,
    trial: Trial | None = None,
    names: Collection[str] = ESTIMATORS,
) -> dict[str, AbstractObserver]:
    """Estimators of a mechanical system by name, all tuned from one data sheet.

    Use it for a fair comparison of observers: each gets the same knowledge of sensor, model and motion. The verb
    `covariant.compare` runs and ranks them. Use `observer_gains` where you need the gains of one observer only.

    Args:
        model: The mechanical system.
        n: Its number of velocities.
        sheet: The data sheet.
        rate: Sampling rate [Hz].
        trial: Part of a log, for which filters without a model are optimised; by default the data sheet tunes them too.
        names: Estimators to return; those that do not fit the model are left out.

    Returns:
        The estimators. One without a built-in gate is `gated` where the data sheet has a `speed`.

    Raises:
        ValueError: A number of the data sheet is not positive.

    Example:
        >>> from covariant.calibration import DataSheet, tuned_estimators
        >>> from covariant.models import oscillator
        >>> sheet = DataSheet(measurement_std=1e-3, acceleration_std=0.5)
        >>> tuned = tuned_estimators(oscillator(), 1, sheet, rate=100.0, names=("ekf", "intrinsic"))
        >>> sorted(tuned), round(float(tuned["intrinsic"].beta))
        (['ekf', 'intrinsic'], 500)
    """
    for name in ("motion_std", "motion_time"):
        if not 0 < getattr(sheet, name) < np.inf:
            raise InputError(f"tuned_estimators: {name} must be a positive number; got {getattr(sheet, name)}")
    known = _Known(n, sheet, rate, trial, model)
    fitting = (entry for entry in REGISTRY if entry.name in names and entry.fits(model))
    tuned = {entry: entry.construct(model, *TUNINGS[entry.tuned_by](entry, known)) for entry in fitting}
    bare = {entry.name for entry in tuned if entry.has_gate or sheet.speed is None}
    return {entry.name: each if entry.name in bare else gated(each, model, sheet) for entry, each in tuned.items()}


def tuned_state_estimators(
    model: StateSpace, noise: StateNoise, names: Collection[str] = STATE_ESTIMATORS
) -> dict[str, AbstractObserver]:
    """Estimators of a state-space model by name, for its noise.

    Args:
        model: The state-space model.
        noise: Process and measurement noise, first estimate with its covariance, and sampling rate.
        names: Estimators to return.

    Returns:
        The estimators.

    Raises:
        ValueError: An estimator cannot be built at the first estimate.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.calibration import tuned_state_estimators
        >>> from covariant.models import duffing
        >>> from covariant.observers import StateNoise
        >>> noise = StateNoise(0.1 * jnp.eye(2), 1e-4 * jnp.eye(1), jnp.zeros(2), jnp.eye(2), 100.0)
        >>> list(tuned_state_estimators(duffing(), noise, names=("covariance-ekf",)))
        ['covariance-ekf']
    """
    fitting = (entry for entry in REGISTRY if entry.name in names and entry.fits(model))
    return {entry.name: entry.construct(model, noise) for entry in fitting}


def gated(observer: AbstractObserver, model: MechanicalSystem, sheet: DataSheet) -> Gated:
    """Wrap an observer in a gate that refuses outliers; one with constant gains also starts fast.

    Args:
        observer: The observer.
        model: Its mechanical system.
        sheet: Data sheet with the noise, and the usual speeds as in `DataSheet.speeds`.

    Returns:
        The observer behind the gate.

    Example:
        >>> from covariant.calibration import DataSheet, gated
        >>> from covariant.models import oscillator
        >>> from covariant.observers import Intrinsic
        >>> sheet = DataSheet(measurement_std=1e-3, acceleration_std=0.5)
        >>> observer = gated(Intrinsic(oscillator(), 10.0, 50.0), oscillator(), sheet)
        >>> type(observer).__name__, float(observer.noise)
        ('Gated', 0.001)
    """
    std = sheet.coordinate_stds or sheet.measurement_std
    numbers = jnp.asarray(std, float), jnp.asarray(sheet.speeds)
    return Gated(observer, model, *numbers, fast_start=hasattr(observer, "beta"))


class _TorqueNoise(Functional):
    """Spectral density `A + M⁻¹ W M⁻¹` of the acceleration noise, a function of the configuration with inertia M.

    Torques of the joints are noisy, with the roots `torque` (n,) of their spectral densities W: where a joint meets
    little inertia the same torque accelerates it more, and it accelerates the other joints as well. A (n, n) is that of
    accelerations that are noisy by themselves, in the frame.
    """

    space: AbstractSpace
    acceleration: Matrix
    torque: Vector

    def __call__(self, q: Array) -> Float[Array, "n n"]:
        columns = jnp.diag(self.torque).astype(self.acceleration.dtype)
        root = jax.vmap(lambda covector: self.space.raise_(q, covector), in_axes=1, out_axes=1)(columns)
        return self.acceleration + root @ root.T


def _gains_and_force(entry: Entry, known: _Known) -> tuple:
    chosen = observer_gains(known.sheet, known.rate, known.model.space)
    return chosen.alpha, chosen.beta, chosen.force_rate


def _noise(entry: Entry, known: _Known) -> tuple:
    sheet, time = known.sheet, known.sheet.white_time(known.rate)
    process_cov = jnp.asarray(2 * sheet.acceleration_std**2 * time * np.eye(known.n))
    if sheet.torque_std is not None and entry.observer is not EKF:  # which has the same noise everywhere
        torque = np.sqrt(2 * time) * np.broadcast_to(np.asarray(sheet.torque_std, float), known.n)
        process_cov = _TorqueNoise(known.model.space, process_cov, jnp.asarray(torque))
    return process_cov, jnp.asarray(np.diag(sheet.stds(known.n) ** 2)), jnp.broadcast_to(sheet.speeds, known.n)


def _ticks(entry: Entry, known: _Known) -> tuple:
    sheet, slow = known.sheet, known.sheet.slow
    if sheet.external_force is not None:
        slow += (external_force(sheet.external_force**2 * jnp.eye(known.n)),)
    if sheet.external_force_std is not None:
        std = np.broadcast_to(sheet.external_force_std, known.n)
        slow += (external_force(std=std, time=sheet.external_force_time),)
    return *_noise(entry, known), sheet.quantum, slow, sheet.sensors, sheet.inputs


TUNINGS: dict[str, Callable[[Any, _Known], tuple]] = {
    "gains": lambda entry, known: observer_gains(known.sheet, known.rate)[:2],
    "gains and force": _gains_and_force,
    "gains and speed": lambda entry, known: known.sheet.gains_and_speed or observer_gains(known.sheet, known.rate)[:2],
    "noise": _noise,
    "noise or ticks": _ticks,
    "bandwidth": lambda entry, known: (
        filter_bandwidth(known.sheet, known.rate, known.trial, partial(entry.make, known.model)),
    ),
    "window": lambda entry, known: polynomial(known.sheet, known.rate, known.trial),
    "motion": lambda entry, known: joint_noise(known.sheet, known.rate, known.trial),
    "jerk": lambda entry, known: (jerk_bound(known.sheet, known.trial),),
    "loop": lambda entry, known: (
        loop_bandwidth(known.sheet, known.rate, known.trial, partial(entry.make, known.model)),
    ),
}
"""How each kind of number, `tuned_by` in an entry of the registry, is computed."""
