"""Which slow states, such as biases and forces, a log and its sensors determine: by the filter's covariance."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.observers import AbstractObserver, IntrinsicKalman
from covariant.verbs.base.inputs import Loaded
from covariant.verbs.base.outcome import Outcome, known

DETERMINED = 0.5
"""Standard deviation at the end of a log, over the one without any measurement, below which a state is determined."""
UNDETERMINED = 0.9
"""The same from which it is not determined at all."""
COVARIANCES = "first_cov", "walk_cov"
LARGE = 0.3
"""Components of a direction that are named, as a fraction of its largest one."""


class Determinacy(NamedTuple):
    """How well a log determines a slow state, or a combination of several.

    Attributes:
        name: The state, as "imu_bias2", or the combination, as "imu_bias1 - 0.8 imu_bias2", each over its own standard
            deviation without a measurement.
        first: Standard deviation that it would have at the end of the log without any measurement.
        last: Its standard deviation at the end of the log.
        unit: Unit of both; "" where it is not known, or has none; of a combination "of their std".

    Example:
        >>> from covariant.verbs.base.determined import Determinacy
        >>> print(Determinacy("imu_bias2", 0.1, 0.003, "rad/s"))
        imu_bias2: determined to 0.003 rad/s (0.1 rad/s without the log)
        >>> print(Determinacy("imu_bias1", 0.1, 0.0999, "rad/s"))
        imu_bias1: not determined (nothing in the log shows it)
    """

    name: str
    first: float
    last: float
    unit: str

    @property
    def ratio(self) -> float:
        """Standard deviation at the end over that without any measurement; 0 is known, 1 not determined."""
        return self.last / self.first if self.first > 0 else 0.0

    def __str__(self) -> str:
        if self.ratio >= UNDETERMINED:
            return f"{self.name}: not determined (nothing in the log shows it)"
        how = "determined" if self.ratio <= DETERMINED else "hardly determined,"
        last, first = (f"{value:.2g} {self.unit}".rstrip() for value in (self.last, self.first))
        return f"{self.name}: {how} to {last} ({first} without the log)"


def determined(observer: AbstractObserver, loaded: Loaded, outcome: Outcome) -> tuple[Determinacy, ...]:
    """How well a log determines the slow states of a filter.

    The covariance at the end is compared with that of the same states without any measurement: their first covariance,
    with what a random walk adds to it. States that are forgotten are left out: at the end of a log nothing but its last
    moments tells of them. Of states that are not determined alone, the directions of the covariance are looked at, in
    units of the latter: a sum may be known where its parts are not.
    """
    filter_ = getattr(observer, "observer", observer)  # behind a delay
    std = known(outcome.run.info, "slow_std")
    if not isinstance(filter_, IntrinsicKalman) or std is None or not std.shape[1]:
        return ()
    t = np.asarray(outcome.run.t)
    groups = (*filter_.slow, *(sensor.slow for sensor in filter_.sensors if sensor.slow is not None))
    stay = np.concatenate([np.full(len(group.names), group.stay) for group in groups])
    if not stay.any():
        return ()
    lasted = t[-1] - t[0]
    initial, walk = (np.concatenate([np.diag(np.asarray(getattr(g, of))) for g in groups]) for of in COVARIANCES)
    free = initial + walk * lasted
    # Reported values may be functions of the states, as of parameters: what time adds is in proportion.
    proportional = np.concatenate([np.full(len(group.names), group.values is not None) for group in groups])
    first = np.where(proportional, std[0] * np.sqrt(free / np.maximum(initial, 1e-300)), np.sqrt(free))
    each = zip(filter_.slow_names, first.tolist(), std[-1].tolist(), stay, strict=True)
    found = [Determinacy(name, prior, last, _unit(name, loaded)) for name, prior, last, stays in each if stays]
    vague = [i for i, each in enumerate(found) if each.ratio > DETERMINED]
    if len(vague) < 2:
        return tuple(found)
    record = loaded.record_for(filter_)
    n, unclear = loaded.file.dimension, np.flatnonzero(stay)[vague]
    cov = np.asarray(_last_covariance(filter_, *(jnp.asarray(part, float) for part in record[:3])))[2 * n :, 2 * n :]
    return (*found, *_directions([found[i] for i in vague], cov[np.ix_(unclear, unclear)], free[unclear]))


def _unit(name: str, loaded: Loaded) -> str:
    """The unit of a slow state: that of a sensor for its bias, which is called after it."""
    with_slow = ((part.unit, part.sensor.slow) for part in loaded.sensors)
    return next((unit for unit, slow in with_slow if slow is not None and name in slow.names), "")


@eqx.filter_jit
def _last_covariance(observer: IntrinsicKalman, t: Array, u: Array, y: Array) -> Float[Array, "N N"]:
    """Covariance (N, N) of the error of a filter after the last row."""
    # An input is held from its stamp on, so that a step uses that of the row before.
    rows = u[:-1], y[1:], jnp.diff(t)
    state, _ = jax.lax.scan(lambda now, row: (observer.step(now, *row)[0], None), observer.init(y[0], t[0]), rows)
    return observer.cov(state)


def _directions(states: list[Determinacy], cov: np.ndarray, free: np.ndarray) -> list[Determinacy]:
    """Directions of several states together that are determined much better, or worse, than each of them."""
    size = np.sqrt(free)
    variances, vectors = np.linalg.eigh(cov / np.outer(size, size))
    found = []
    for variance, vector in zip(variances, vectors.T, strict=True):
        largest = np.abs(vector).max()
        named = [(states[i].name, c / largest) for i, c in enumerate(vector) if abs(c) > LARGE * largest]
        if len(named) < 2:  # the state itself
            continue
        sign = np.sign(named[0][1])
        text = " ".join(_term(name, sign * c, first=k == 0) for k, (name, c) in enumerate(named))
        found.append(Determinacy(text, 1.0, float(np.sqrt(max(variance, 0.0))), "of their std"))
    return found


def _term(name: str, factor: float, first: bool) -> str:
    size = "" if abs(abs(factor) - 1) < 0.05 else f"{abs(factor):.1g} "
    sign = "" if first else ("+ " if factor > 0 else "- ")
    return f"{sign}{size}{name}"
