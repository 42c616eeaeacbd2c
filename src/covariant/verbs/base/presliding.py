"""Chooses the distance over which Coulomb friction turns, by the likelihood of a Kalman filter's innovations."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from covariant import models
from covariant.calibration import ErrorRatio
from covariant.observers import presliding_friction
from covariant.verbs.base.design import MOST_STATES
from covariant.verbs.base.outcome import Outcome
from scalargraph.errors import InputError

MULTIPLES = np.geomspace(0.3, 30.0, 7)
"""Distances that are tried first, the same for all joints, in standard deviations of a reading."""
STEPS = (1.47, 1.21, 1.1)
"""Factors by which the distance of each joint is changed then, down to about the step that still matters."""
SCALES = (0.3, 0.1)
"""Scales of the other noise that are tried: it was chosen without this state, and covers the reversals too."""
NOISE = {"acceleration": "acceleration_std", "torque": "torque_std"}
NOISE |= {key: key for key in ("external_force", "external_force_std")}
"""Fields of a model file with the noise that a scale multiplies, by their keys in [uncertainty]."""
MOST_NIS = 25.0
"""Largest normalised square of an innovation that counts: more is an outlier, and the same for all distances."""
DIGITS = 4
"""Significant digits of tuned numbers in a model file."""


def likeliest_presliding(
    file: models.ModelFile, run: Callable[[models.ModelFile], list[Outcome]], fitted: float
) -> models.ModelFile | None:
    """The model file with the distances and the noise of the likeliest innovations in the first part of each log.

    `run` runs the Kalman filter on each log. None for a model without Coulomb friction, or with so many states that
    compiling a filter takes minutes.
    """
    try:
        group = presliding_friction(file.need_mechanical(file.name, ""), 1.0)
    except InputError:
        return None
    last = [np.flatnonzero(axis)[-1] for axis in np.asarray(group.law.axes)]
    if 3 * file.dimension + len(last) > MOST_STATES:
        return None
    # Distances of joints without Coulomb friction are 0.
    joints = np.eye(file.dimension)[np.unique(last)]
    best, chosen = -np.inf, (joints.sum(axis=0) * np.asarray(file.measurement_std), 1.0)
    stages = [[(multiple, 1.0) for multiple in MULTIPLES], [(1.0, scale) for scale in SCALES]]
    stages += [[(step**joint, 1.0), (step**-joint, 1.0)] for step in STEPS for joint in joints]
    for stage in stages:
        for trial in [(chosen[0] * factor, chosen[1] * scale) for factor, scale in stage]:
            value = np.mean([_likelihood(each, fitted) for each in run(_changed(file, *trial))])
            best, chosen = (value, trial) if value > best else (best, chosen)
    return _changed(file, *chosen)


def judge_innovations(
    new: Sequence[Outcome], old: Sequence[Outcome], rows: Sequence[np.ndarray], std: Any
) -> ErrorRatio:
    """Judge two observers by their innovations in the same rows (T,) of each log, which needs no reference."""
    both = ([np.asarray(each.run.info.innovation)[at] for each, at in zip(of, rows, strict=True)] for of in (new, old))
    return ErrorRatio.of(*([np.minimum(np.mean((r / std) ** 2, axis=1), MOST_NIS) for r in each] for each in both))


def short(values: Any) -> Any:
    """A number, or several, with few digits."""
    each = [float(f"{value:.{DIGITS}g}") for value in np.ravel(values)]
    return each if len(each) > 1 else each[0]


def changed_keys(new: models.ModelFile, old: models.ModelFile) -> dict[str, Any]:
    """The keys of [uncertainty] that a choice of distances has changed."""
    fields = {"presliding": "presliding"} | NOISE
    return {key: getattr(new, field) for key, field in fields.items() if getattr(new, field) != getattr(old, field)}


def _changed(file: models.ModelFile, distances: np.ndarray, scale: float) -> models.ModelFile:
    noise = {field: value for field in NOISE.values() if scale < 1 and (value := getattr(file, field)) is not None}
    return file._replace(presliding=short(distances), **{key: short(scale * np.array(x)) for key, x in noise.items()})


def _likelihood(outcome: Outcome, fitted: float) -> float:
    """Mean log-likelihood of the innovations of a row in the first part of a run, without constants."""
    t, nis, cov = (np.asarray(each) for each in (outcome.run.t, outcome.run.info.nis, outcome.run.info.innovation_cov))
    loss = np.minimum(nis, MOST_NIS * cov.shape[1]) + np.linalg.slogdet(cov)[1]
    return -0.5 * float(np.nan_to_num(loss[t < t[0] + fitted * np.ptp(t)], nan=np.inf).mean())
