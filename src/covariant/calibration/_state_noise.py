"""The noise of a state-space model from its model file."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.models import ModelFile
from covariant.observers import StateNoise
from scalargraph.errors import InputError


def state_noise(file: ModelFile, rate: float) -> StateNoise:
    """Collect the noise of a state-space model from its model file."""
    numbers = (file.measurement_std, "measurement.std"), (file.process_std, "uncertainty.process")
    missing = [key for value, key in numbers if value is None]
    if missing:
        options = [f"{key}=NUMBER" for key in missing]
        them = "it" if len(missing) == 1 else "them"
        raise InputError(
            f"{file.name}: its observers need {' and '.join(missing)}; put {them} in the model file, or give "
            f"`overrides={options}`"
        )
    states, outputs = file.dimension, len(file.columns.q)
    start, deviation = first_estimate(file)
    process, measurement = _each(file.process_std, states), _each(file.measurement_std, outputs)
    return StateNoise(jnp.diag(process**2), jnp.diag(measurement**2), start, jnp.diag(deviation**2), rate)


def first_estimate(file: ModelFile) -> tuple[jnp.ndarray, jnp.ndarray]:
    """First estimate (n,) of the states and its standard deviation (n,).

    Both are from the model file, or where it has none from the model's box: its centre, and the standard deviation of a
    uniform distribution over it.
    """
    model: Any = file.model
    low, high = np.asarray(model.box, float).T if model.box else (0.0, np.nan)
    start = (low + high) / 2 if model.box else 0.0
    start = start if file.initial_state is None else file.initial_state
    deviation = (high - low) / np.sqrt(12) if file.initial_std is None else file.initial_std
    if not np.isfinite(deviation).all():
        raise InputError(
            f"{file.name}: its observers need initial.std, how far the states may be from initial.state at first; put "
            "it in the model file, or give `overrides=['initial.std=NUMBER']`"
        )
    return _each(start, file.dimension), _each(deviation, file.dimension)


def _each(value, count: int) -> jnp.ndarray:
    return jnp.broadcast_to(jnp.asarray(value, float), (count,))
