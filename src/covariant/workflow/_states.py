"""What `estimate` and `compare` need of state-space models: what the model file says of noise, and the observers."""

from collections.abc import Collection
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.calibration import STATE_ESTIMATORS, tuned_state_estimators
from covariant.models import ModelFile
from covariant.observers import AbstractObserver, Noise
from covariant.workflow._inputs import Loaded


def tuned_states(loaded: Loaded, names: Collection[str] = STATE_ESTIMATORS) -> dict[str, AbstractObserver]:
    """Tune observers of a state-space model to the noise in its model file.

    Args:
        loaded: Model and log.
        names: Names of the observers.

    Returns:
        The observers by name.

    Raises:
        ValueError: Where the model file lacks numbers; it names all of them.
    """
    model: Any = loaded.model
    return tuned_state_estimators(model, noise(loaded.file, loaded.rate), names)


def noise(file: ModelFile, rate: float) -> Noise:
    """Collect the noise of a state-space model from its model file.

    Args:
        file: The model file.
        rate: Sampling rate [Hz].

    Returns:
        Covariances of process and measurement, and the first estimate with its covariance.

    Raises:
        ValueError: Where the model file lacks numbers; it names all of them.
    """
    numbers = (file.measurement_std, "measurement.std"), (file.process_std, "uncertainty.process")
    missing = [key for value, key in numbers if value is None]
    if missing:
        options = [f"{key}=NUMBER" for key in missing]
        them = "it" if len(missing) == 1 else "them"
        raise ValueError(
            f"{file.name}: its observers need {' and '.join(missing)}; put {them} in the model file, or give "
            f"`overrides={options}`"
        )
    states, outputs = file.dimension, len(file.columns.q)
    start, deviation = first_estimate(file)
    return Noise(
        jnp.diag(_each(file.process_std, states) ** 2),
        jnp.diag(_each(file.measurement_std, outputs) ** 2),
        start,
        jnp.diag(deviation**2),
        rate,
    )


def first_estimate(file: ModelFile) -> tuple[jnp.ndarray, jnp.ndarray]:
    """First estimate (n,) of the states and its standard deviation (n,).

    Both are from the model file, or where it has none from the model's box: its centre, and the standard deviation of a
    uniform distribution over it.

    Raises:
        ValueError: Where neither knows the standard deviation.
    """
    model: Any = file.model
    low, high = np.asarray(model.box, float).T if model.box else (0.0, np.nan)
    start = (low + high) / 2 if model.box else 0.0
    start = start if file.initial_state is None else file.initial_state
    deviation = (high - low) / np.sqrt(12) if file.initial_std is None else file.initial_std
    if not np.isfinite(deviation).all():
        raise ValueError(
            f"{file.name}: its observers need initial.std, how far the states may be from initial.state at first; put "
            "it in the model file, or give `overrides=['initial.std=NUMBER']`"
        )
    return _each(start, file.dimension), _each(deviation, file.dimension)


def state_design_note(file: ModelFile) -> str:
    """Describe in a sentence what the observers of a state-space model are designed from.

    Args:
        file: The model file.

    Raises:
        ValueError: Where neither file nor model knows how accurate the first estimate is.
    """
    start, deviation = first_estimate(file)
    output = file.model.sought
    named = zip(output.names, start, deviation, output.units, strict=True)
    first = ", ".join(f"{name} {x:.4g} ± {std:.3g} {unit}".rstrip() for name, x, std, unit in named)
    return f"Designed from the noise in the model file; first estimate {first}."


def _each(value, count: int) -> jnp.ndarray:
    return jnp.broadcast_to(jnp.asarray(value, float), (count,))
