"""Observer with a metric that was computed on a grid."""

import os

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.metrics import load_metric, open_metric
from covariant.models import StateSpace
from covariant.observers import Riccati
from scalargraph.errors import InputError


def stored_observer(model: StateSpace, path: str | os.PathLike[str], start: Float[Array, "n"]) -> Riccati:
    """Observer that interpolates a stored metric, with R as in the equation of the metric.

    Its gain is ¼ for a metric of an equation with rate λ, whose distance then decays at the rate λ/2, and ½ for one
    without, the stationary Kalman filter (Sanfelice & Praly 2015, (11)).

    Args:
        model: The state-space model, with the parameters for which the metric was computed.
        path: Folder of a finished store of `metrics.metric_on_grid`.
        start: First estimate (n,).

    Returns:
        The observer.

    Raises:
        ValueError: The store is not one of `metrics.metric_on_grid`, not finished, of other states than the model's, or
            of other parameters.
    """
    store, field = open_metric(path), load_metric(path)
    provenance = store.attrs["provenance"]
    if field.low.shape != start.shape:
        raise InputError(f"{path}: a metric of {field.low.shape[0]} states; the model has {start.shape[0]}")
    names = store["metric"].dims[:-2]
    if model.coordinates and names != model.coordinates:
        raise InputError(f"{path}: a metric of {', '.join(names)}; the states are {', '.join(model.coordinates)}")
    parameters = {key: np.asarray(parameter.value) for key, parameter in model.parameters.items()}
    for key in sorted({*provenance["parameters"], *parameters}):
        stored, actual = provenance["parameters"].get(key), parameters.get(key)
        # Equal to the last digit: numbers were stored with all of theirs, and another one is another equation.
        if stored is None or actual is None or not np.array_equal(np.asarray(stored), actual):
            raise InputError(f"{path}: the metric is for {key} = {stored}; the model has {actual}; compute it anew")
    equation = provenance["equation"]
    noise = None if equation["measurement_cov"] is None else jnp.asarray(equation["measurement_cov"])
    return Riccati(model, field, start, 0.25 if equation["rate"] > 0 else 0.5, noise)
