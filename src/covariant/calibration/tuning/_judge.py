"""Which of two estimates is better, and by how much: the ratio of their errors, with an interval.

The ratio is that of root mean squares over the judged rows. Errors of neighbouring rows are alike, so the rows are
divided into blocks, and it is the blocks that scatter. Each block gets a random weight, as if it were met more or less
often later on, and the interval holds 75 % of the ratios of the weighted errors. No weight is zero: a burst of errors
in a single block, which resampling would miss in a third of its draws, widens the interval to one side only.

Source: Rubin 1981, The Bayesian bootstrap, Annals of Statistics 9(1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

BLOCKS, SHORTEST, FEWEST = 20, 3, 5
"""Number of blocks of all rows together, the least number of rows of one, and that of blocks."""
DRAWS, TAIL = 4000, 0.125
"""Number of drawn sets of weights, and the part of their ratios that is left out at each end."""


Velocities = Sequence[Float[np.ndarray, "_ n"]]
"""Velocities (R, n) in the judged rows of each log."""


class ErrorRatio(NamedTuple):
    """Errors of two velocity estimates on the same rows, and the interval of their ratio.

    Attributes:
        error: Root mean square error of the first one, in the units of the root of `of`'s squares.
        other: That of the second one.
        low: Lower end of the interval of `error / other`.
        high: Its upper end.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import ErrorRatio
        >>> random = np.random.default_rng(0)
        >>> exact, coarse = (scale * random.normal(size=1000) ** 2 for scale in (1.0, 9.0))
        >>> verdict = ErrorRatio.of([exact], [coarse])
        >>> verdict.is_better, verdict.is_worse, round(verdict.error / verdict.other, 1)
        (True, False, 0.3)
    """

    error: float
    other: float
    low: float
    high: float

    @classmethod
    def of(cls, squares: Sequence[Float[np.ndarray, "_"]], others: Sequence[Float[np.ndarray, "_"]]) -> "ErrorRatio":
        """Judge the squared errors of two estimates in the same rows of each of several logs.

        Args:
            squares: Squared errors of the first estimate by log; those of several coordinates are averaged before.
            others: Those of the second one.

        Returns:
            The errors and the interval. Of fewer than `FEWEST` blocks the interval is everything.
        """
        count = sum(map(len, squares))
        size = max(SHORTEST, -(-count // BLOCKS))

        def sums(each: Sequence[Float[np.ndarray, "_"]]) -> Float[np.ndarray, "K"]:
            return np.array([part.sum() for one in each for part in np.array_split(one, max(1, len(one) // size))])

        first, second = sums(squares), sums(others)
        error, other = (float(np.sqrt(each.sum() / max(count, 1))) for each in (first, second))
        if len(first) < FEWEST:
            return cls(error, other, 0.0, np.inf)
        # With a shape of 1 − 2/K a weighted mean scatters as that of K blocks does; a little less makes up for squares,
        # whose distribution is skew.
        weights = np.random.default_rng(0).gamma(1 - 4 / len(first), size=(DRAWS, len(first)))
        tiny = np.finfo(float).tiny
        ratios = np.sqrt((weights @ first + tiny) / (weights @ second + tiny))
        return cls(error, other, *map(float, np.quantile(ratios, (TAIL, 1 - TAIL))))

    @classmethod
    def of_velocities(cls, velocities: Velocities, others: Velocities, true: Velocities) -> "ErrorRatio":
        """Judge velocities in the same rows of each of several logs, their errors as parts of the velocity.

        Args:
            velocities: Velocities (R, n) of the first estimate, by log.
            others: Those of the second one.
            true: The true velocities, or those of a reference.

        Returns:
            The errors, root mean square over the coordinates too, and the interval.
        """
        squares = ([relative_squares(*pair) for pair in zip(each, true, strict=True)] for each in (velocities, others))
        return cls.of(*squares)

    @property
    def is_better(self) -> bool:
        """Whether the first estimate is clearly better."""
        return self.high < 1

    @property
    def is_worse(self) -> bool:
        """Whether the first estimate is clearly worse."""
        return self.low > 1


def relative_squares(v: Float[np.ndarray, "R n"], true: Float[np.ndarray, "R n"]) -> Float[np.ndarray, "R"]:
    """Squared errors of velocities as parts of the velocity, means over the coordinates; infinite where not finite."""
    # The floor is for a coordinate that stands still: its error then counts as infinite, unless it is zero.
    size = np.maximum(np.sum(true**2, axis=0) / max(len(true), 1), np.finfo(float).tiny)
    return np.nan_to_num(np.mean((v - true) ** 2 / size, axis=1), nan=np.inf)
