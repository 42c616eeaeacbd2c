"""The observers of the library that are compared, with the numbers that a user may choose, behind their gates."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, until
from benchmarks.velocity.estimators.differences import readings
from covariant.calibration import DataSheet, gated, tuned_estimators
from covariant.calibration.tuning._filters import even_velocity
from covariant.codegen import Recipe, program
from covariant.engine import run_logs
from covariant.observers import REGISTRY, AbstractLinearFilter, Entry
from covariant.signals import Record
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.inputs import with_sensor_delays
from covariant.verbs.base.outcome import deviations
from scalargraph import operations

COMPARED = (
    *("filtered-derivative", "savitzky-golay", "levant", "pll", "pll3", "high-gain", "joint-kalman", "tracking-loop"),
    *("ekf", "ukf", "intrinsic", "intrinsic-force", "intrinsic-kalman"),
)
"""Names of the observers."""
KEPT = ("velocity_std", "state_std", "result")
"""What is stored of each run beside the estimate."""
LARGEST_IN_C = 4
"""Largest number of velocities for which observers run in compiled C: that of a filter of many compiles for minutes."""
Ranges = dict[str, tuple[float, float]]


def gains(case: Case) -> Ranges:
    """From a tenth of the rows that tune to a fraction of a row."""
    return {"natural_frequency": (10 / np.ptp(case.t[case.tune]), 2.0 * case.loaded.rate), "damping": (0.5, 2.0)}


def gains_and_force(case: Case) -> Ranges:
    """The same with the rate at which a force is learnt."""
    return gains(case) | {"force_rate": (3 / np.ptp(case.t[case.tune]), 0.3 * case.loaded.rate)}


def acceleration(case: Case) -> Ranges:
    """Acceleration that the model leaves unexplained, independent in every sample."""
    return {"acceleration_std": (1e-3 * case.acceleration, 10 * case.acceleration)}


def acceleration_and_force(case: Case) -> Ranges:
    """The same with the size of an unknown force, and the time after which it is forgotten."""
    mass = np.asarray(case.model.space(case.model.manifold.origin()))
    force = float(np.mean(np.diag(mass))) * case.acceleration
    return acceleration(case) | {
        "external_force_std": (1e-4 * force, 3 * force),
        "external_force_time": (3 / case.loaded.rate, max(10 / case.loaded.rate, np.ptp(case.t[case.tune]))),
    }


def bandwidth(case: Case) -> Ranges:
    """From a memory of 200 samples to one of a third."""
    return {"bandwidth": (0.005 * case.loaded.rate, 3.0 * case.loaded.rate)}


def window(case: Case) -> Ranges:
    """Windows of 4 to 120 rows; degrees 2 and 3."""
    return {"window": (5.0, 120.0), "degree": (2.0, 3.99)}


def motion(case: Case) -> Ranges:
    """Size of the accelerations, and the time over which they change."""
    return {
        "motion_std": (1e-2 * case.acceleration, 1e2 * case.acceleration),
        "motion_time": (2 / case.loaded.rate, 100 / case.loaded.rate),
    }


def jerk(case: Case) -> Ranges:
    """Bound on the jerk."""
    typical = case.acceleration * case.loaded.rate
    return {"jerk": (1e-4 * typical, 10 * typical)}


RANGES: dict[str, Callable[[Case], Ranges]] = {
    "gains": gains,
    "gains and force": gains_and_force,
    "gains and speed": gains,
    "noise": acceleration,
    "noise or ticks": acceleration_and_force,
    "bandwidth": bandwidth,
    "window": window,
    "motion": motion,
    "jerk": jerk,
    "loop": bandwidth,
}
"""Numbers by what an observer is tuned by."""


class FromRegistry(AbstractEstimator):
    """An observer of the library; noise of readings is that of the model file."""

    def __init__(self, entry: Entry):
        self.entry = entry
        self.name, self.knows_model, self.source = entry.name, entry.knows_model, entry.source

    def fits(self, case: Case) -> bool:
        return self.entry.fits(case.model)

    def ranges(self, case: Case) -> Ranges:
        return RANGES[self.entry.tuned_by](case)

    def observer(self, case: Case, numbers: Numbers) -> Any:
        """The observer with some numbers, behind its gate."""
        loaded, model = case.loaded, case.model
        sheet: DataSheet = log_sheet(loaded.file, loaded)
        if self.knows_model:
            sheet = sheet._replace(correlation_time=None, external_force=None, torque_std=None, force_rate=None)
            sheet = sheet._replace(external_force_std=None, external_force_time=None)._replace(**numbers)
            made = tuned_estimators(model, loaded.file.dimension, sheet, loaded.rate, names=(self.name,))[self.name]
            return with_sensor_delays({self.name: made}, loaded)[self.name]
        made = self._bare(case, numbers)
        return made if self.entry.has_gate or sheet.speed is None else gated(made, model, sheet)

    def _bare(self, case: Case, numbers: Numbers) -> Any:
        """A filter without a model, without a gate."""
        values: list[Any] = list(numbers.values())
        if self.entry.tuned_by == "window":
            values = [max(int(values[0]), int(values[1]) + 1), int(values[1])]
        if self.entry.tuned_by == "motion":
            values.append(log_sheet(case.loaded.file, case.loaded).measurement_std)
        return self.entry.construct(case.model, *values)

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        if self.entry.tuned_by == "window" and len(numbers) > 1:  # each window would be compiled
            return [self._by_weights(case, self._bare(case, one), rows) for one in numbers]
        observers, count = [self.observer(case, one) for one in numbers], until(rows)
        engine = "c" if case.loaded.file.dimension <= LARGEST_IN_C else "jax"
        record = case.loaded.record_for(observers[0])
        record = Record(*(np.asarray(part)[:count] for part in record[:3]))
        runs, _ = run_logs(observers, record, KEPT, engine)
        found = [jax.tree.map(np.asarray, run) for run in runs]
        return [Estimate(np.asarray(case.model.sought.of(run.estimate)), deviations(run.info)) for run in found]

    def _by_weights(self, case: Case, observer: AbstractLinearFilter, rows: np.ndarray) -> Estimate:
        t, y = readings(case, rows)
        rate = case.loaded.rate
        even, v = even_velocity(np.asarray(observer.weights(rate)), rate, t, y)
        return Estimate(np.stack([np.interp(t, even, one) for one in v.T], axis=1))

    def operations(self, case: Case, numbers: Numbers) -> int | None:
        observer = self.observer(case, numbers)
        y = np.asarray(case.loaded.record_for(observer).y)[0]
        traced = program(Recipe(lambda _: observer, {}), y, case.loaded.record.u.shape[1], loops=True)
        return operations(traced.step.graph.nodes)


ESTIMATORS = [FromRegistry(entry) for name in COMPARED for entry in REGISTRY if entry.name == name]
