"""Noise levels that a log shows, suggested where the model file lacks them."""

from typing import NamedTuple

import numpy as np

from covariant.calibration import diagnosis
from covariant.models import ModelFile
from covariant.signals import Record

FAINT = 0.5
"""Residual accelerations count as noise if their mean square exceeds the noise variance by less than this fraction."""


class Suggestion(NamedTuple):
    """A number for a model file, estimated from a log.

    Attributes:
        key: Table and key in the model file, such as "measurement.std".
        value: The number, or one for each coordinate.
        evidence: Source of the number, as half a sentence.

    Example:
        >>> from covariant.calibration.tuning import Suggestion
        >>> suggestion = Suggestion("measurement.std", 0.001, "the noise of the positions in the log")
        >>> suggestion.line, suggestion.setting
        ('[measurement] std = 0.001', 'measurement.std=0.001')
    """

    key: str
    value: float | tuple[float, ...]
    evidence: str

    @property
    def setting(self) -> str:
        """The number as an override, `measurement.std=0.001`."""
        return f"{self.key}={diagnosis.written(self.value)}"

    @property
    def line(self) -> str:
        """The number as it is written in a model file, `[measurement] std = 0.001`."""
        table, key = self.key.split(".")
        return f"[{table}] {key} = {diagnosis.written(self.value)}"


def suggest_noise(file: ModelFile, record: Record) -> tuple[Suggestion, ...]:
    """Suggest the noise levels that a model file lacks and a log shows.

    Use it where a new model file has no noise yet, to get numbers to start from. It changes nothing: copy the setting
    of a suggestion into the file or pass it as an override. `tune` takes longer and is more accurate.

    Args:
        file: The model file. Noise levels that it has are not suggested.
        record: The log, as it was read.

    Returns:
        At most two suggestions:

        - "measurement.quantum" where all positions are whole ticks apart, else "measurement.std", from the part of a
          reading that its neighbours do not predict;
        - "uncertainty.acceleration" [unit/s²], from the residual accelerations of the model along the smoothed log. It
          is as good as the parameters of the model: fitting these makes it smaller.

        Empty for a machine on a group. A level is left out if the log is too short, or moves too little, to show it.
        For a state-space model only the noise of its outputs can be suggested.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import suggest_noise
        >>> from covariant.models import load
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> y = 0.2 * np.cos(t) + 1e-3 * np.random.default_rng(0).normal(size=t.size)
        >>> for suggestion in suggest_noise(load("oscillator"), Record(t, np.zeros((1000, 1)), y[:, None])):
        ...     print(suggestion.setting)
        measurement.std=0.001
        uncertainty.acceleration=0.028
    """
    suggestions: list[Suggestion] = []
    if np.asarray(record.y).ndim != 2 or not (diagnosis.in_coordinates(file) or not file.mechanical):
        return ()
    record = diagnosis.busiest(record, diagnosis.MOST_ROWS)
    if file.measurement_std is None:
        suggestions += _suggest_from_readings(file, record)
    if file.acceleration_std is None and diagnosis.in_coordinates(file):
        suggestions += _suggest_from_accelerations(file, record)
    return tuple(suggestions)


def _suggest_from_readings(file: ModelFile, record: Record) -> list[Suggestion]:
    circles = file.model.circles if file.mechanical else ()  # pyright: ignore[reportAttributeAccessIssue]
    units = file.model.units if file.mechanical else ()
    units = units or ("",) * np.asarray(record.y).shape[1]
    readings_noise = diagnosis.readings(record, circles)
    if not readings_noise.known:
        return []
    if (readings_noise.ticks > 0).all():
        value = diagnosis.one_or_each(readings_noise.ticks, units, 5)
        return [Suggestion("measurement.quantum", value, "positions of the log are whole ticks apart")]
    # A constant position shows no noise, nor do rounding errors.
    if not (readings_noise.std > diagnosis.ROUNDING * np.nanmax(np.abs(np.asarray(record.y)), axis=0)).all():
        return []
    caveat = "" if readings_noise.white.all() else ", at most, since they move between the rows"
    value = diagnosis.one_or_each(readings_noise.std, units, 2)
    return [Suggestion("measurement.std", value, f"the noise of the positions in the log{caveat}")]


def _suggest_from_accelerations(file: ModelFile, record: Record) -> list[Suggestion]:
    case, _ = diagnosis.case_without_outliers(file, record)
    best = diagnosis.best_window(case)
    if best is None or not (significant := best[1].told).any():
        return []
    left = best[1]
    clear = left.squares > FAINT * left.noise**2
    size = np.where(clear, np.sqrt(np.maximum(left.squares, 0.0)), left.noise)
    value = float(f"{np.max(size[significant]):.2g}")
    if not 0 < value < np.inf:
        return []
    caveat = "" if clear[np.argmax(np.where(significant, size, 0.0))] else ", at most, since noise hides the rest"
    evidence = f"the model leaves that much of the accelerations in the log{caveat}"
    if left.misfit > diagnosis.BARELY:
        evidence += ", nearly all of them: look at its [parameters] first, `covariant check` says more"
    return [Suggestion("uncertainty.acceleration", value, evidence)]
