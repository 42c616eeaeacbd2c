"""Rows of a log in which something pushes, by the forces that a filter estimates."""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from covariant.models import ModelFile
from covariant.workflow._outcome import Outcome, known

FALSE_ALARM = 1e-3
"""Largest probability that a row in which nothing pushes is called pushed, where model and noise are right."""
AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


class Pushes(NamedTuple):
    """Rows in which something pushes.

    The error of an estimated force is a sum of what the force itself, the noise and all other unknowns have done. Where
    there is no force its part is missing, so that the estimate then has at most the variance that the filter tells for
    its error. A row is called pushed where any force is more of these standard deviations from zero than a normal
    number is with the probability `FALSE_ALARM` over the number of forces.

    Attributes:
        names: The forces that count: those on links, or where there are none the external forces of the joints.
        rows: Whether something pushes, in each row (T,).
        starts: Rows at which it begins.

    Example:
        >>> import covariant
        >>> force = {"uncertainty.external_force_std": 1.0, "uncertainty.external_force_time": 0.3}
        >>> noise = force | {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
        >>> log = covariant.simulate("oscillator", duration=4.0, rate=100.0, noise=1e-4, push=[3.0]).record
        >>> result = covariant.estimate("oscillator", log, observer="intrinsic-kalman", overrides=noise)
        >>> result.pushes.names, result.pushes.starts.tolist(), int(result.pushes.rows.sum())
        (('external_force1',), [129, 177, 330, 376], 96)
    """

    names: tuple[str, ...]
    rows: np.ndarray
    starts: np.ndarray

    def __str__(self) -> str:
        count, share = len(self.starts), 100 * np.mean(self.rows)
        return (
            f"pushed {count} time{'s' * (count != 1)}, in {share:.3g} % of the rows; where model and noise are right, "
            f"a row without a push is called pushed at most once in {1 / FALSE_ALARM:.0f}"
        )


def force_names(file: ModelFile, names: tuple[str, ...]) -> tuple[str, ...]:
    """Which slow states are forces that push.

    Beside forces on links, an external force is what the model does not know of the joints.

    Args:
        file: The model file.
        names: Names of all slow states.
    """
    linked = {f"{axis}_{name}" for name in file.wrenches for axis in AXES}
    return tuple(name for name in names if (name in linked if linked else name.startswith("external_force")))


def pushes(file: ModelFile, outcome: Outcome) -> Pushes | None:
    """Rows in which something pushes; None of an observer that estimates no force.

    Args:
        file: The model file.
        outcome: The run of the observer.
    """
    slow, std = (known(outcome.run.info, name) for name in ("slow", "slow_std"))
    names = force_names(file, outcome.slow_names)
    if slow is None or std is None or not names:
        return None
    at = [outcome.slow_names.index(name) for name in names]
    limit = NormalDist().inv_cdf(1 - FALSE_ALARM / (2 * len(at)))
    rows = np.asarray(np.any(np.abs(slow[:, at]) > limit * std[:, at], axis=1))
    return Pushes(names, rows, np.flatnonzero(rows & ~np.concatenate([[False], rows[:-1]])))
