"""A constant gain of output injection that makes a copy of the plant contracting."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant._typing import Numbers
from covariant.certificates import MetricDesign, observer_gain
from covariant.models import StateSpace


def contracting_gain(
    model: StateSpace,
    states: Numbers,
    rate: float,
    *,
    inputs: Numbers | None = None,
    t: float = 0.0,
    effort: float = 1e-3,
) -> MetricDesign:
    """A gain K (n, p) and metric M (n, n) for `observers.Contracting`, from the model's Jacobians at given states.

    - `states` (k, n): the states at which the virtual system has to contract. Between them this has to be certified.
    - `rate` [1/s]: rate at which squared lengths decay there.
    - `inputs` (k, m): the input at each state, zero by default; `t` [s]: time given to the model.
    - `effort`: as for `certificates.observer_gain`, which does the design.

    The Jacobians are those of the virtual system, at fixed input. Raises `ValueError` where the states do not fit the
    model or no gain is found.
    """
    x = np.atleast_2d(np.asarray(states, float))
    n = len(model.coordinates) or x.shape[1]
    if x.ndim != 2 or x.shape[1] != n:
        raise ValueError(f"states must have the shape (k, {n}); got {np.shape(states)}")
    u = np.zeros((len(x), model.inputs)) if inputs is None else np.asarray(inputs, float)
    if u.shape != (len(x), model.inputs):
        raise ValueError(f"inputs must have the shape ({len(x)}, {model.inputs}), one row a state; got {u.shape}")
    now = jnp.asarray(t)
    f, h = jax.vmap(lambda x, u: model.jacobians(now, x, u))(jnp.asarray(x), jnp.asarray(u))
    return observer_gain(np.asarray(f), np.asarray(h), rate, effort=effort)
