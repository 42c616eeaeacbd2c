"""Defines linear filters without a model by their weights, from which they are tuned without being run."""

import abc
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._typing import Code, Vector
from covariant.observers.base import AbstractObserver

MOST_WEIGHTS = 8192
"""Largest number of weights: the memory of a recursive filter is cut off after this many samples."""


class FilterInfo(NamedTuple):
    """Diagnostics of a step of a filter without a model.

    Attributes:
        innovation: Measured minus extrapolated position (n,) [rad or m], 0 where it is missing.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> pll = observers.PLL(bandwidth=20.0)
        >>> record = Record(np.array([0.0, 0.01]), y=np.array([[0.0], [0.1]]))
        >>> run = observers.run(pll, record)
        >>> run.info.innovation[1].tolist(), run.info.result[1].item()
        ([0.1], 0)
    """

    innovation: Vector
    result: Code


class AbstractLinearFilter(AbstractObserver):
    """A filter that treats each coordinate separately; its velocity is a weighted sum of the positions so far.

    A subclass adds `weights` to the algorithm of an observer, so that `calibration` can compute the error of its
    velocity without running it.

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> filters = [observers.SavitzkyGolay(window=5), observers.PLL(bandwidth=20.0), observers.Levant(jerk=1.0)]
        >>> [isinstance(f, observers.AbstractLinearFilter) for f in filters]
        [True, True, False]
        >>> weights = filters[0].weights(rate=100.0)
        >>> position = 3.0 * np.arange(0, -5, -1) / 100.0  # 3 rad/s, newest first
        >>> round(float(weights @ position), 6)
        3.0
    """

    @abc.abstractmethod
    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        """Weights of the measured positions in the velocity, in the steady state of even sampling.

        Args:
            rate: Sampling rate [Hz].

        Returns:
            Weights (k,) [1/s], newest first.
        """


def response(step: Float[np.ndarray, "k k"], gain: Float[np.ndarray, "k"]) -> Float[np.ndarray, "w"]:
    """Weights of a recursive filter, with which the measurements y enter its velocity x₁.

    The filter is `x ← step x; x ← x + gain (y − x₀)`. Its weights are its impulse response, cut off when the slowest
    pole has decayed to 1e-10, or at `MOST_WEIGHTS`.
    """
    closed_loop = step - np.outer(gain, step[0])
    # At least 1e-300, so that the logarithm is finite if all poles are zero.
    slowest = max(np.abs(np.linalg.eigvals(closed_loop)).max(), 1e-300)
    count = MOST_WEIGHTS if slowest >= 1 else int(np.clip(np.log(1e-10) / np.log(slowest), 4, MOST_WEIGHTS))
    columns = gain[:, None]
    # By doubling: a power of the loop maps the first k responses to the next k.
    while columns.shape[1] < count:
        columns = np.concatenate([columns, closed_loop @ columns], axis=1)
        closed_loop = closed_loop @ closed_loop
    return columns[1, :count]
