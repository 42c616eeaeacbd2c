"""Searches the numbers of an estimator on the rows of a log that tune, with the same budget for all."""

import numpy as np
from scipy.stats import qmc

from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Numbers
from benchmarks.velocity.scores import relative_error

ROUNDS = (12, 8, 4)
"""Sets of numbers that are tried in each round."""
NARROWER = 0.3
"""Width of the range of a round as a fraction of that of the round before, about its best numbers."""


def searched(estimator: AbstractEstimator, case: Case, rounds: tuple[int, ...] = ROUNDS) -> Numbers:
    """The numbers with the least velocity error on the rows that tune.

    The first round spreads its tries over the whole range of the logarithms of the numbers, the next ones about the
    best so far: evenly for one number, by a Sobol sequence for several.
    """
    ranges = estimator.ranges(case)
    if not ranges:
        return {}
    low, high = np.log(np.array(list(ranges.values()), float)).T
    best, width, tried = (low + high) / 2, high - low, {}
    for count in rounds:
        unit = (np.arange(count)[:, None] + 0.5) / count if len(low) == 1 else _sobol(len(low), count)
        points = np.clip(best + (unit - 0.5) * width, low, high)
        sets = [dict(zip(ranges, map(float, np.exp(point)), strict=True)) for point in points]
        for point, found in zip(points, estimator.run(case, sets, case.tune), strict=True):
            tried[tuple(point)] = relative_error(found.v, case.v[: len(found.v)], case.tune[: len(found.v)])
        best, width = np.array(min(tried, key=tried.__getitem__)), NARROWER * width
    return dict(zip(ranges, map(float, np.exp(best)), strict=True))


def _sobol(dimension: int, count: int) -> np.ndarray:
    return qmc.Sobol(dimension, scramble=False).random(16)[1 : count + 1]
