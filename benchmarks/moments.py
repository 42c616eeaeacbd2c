"""Pendulum chains of several lengths, and one moment of each for the observers to work on."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.observers import EKF, AbstractObserver, Intrinsic, ModelCopy

SIZES = (2, 4, 7)
BATCH = 1000
OBSERVERS = ("copy", "intrinsic", "ekf")
"""`copy` is the model with output injection and no geometry: the reference the others are compared with."""


class Moment(NamedTuple):
    """An observer with the arguments of its step: state, input, measurement, time since the last one [s]."""

    observer: AbstractObserver
    state: Any
    u: jnp.ndarray
    y: jnp.ndarray
    dt: jnp.ndarray


def moment(name: str, n: int) -> Moment:
    """An observer of a chain of n links, in motion and a little off."""
    rng = np.random.default_rng(n)
    model = models.pendulum_chain(
        mass=tuple(rng.uniform(0.5, 1.5, n)),
        length=(0.3,) * n,
        com=(0.15,) * n,
        inertia=(0.01,) * n,
        viscous=(0.05,) * n,
    )
    one = jnp.eye(n)
    observer = {
        "copy": ModelCopy(model, 100.0, 5000.0, substeps=1),
        "intrinsic": Intrinsic(model, 100.0, 5000.0, substeps=1),
        "ekf": EKF(model, 0.1 * one, 1e-6 * one, substeps=1),
    }[name]
    q, v, u = (jnp.asarray(a) for a in rng.uniform(-1, 1, (3, n)))
    state = observer.init(q)._replace(v=3 * v)
    return Moment(observer, state, u, q + 0.01, jnp.asarray(0.002))
