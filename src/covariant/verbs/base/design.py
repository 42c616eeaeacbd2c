"""The observer of a model file: one place decides its gains, its gate, its sensors and its substeps."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant.calibration import (
    DataSheet,
    estimators,
    first_estimate,
    gated,
    missing_inputs,
    stored_observer,
    usual_speeds,
    with_gains,
)
from covariant.certificates import any_configuration
from covariant.models import ModelFile, input_count
from covariant.observers import REGISTRY, AbstractObserver, Gate, Gated, chooses_substeps, with_fixed_substeps
from covariant.verbs.base.arguments import GAINS, Amounts, given_gains, numbers
from covariant.verbs.base.inputs import Loaded, numbered, tells_noise
from covariant.verbs.base.kinds import WITH_FORCE, kind_of
from covariant.verbs.base.sensors import FileSensor, file_sensors, with_readings
from covariant.verbs.base.sheet import data_sheet
from scalargraph.errors import InputError

SPEED_IS_MISSING = (
    "a machine that is faster than four times that at the start is refused. Give `log`, a log that `estimate` runs "
    "on, or add `motion_acceleration` and `motion_time`, whose product is that speed, to [uncertainty]"
)


OF_FILE = {entry.name for entry in REGISTRY if entry.tuned_by == "gains and speed"}
"""Observers whose gains a model file may have."""
MOST_STATES = 16
"""Largest number of states, with two for each input, up to which a filter has states for missing inputs: the work grows
as its cube, and C of 28 states is compiled for many minutes."""


class Design(NamedTuple):
    """An observer of a model file.

    Attributes:
        file: The model file.
        name: Name of the observer.
        observer: The observer, behind its gate, as if its readings were never late.
        notes: A sentence on its gains, its noise or its metric.
        sheet: Collects the data sheet that it is designed from, with the usual speeds by which its gate judges.
        log: The log that was read with the model, if any.
    """

    file: ModelFile
    name: str
    observer: AbstractObserver
    notes: str
    sheet: Callable[[], DataSheet]
    log: Loaded | None

    @property
    def inner(self) -> Any:
        """The observer behind the gate, which has the gains and of which a certificate is."""
        return self.observer.observer if isinstance(self.observer, Gated) else self.observer

    def without_gate(self) -> "Design":
        """The same observer without any gate, its own and those of its sensors."""
        observer: Any = self.inner
        if observer.gate is not None:
            sensors = observer.sensors
            bare = {"sensors": tuple(dataclasses.replace(sensor, gate=None) for sensor in sensors)} if sensors else {}
            observer = dataclasses.replace(observer, gate=None, **bare)
        return self._replace(observer=observer)

    def with_substeps_for(self, velocity: Amounts, step: float) -> Any:
        """Give the observer without its gate as many substeps as motions up to a velocity (n,) need in one step [s]."""
        if not chooses_substeps(self.inner):
            return self.inner
        model: Any = self.file.model
        q = jnp.asarray(any_configuration(model))
        v = jnp.broadcast_to(jnp.asarray(velocity, float), self.file.dimension)
        u = jnp.zeros((2, input_count(model, self.file.dimension)))
        return with_fixed_substeps(self.inner, 1 / step, jnp.stack([q, q]), jnp.stack([v, -v]), u)

    def self_test(self, rate: float) -> np.ndarray:
        """Measurements (T, *n) for a self-test at a rate [Hz]; a gate has to refuse one of them."""
        judged = self.observer.gate is not None
        y = kind_of(self.file).self_test(rate, self.sheet if judged else None)
        return with_readings(self.file, self.sensors, y) if self.observer.sensors else y

    @property
    def sensors(self) -> tuple[FileSensor, ...]:
        """The sensors of the model file, without those that the log has no columns of."""
        return log_sensors(self.file, self.log)

    @property
    def units(self) -> dict[str, str]:
        """Units of the numbers of the gate, if it is one that has some."""
        if not isinstance(self.observer, Gated):
            return {}
        return {key: ", ".join(dict.fromkeys(units)) for key, units in self._gate_units.items()}

    @property
    def _gate_units(self) -> dict[str, tuple[str, ...]]:
        units = kind_of(self.file).measured.units
        return {"noise": units, "speed": tuple(f"{unit}/s" for unit in units)}

    def explain_gate(self) -> tuple[str, str]:
        """Sentences on what the gate refuses, or on why there is none; and a warning if its speed is assumed."""
        gate, kind = self.observer, kind_of(self.file)
        if not isinstance(gate, Gated):
            own: Gate | None = gate.gate
            refused = "" if own is None else f"Its gate refuses what is {own.deviations:g} standard deviations off."
            return refused or kind.without_gate, ""
        noise, speed = (_with_units(getattr(gate, key), units) for key, units in self._gate_units.items())
        text = f"Its gate refuses outliers, by the noise {noise} and the usual speed {speed}."
        if self.log is not None:
            return f"{text} The speed is that of the motion in a log.", ""
        if self.file.motion_std is not None and self.file.motion_time is not None:
            return f"{text} The speed is motion_acceleration times motion_time of the model file.", ""
        text += " The speed is assumed, since no log was given and the model file tells none."
        return text, f"the usual speed of the gate is assumed; {SPEED_IS_MISSING}"


def design(
    file: ModelFile,
    name: str | None = None,
    gains: dict[str, Any] | None = None,
    rate: float | None = None,
    log: Loaded | None = None,
    *,
    metric: str | Path | None = None,
    spec: str | None = None,
) -> Design:
    """Design the observer of a model file: the same one for every verb."""
    model: Any = file.model
    fitting = estimators(model)
    name, spec = name or default_observer(file, gains), spec or file.name
    if name not in fitting:
        raise InputError(f"observer {name} does not fit {spec}; these do: {', '.join(fitting)}")
    sheet = functools.cache(lambda: log_sheet(file, log))
    if metric is not None:
        if name != "riccati":
            raise InputError(f"`metric` is for the observer riccati; {name} has no metric")
        notes = f"Its metric is that of {Path(metric).name}; none is outside its grid."
        return Design(file, name, stored_observer(model, metric, first_estimate(file)[0]), notes, sheet, log)
    gains = gains or (given_gains(file.alpha, file.beta, file.speed_bound) if name in OF_FILE else None)
    if gains is not None:
        available = _observers_with(file, gains)
        if name not in available:
            known = ", ".join(available)
            known = f"they do to {known}" if known else "`alpha` and `beta` are for mechanical models"
            about = (
                f"observer {name} does not fit {spec} with constant gains: `alpha` and `beta` do not apply to {name}"
            )
            raise InputError(f"{about}; {known}")
        observer = gated(available[name], model, sheet()) if tells_noise(file) else available[name]
        given = (f"{key} = {', '.join(f'{x:g}' for x in np.ravel(value))} {GAINS[key]}" for key, value in gains.items())
        notes = f"Given gains: {', '.join(given)}."
        return Design(file, name, observer, notes, sheet, log)
    if rate is None:
        sheet()  # first names the numbers that the model file lacks, if any
        raise InputError("gains are designed for a sampling rate; give `sampling` [Hz], or `alpha` and `beta`")
    kind = kind_of(file)
    return Design(file, name, kind.tuned(sheet, rate, (name,))[name], kind.note(sheet, rate, name), sheet, log)


def _observers_with(file: ModelFile, gains: dict[str, Any]) -> dict[str, AbstractObserver]:
    """The observers of a model file that take these gains, one for all coordinates or one each."""
    model: Any = file.model
    for key, value in gains.items():
        numbers(key, value, model.velocities or numbered("q", file.dimension), one=True)
    return with_gains(model, **gains)


def default_observer(file: ModelFile, gains: dict[str, Any] | None = None) -> str:
    """Name of the observer of a model file where none is asked for: that which it chooses, or one that learns a force.

    With given gains it is the first that takes them. A natural frequency without a rate at which a force is learnt is
    that of an observer without a force.
    """
    told = file.force_rate
    if told is None and file.natural_frequency is None:
        told = file.external_force_time
    fitting = estimators(file.model)
    if gains is not None:
        return next(iter(_observers_with(file, gains)), fitting[0])
    wanted = file.observer or (WITH_FORCE if told else "")
    return wanted if wanted in fitting else fitting[0]


def runs_otherwise(file: ModelFile, observer: str) -> str:
    """A sentence if `estimate` and `export` run another observer of a model file than the first that fits; else ""."""
    default = default_observer(file)
    if default in (observer, estimators(file.model)[0]):
        return ""
    return f" Of this file `estimate` and `export` run {default} unless they are asked for `observer={observer!r}`."


def log_sensors(file: ModelFile, log: Loaded | None) -> tuple[FileSensor, ...]:
    """The sensors of a model file, without those that a log has no columns of."""
    known = None if log is None else {part.sensor.name for part in log.sensors}
    return tuple(part for part in file_sensors(file) if known is None or part.sensor.name in known)


def widens(file: ModelFile, log: Loaded) -> bool:
    """Whether `intrinsic_kalman` has states for inputs that are missing: of large models they would take minutes."""
    return file.mechanical and 2 * (file.dimension + np.asarray(log.record.u).shape[1]) <= MOST_STATES


def log_sheet(file: ModelFile, log: Loaded | None) -> DataSheet:
    """The data sheet of a model file, with its sensors, and the usual speeds in a log, zero where there is none."""
    speed = (0.0,) * file.dimension if log is None else usual_speeds(log.model, log.record)
    sheet = data_sheet(file, None if log is None else log.log.record)
    inputs = missing_inputs(log.record) if log is not None and widens(file, log) else None
    return sheet._replace(speed=speed, sensors=tuple(part.sensor for part in log_sensors(file, log)), inputs=inputs)


def _with_units(values: Any, units: tuple[str, ...]) -> str:
    numbers = np.broadcast_to(values, len(units))
    return ", ".join(dict.fromkeys(f"{v:.4g} {unit}".strip() for v, unit in zip(numbers, units, strict=True)))
