"""Filters that know no model and are linear: what they promise, from which they are tuned without being run."""

import abc
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._typing import Code, Vector
from covariant.observers._protocol import AbstractObserver

MOST_WEIGHTS = 8192
"""Samples that a filter with an endless memory is taken to remember, at most."""


class FilterInfo(NamedTuple):
    """`innovation`: measured minus extrapolated position, 0 where missing; `result` a `Result`."""

    innovation: Vector
    result: Code


class AbstractLinearFilter(AbstractObserver):
    """A filter of each coordinate by itself, whose velocity is a weighted sum of the positions measured so far."""

    @abc.abstractmethod
    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        """The weights [1/s], newest first, at an even sampling rate [Hz], once the filter has forgotten its start."""


def response(step: Float[np.ndarray, "k k"], gain: Float[np.ndarray, "k"]) -> Float[np.ndarray, "w"]:
    """Weights by which `x ← step x; x ← x + gain (y − x₀)` forms x₁ from the measurements y, newest first."""
    forgets = step - np.outer(gain, step[0])
    slowest = max(np.abs(np.linalg.eigvals(forgets)).max(), 1e-300)
    count = MOST_WEIGHTS if slowest >= 1 else int(np.clip(np.log(1e-10) / np.log(slowest), 4, MOST_WEIGHTS))
    columns = gain[:, None]
    while columns.shape[1] < count:
        columns = np.concatenate([columns, forgets @ columns], axis=1)
        forgets = forgets @ forgets
    return columns[1, :count]
