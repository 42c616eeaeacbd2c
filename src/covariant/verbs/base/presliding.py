"""Chooses the distance over which Coulomb friction turns, by the likelihood of a Kalman filter's innovations."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from covariant import models
from covariant.observers import presliding_friction
from covariant.signals import Run
from covariant.verbs.base.design import MOST_STATES
from covariant.verbs.base.outcome import Outcome
from scalargraph.errors import InputError

MULTIPLES = np.geomspace(0.3, 30.0, 7)
"""Distances that are tried first, the same for all joints, in standard deviations of a reading."""
STEPS = (1.47, 1.21, 1.1)
"""Factors by which the distance of each joint is changed then, down to about the step that still matters."""
SCALES = (1.0, 0.3, 0.1)
"""Scales of the other noise that are tried: it was chosen without this state, and covers the reversals too."""
NOISE = {"acceleration": "acceleration_std", "torque": "torque_std"}
NOISE |= {key: key for key in ("external_force", "external_force_std")}
"""Fields of a model file, by their keys in [uncertainty], with the noise that a scale multiplies."""
MOST_NIS = 25.0
"""Largest normalised square of a measured number that counts: more is an outlier, and the same for all distances."""
DIGITS = 4
"""Significant digits of the numbers."""


def with_uncertainty(file: models.ModelFile, numbers: dict[str, Any]) -> models.ModelFile:
    """The model file with other numbers of [uncertainty]."""
    return models.load(file, {f"uncertainty.{key}": value for key, value in numbers.items()})


def likeliest_presliding(
    file: models.ModelFile, run: Callable[[dict[str, Any]], list[Run]], fitted: float
) -> dict[str, Any]:
    """Numbers of [uncertainty] with the likeliest innovations in the first part `fitted` of each log.

    `run` runs the Kalman filter with such numbers on each log. Empty for a model without Coulomb friction, and for one
    with so many states that a filter takes minutes.
    """
    n, std = file.dimension, np.broadcast_to(np.asarray(file.measurement_std, float), file.dimension)
    try:
        group = presliding_friction(file.need_mechanical(file.name, ""), np.ones(n))
    except InputError:
        return {}
    joints = np.unique([np.flatnonzero(axis)[-1] for axis in np.asarray(group.law.axes)])
    if 2 * n + len(group.names) + n > MOST_STATES:
        return {}

    def numbers(multiples: np.ndarray, scale: float) -> dict[str, Any]:
        values = {key: getattr(file, field) for key, field in NOISE.items()}
        scaled = {key: _short(scale * np.asarray(value)) for key, value in values.items() if value and scale < 1}
        # Size and time of a force are given together.
        together = {"external_force_time": file.external_force_time} if "external_force_std" in scaled else {}
        return {"presliding": _short(multiples * std)} | scaled | together

    def likelihood(multiples: np.ndarray, scale: float) -> float:
        return float(np.mean([_likelihood(each, fitted) for each in run(numbers(multiples, scale))]))

    def better(best: tuple, *trials: tuple) -> tuple:
        return max([best, *((likelihood(*each), *each) for each in trials)], key=lambda each: each[0])

    # Distances of joints without Coulomb friction are 0.
    every = np.isin(np.arange(n), joints).astype(float)
    best = better((-np.inf,), *((multiple * every, 1.0) for multiple in MULTIPLES))
    best = better(best, *((best[1], scale) for scale in SCALES[1:]))
    for step in STEPS:
        for joint in joints:
            factors = np.where(np.arange(n) == joint, step, 1.0)
            best = better(best, (best[1] * factors, best[2]), (best[1] / factors, best[2]))
    return numbers(*best[1:])


def innovation_squares(
    new: Sequence[Outcome], old: Sequence[Outcome], rows: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Squared innovations of two observers in the same rows (T,) of each log, which no reference has to judge.

    They are relative to those of the second observer, and means over the coordinates. Outliers are left out.
    """
    squares = [[np.asarray(each.run.info.innovation) ** 2 for each in both] for both in (new, old)]
    size = np.mean(np.concatenate([each[at] for each, at in zip(squares[1], rows, strict=True)]), axis=0)
    relative = [[np.mean(each / size, axis=1) for each in both] for both in squares]
    usual = [at & (np.maximum(*pair) < MOST_NIS) for at, *pair in zip(rows, *relative, strict=True)]
    first, second = ([each[at] for each, at in zip(both, usual, strict=True)] for both in relative)
    return first, second


def _likelihood(run: Run, fitted: float) -> float:
    """Mean log-likelihood of the innovations of a row in the first part of a run, without constants."""
    t, nis, cov = (np.asarray(each) for each in (run.t, run.info.nis, run.info.innovation_cov))
    early = t < t[0] + fitted * (t[-1] - t[0])
    loss = np.minimum(nis, MOST_NIS * cov.shape[1]) + np.linalg.slogdet(cov)[1]
    return -0.5 * float(np.nan_to_num(loss[early], nan=np.inf).mean())


def _short(values: Any) -> Any:
    short = [float(f"{value:.{DIGITS}g}") for value in np.ravel(values)]
    return short if len(short) > 1 else short[0]
