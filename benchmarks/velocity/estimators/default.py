"""What a user gets: `covariant tune` on the rows that tune, then `covariant estimate`, without true velocities."""

from collections.abc import Sequence

import numpy as np
from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, until

import covariant
from covariant.signals import Record
from covariant.verbs.base.tune_to_logs import tuned_file


class Default(AbstractEstimator):
    """The default observer of the tuned file."""

    name, knows_model, source = "covariant", True, "`covariant tune`, then `covariant estimate`"

    def fits(self, case: Case) -> bool:
        return True

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        count, log = until(case.tune), case.loaded.log.record
        part = Record(*(np.asarray(each)[:count] for each in log[:3]))
        file = case.loaded.file
        tuned = covariant.tune(file, part, anyway=True)
        result = covariant.estimate(tuned_file(file, tuned.lines), Record(*map(np.asarray, log[:3])), anyway=True)
        found = Estimate(result.velocity, result.velocity_std, tuned.lines["design"]["observer"])
        return [found for _ in numbers]


ESTIMATORS = [Default()]
