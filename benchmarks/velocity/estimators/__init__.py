"""Estimators of the benchmark: every file of this folder adds those in its list `ESTIMATORS`."""

import abc
import functools
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.velocity.cases import Case

Numbers = dict[str, float]
"""Numbers of an estimator by name."""


class Estimate(NamedTuple):
    """Velocities of an estimator.

    Attributes:
        v: Velocities (R, n) of the first R rows of a log, row k from the readings of the rows up to k only.
        std: Their standard deviations (R, n), if the estimator tells them.
        note: What the table says of it, such as the observer that was chosen.
    """

    v: Float[np.ndarray, "R n"]
    std: Float[np.ndarray, "R n"] | None = None
    note: str = ""


class AbstractEstimator(abc.ABC):
    """A causal estimator of velocities, with numbers that are searched on rows of each log.

    Attributes:
        name: Name in tables.
        knows_model: Whether it gets the model of the machine.
        source: Where it was published.
        numbers_of: Name of another estimator whose numbers it takes, instead of a search; "" for none.
    """

    name: str
    knows_model: bool = False
    source: str = ""
    numbers_of: str = ""

    def fits(self, case: Case) -> bool:
        """Whether it runs on a log; by default on those in coordinates, not on poses and attitudes."""
        return bool(case.model.manifold.commuting)

    def ranges(self, case: Case) -> dict[str, tuple[float, float]]:
        """Least and largest value, both positive, of every number that is searched; none by default."""
        return {}

    @abc.abstractmethod
    def run(self, case: Case, numbers: Sequence[Numbers], rows: Bool[np.ndarray, "T"]) -> list[Estimate]:
        """Velocities with each of several sets of numbers, of all rows up to the last one of `rows`."""

    def operations(self, case: Case, numbers: Numbers) -> int | None:
        """Operations of a step in C, if it can be written in C."""
        return None


def until(rows: Bool[np.ndarray, "T"]) -> int:
    """Number of rows up to the last one that is marked."""
    return int(np.flatnonzero(rows)[-1]) + 1


@functools.cache
def estimators() -> dict[str, AbstractEstimator]:
    """All estimators by name, those without a model first, and at last those that take the numbers of another one."""
    found: list[AbstractEstimator] = []
    for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
        found += importlib.import_module(f"{__name__}.{path.stem}").ESTIMATORS
    return {each.name: each for each in sorted(found, key=lambda each: (each.numbers_of, each.knows_model))}
