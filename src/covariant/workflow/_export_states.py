"""`export` of state-space models: their observers, as the model file tells their noise."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from covariant._integrate import rk4
from covariant.calibration import STATE_ESTIMATORS, stored_observer
from covariant.codegen import ROWS
from covariant.models import ModelFile
from covariant.observers import AbstractObserver
from covariant.workflow._chosen import build_observer, describe_gate, without_gate
from covariant.workflow._exported import UNGATED, Exported
from covariant.workflow._inputs import data_sheet
from covariant.workflow._states import first_estimate, state_design_note


def state_observer(
    name: str,
    file: ModelFile,
    observer: str | None,
    gains: tuple[float, float] | None,
    rate: float,
    certificate: str | Path | None,
    metric: str | Path | None,
    gate: bool,
) -> Exported:
    """Build an observer of a state-space model for export.

    Args:
        name: The model, by its path or name, for messages.
        file: The model file.
        observer: Name of the observer; by default the first of `STATE_ESTIMATORS`.
        gains: For mechanical models only.
        rate: Sampling rate [Hz].
        certificate: For mechanical models only.
        metric: A metric on a grid that `riccati` looks up; by default it is computed at run time.
        gate: Whether the gate of the observer is written.

    Returns:
        The observer, with measurements for its self-test.

    Raises:
        ValueError: For an argument that is for mechanical models, or for another observer.
    """
    kind = observer or STATE_ESTIMATORS[0]
    if kind not in STATE_ESTIMATORS:
        raise ValueError(f"observer {kind} does not fit {name}; these do: {', '.join(STATE_ESTIMATORS)}")
    if gains is not None:
        raise ValueError(f"alpha and beta are for mechanical models; {name} is a state-space model")
    if certificate is not None:
        raise ValueError(f"certificate is for mechanical models; {name} is a state-space model")
    if metric is not None and kind != "riccati":
        raise ValueError(f"metric is for the observer riccati; {kind} has no metric")
    if float(np.max(file.delay)) > 0:
        raise ValueError(f"{name}: code for a state-space model takes no measurement.delay; leave it out")
    model: Any = file.model
    start, _ = first_estimate(file)
    if metric is None:
        chosen = build_observer(name, file, kind, rate, None, lambda: data_sheet(file))
        design = state_design_note(file).replace("±", "+-")
    else:
        chosen = stored_observer(model, metric, start)
        design = f"Its metric is that of {Path(metric).name}; none is outside its grid."
    told = describe_gate(chosen, ()) or "It has no gate, on a log either, and refuses no measurement."
    chosen, told = (chosen, told) if gate else (without_gate(chosen), UNGATED)
    return Exported(kind, chosen, design, _outputs(model, start, rate), told)


def _outputs(model: Any, start: jnp.ndarray, rate: float) -> np.ndarray:
    """Outputs (ROWS + 1, p) of the model that starts at the first estimate, without inputs."""
    u, dt = jnp.zeros(model.inputs), 1 / rate

    def step(x, t):
        return rk4(lambda s, x: model.f(s, x, u), t, x, dt, 1), model.h(t, x, u)

    return np.asarray(jax.lax.scan(step, start, jnp.arange(ROWS + 1.0) * dt)[1])


def with_fixed_steps(observer: AbstractObserver, y: np.ndarray, rate: float) -> AbstractObserver:
    """Fix the number of substeps of an observer to the most that it takes on some measurements.

    Args:
        observer: An observer of a state-space model.
        y: Measurements (T, p).
        rate: Sampling rate [Hz].

    Returns:
        The observer; unchanged where its substeps are fixed already.
    """
    chosen: Any = observer
    if chosen.substeps is not None:
        return observer
    u, dt = jnp.zeros(chosen.model.inputs), jnp.asarray(1 / rate)

    def step(state, measured):
        return chosen.step(state, u, measured, dt)[0], chosen.needed_substeps(state, u, dt)

    counts = jax.lax.scan(step, chosen.init(jnp.asarray(y[0]), 0.0), jnp.asarray(y[1:]))[1]
    return dataclasses.replace(chosen, substeps=int(counts.max()))
