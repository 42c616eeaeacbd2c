"""What a user gets: `covariant tune` on the rows that tune, then `covariant estimate`, without true velocities."""

from collections.abc import Sequence

import numpy as np

import covariant
from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, until
from covariant.models import ModelFile
from covariant.signals import Record
from covariant.verbs.base.tune_to_logs import tuned_file

TUNED: dict[str, tuple[ModelFile, str]] = {}
"""Tuned model files and the observers that they name, by the checksum of the log."""


def tuned(case: Case) -> tuple[ModelFile, str]:
    """The model file after `tune`, and its default observer."""
    if case.key not in TUNED:
        part = Record(*(np.asarray(each)[: until(case.tune)] for each in case.loaded.log.record[:3]))
        lines = covariant.tune(case.loaded.file, part, anyway=True).lines
        TUNED[case.key] = tuned_file(case.loaded.file, lines), lines["design"]["observer"]
    return TUNED[case.key]


class Default(AbstractEstimator):
    """An observer of the tuned file, by default the one that it names."""

    knows_model, source = True, "`covariant tune`, then `covariant estimate`"

    def __init__(self, name: str, observer: str | None = None):
        self.name, self.observer = name, observer

    def fits(self, case: Case) -> bool:
        return True

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        file, chosen = tuned(case)
        record = Record(*map(np.asarray, case.loaded.log.record[:3]))
        result = covariant.estimate(file, record, observer=self.observer, anyway=True)
        return [Estimate(result.velocity, result.velocity_std, self.observer or chosen) for _ in numbers]


ESTIMATORS = [Default("covariant"), Default("covariant-kalman", "intrinsic-kalman")]
