"""The observer of a model file, a rate and gains: `estimate` runs it on a log, and `export` writes it."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from covariant.calibration import DataSheet, estimators, gated, tuned_estimators, tuned_state_estimators, with_gains
from covariant.models import ModelFile
from covariant.observers import AbstractObserver, Gated
from covariant.workflow._inputs import innovation_units
from covariant.workflow._states import noise

NO_NOISE = (
    "It has no gate and refuses no measurement, since the model file tells no noise: add `std` to [measurement] and "
    "`acceleration` to [uncertainty]."
)
SPEED_IS_MISSING = (
    "a machine that is faster than four times that at the start is refused. Give `log`, a log that `estimate` runs "
    "on, or add `motion_acceleration` and `motion_time`, whose product is that speed, to [uncertainty]"
)


def build_observer(
    model_name: str,
    file: ModelFile,
    name: str,
    rate: float,
    gains: tuple[float, float] | None,
    sheet: Callable[[], DataSheet],
) -> AbstractObserver:
    """Build an observer with its gate, as if its readings were never late.

    Args:
        model_name: The model, by its path or name, for messages.
        file: Its model file.
        name: Name of the observer.
        rate: Sampling rate [Hz].
        gains: Gains α [1/s] and β [1/s²] in place of the designed ones.
        sheet: Collects the data sheet of a mechanical model, with the usual speeds by which a gate judges.

    Returns:
        The observer. With given gains it has no gate if the model file tells no noise.

    Raises:
        ValueError: It does not fit the model, or the model file lacks numbers.
    """
    model: Any = file.model
    if name not in estimators(model):
        raise ValueError(f"observer {name} does not fit {model_name}; these do: {', '.join(estimators(model))}")
    if gains is not None:
        available = with_gains(model, *gains)
        if name not in available:
            known = ", ".join(available) or "none"
            raise ValueError(f"`alpha` and `beta` do not apply to {name}; they do to {known}")
        return gated(available[name], model, sheet()) if tells_noise(file) else available[name]
    if not file.mechanical:
        return tuned_state_estimators(model, noise(file, rate), (name,))[name]
    return tuned_estimators(model, file.dimension, sheet(), rate, names=(name,))[name]


def tells_noise(file: ModelFile) -> bool:
    """Whether a model file has the numbers of a data sheet, which a gate needs."""
    return file.measurement_std is not None and file.acceleration_std is not None


def without_gate(observer: AbstractObserver) -> AbstractObserver:
    """The same observer without any gate, its own and those of its sensors."""
    if isinstance(observer, Gated):
        return observer.observer
    chosen: Any = observer
    if getattr(chosen, "gate", None) is None:
        return observer
    sensors = getattr(chosen, "sensors", ())
    bare = {"sensors": tuple(dataclasses.replace(sensor, gate=None) for sensor in sensors)} if sensors else {}
    return dataclasses.replace(chosen, gate=None, **bare)


def describe_gate(observer: AbstractObserver, units: tuple[str, ...]) -> str:
    """Describe in a sentence which measurements an observer refuses; "" where it refuses none.

    Args:
        observer: The observer, not late.
        units: Units of the measured coordinates, or of the components of a displacement.
    """
    if isinstance(observer, Gated):
        noise, speed = (_with_units(value, units, per) for value, per in ((observer.noise, ""), (observer.speed, "/s")))
        return f"Its gate refuses outliers, by the noise {noise} and the usual speed {speed}."
    gate = getattr(observer, "gate", None)
    return "" if gate is None else f"Its gate refuses what is {gate.deviations:g} standard deviations off."


def explain_gate(observer: AbstractObserver, file: ModelFile, logged: bool) -> tuple[str, str]:
    """Describe the gate of an observer of a mechanical model for its export.

    Args:
        observer: The observer, not late.
        file: Its model file.
        logged: Whether the usual speed in the gate was read from a log.

    Returns:
        Sentences on the gate, or on why there is none; and a warning where its speed is assumed, otherwise "".
    """
    told = describe_gate(observer, innovation_units(file))
    if not told:
        return NO_NOISE, ""
    if not isinstance(observer, Gated):
        return told, ""
    if logged:
        return f"{told} The speed is that of the motion in a log.", ""
    if file.motion_std is not None and file.motion_time is not None:
        return f"{told} The speed is motion_acceleration times motion_time of the model file.", ""
    told += " The speed is assumed, since no log was given and the model file tells none."
    return told, f"the usual speed of the gate is assumed; {SPEED_IS_MISSING}"


def beyond_proof(lost: int) -> str:
    """What a certificate says of samples that a gate refuses, up to `lost` of which it covers in a row."""
    covered = f"which it covers up to {lost} in a row" if lost else "which it does not cover"
    return (
        "The gate is no part of what is proved. Where a step returns OK it changed nothing, and the statement holds. A "
        f"measurement that is refused as a whole (OUTLIER) is a lost one, {covered}; of one that is refused in part, "
        "and after RESTARTED or ASTRAY, nothing is proved until a new start within its radius."
    )


def _with_units(value: Any, units: tuple[str, ...], per: str) -> str:
    numbers = np.broadcast_to(value, len(units))
    return ", ".join(dict.fromkeys(f"{v:.4g} {unit}{per}".strip() for v, unit in zip(numbers, units, strict=True)))
