"""What a model file says of noise, for the design of observers: the data sheet of a machine."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from covariant.calibration import DataSheet, suggest_noise
from covariant.models import ModelFile
from covariant.observers import SlowVariables, presliding_friction, sensor_bias, uncertain_parameters, wrench
from covariant.signals import Record
from covariant.verbs.base.arguments import given_gains
from scalargraph.errors import InputError

SAME = (
    *("quantum", "external_force", "external_force_std", "external_force_time", "acceleration_std", "correlation_time"),
    *("torque_std", "motion_std", "motion_time", "damping", "natural_frequency", "force_rate"),
)
"""Fields that a model file and a data sheet have alike."""


def tells_noise(file: ModelFile) -> bool:
    """Whether a model file has the numbers of a data sheet, which a gate needs."""
    return file.measurement_std is not None and file.acceleration_std is not None


def data_sheet(file: ModelFile, record: Record | None = None) -> DataSheet:
    """Collect the data sheet for a design from a model file."""
    needed = {"measurement.std": file.typical_std, "uncertainty.acceleration": file.acceleration_std}
    missing = [key for key, value in needed.items() if value is None]
    if missing:
        raise InputError(f"{file.name}: gains need {' and '.join(missing)}; {_remedy(file, missing, record)}")
    known: dict[str, Any] = {name: getattr(file, name) for name in SAME}
    stds = file.measurement_std if isinstance(file.measurement_std, tuple) else None
    known |= {"measurement_std": file.typical_std, "coordinate_stds": stds, "slow": _slow(file)}
    known["gains_and_speed"] = tuple((given_gains(file.alpha, file.beta, file.speed_bound) or {}).values()) or None
    return DataSheet(**{name: value for name, value in known.items() if value is not None})


def _remedy(file: ModelFile, missing: Sequence[str], record: Record | None) -> str:
    """What to do where numbers of a model file are missing, with those that a log shows."""
    shown = () if record is None else suggest_noise(file, record)
    them = "it" if len(missing) == 1 else "them"
    if len(shown) < len(missing):
        options = [f"{key}=NUMBER" for key in missing]
        how = f"put {them} in the model file, or give `overrides={options}` (or, for one observer, `alpha` and `beta`)"
        return how + "".join(f"; this log suggests {suggestion.line} ({suggestion.evidence})" for suggestion in shown)
    options = [suggestion.setting for suggestion in shown]
    evidence = "; ".join(suggestion.evidence for suggestion in shown)
    how = f"or put {them} in the model file, as `covariant tune` does"
    return f"this log suggests `overrides={options}` ({evidence}), {how}"


def _slow(file: ModelFile) -> tuple[SlowVariables, ...]:
    """What the model file has estimated along with the motion, beside an external force."""
    components = ()
    if file.family is not None:
        stds = [file.uncertain_std(name) or 0.0 for name in file.family.names]
        components += (uncertain_parameters(file.family, stds, file.parameters_drift),)
    if file.bias is not None:
        components += (sensor_bias(np.broadcast_to(file.bias, file.dimension), file.bias_drift),)
    if np.any(file.presliding):
        components += (presliding_friction(file.need_mechanical(file.name, "presliding is for"), file.presliding),)
    return components + tuple(_wrench(file, name, given) for name, given in file.wrenches.items())


def _wrench(file: ModelFile, name: str, given: Mapping[str, Any]) -> SlowVariables:
    """A force on a link, which the model file names."""
    try:
        return wrench(file.need_mechanical(file.name, "[wrench] is for").space, name=name, **given)  # pyright: ignore[reportArgumentType]
    except (InputError, TypeError) as error:
        raise InputError(f"{file.name}: [wrench.{name}]: {str(error).removeprefix('wrench: ')}") from error
