"""A constant gain that makes a copy of the plant contracting."""

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
    """K (n, p) and M (n, n) for `observers.Contracting`, from the model's Jacobians at `states` (k, n).

    `inputs` (k, m), zero by default; `rate` [1/s] of squared lengths, at the states given: between them it has to be
    certified. The Jacobians are those of the virtual system, at fixed input.

    Raises `ValueError` where the states do not fit the model or no gain serves.
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
