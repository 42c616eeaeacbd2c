"""Velocities of the observer that converges from anywhere, with proved gains, on simulated twins of the benchmark.

Run `PYTHONPATH=. python benchmarks/proved_arms.py` from the repository's root: a minute. The bound of the speeds is 1.1
times the largest in each log. Errors of the others are those in `benchmarks/velocity/results.json`.
"""

import json
from collections.abc import Sequence

import jax
import numpy as np

from benchmarks.velocity.cases import HERE, Case, case, entries
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, until
from benchmarks.velocity.scores import relative_error
from benchmarks.velocity.search import searched
from covariant.certificates import certify_globally
from covariant.engine import run_logs
from covariant.observers import MeasuredCoefficients
from covariant.signals import Record

LOGS = "double pendulum, pushed", "triple pendulum, unknown friction", "acrobot", "passive elbow"
OTHERS = "intrinsic", "intrinsic-kalman"
MARGIN = 1.1
"""Bound of the speeds, as a multiple of the largest in a log."""


class Proved(AbstractEstimator):
    """The observer with one ω and one damping ratio for all joints, from the least ω that is proved upwards."""

    name, knows_model = "measured-coefficients", True

    def __init__(self, speed: np.ndarray, least: float):
        self.speed, self.least = speed, least

    def ranges(self, case: Case) -> dict[str, tuple[float, float]]:
        return {"natural_frequency": (self.least, 0.99 * case.loaded.rate), "damping": (0.6, 1.5)}

    def observer(self, case: Case, numbers: Numbers) -> MeasuredCoefficients:
        omega = numbers["natural_frequency"]
        return MeasuredCoefficients(case.model, 2 * numbers["damping"] * omega, omega**2, self.speed)

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        return [Estimate(v) for v in follow(case, [self.observer(case, one) for one in numbers], until(rows))]


def follow(log: Case, observers: list[MeasuredCoefficients], count: int) -> list[np.ndarray]:
    """Velocities of the first rows of a log."""
    record = Record(*(np.asarray(part)[:count] for part in log.loaded.record_for(observers[0])[:3]))
    return [np.asarray(log.model.sought.of(run.estimate)) for run in run_logs(observers, record)[0]]


def compare(log: Case, known: dict) -> str:
    """A row of the table."""
    speed, spans = MARGIN * np.nanmax(np.abs(log.v), axis=0), np.diff(log.t)
    ends, bounds = np.full(len(speed), np.pi), {"velocity": speed, "interval": (spans.min(), spans.max())}
    bounds["position"] = -ends, ends
    least = certify_globally(log.model, **bounds)
    assert least.statement.proved
    estimator = Proved(speed, float(least.document.omega.max()))
    best = estimator.observer(log, searched(estimator, log))
    proved = certify_globally(best, **bounds).statement.proved
    found = [
        relative_error(v, log.v, log.judge) for (v,) in (follow(log, [o], len(log.t)) for o in (least.observer, best))
    ]
    rivals = {name: row["error"] for name, row in known.items() if not row["knows_model"]}
    name = min(rivals, key=rivals.__getitem__)
    omega = f"{least.document.omega.min():.0f} to {least.document.omega.max():.0f}"
    cells = [log.name, omega, *(f"{100 * x:.3g} %" for x in found), f"{float(best.beta) ** 0.5:.0f}"]
    cells[3] += "" if proved else " (not proved)"
    cells += [f"{100 * known[other]['error']:.3g} %" for other in OTHERS] + [f"{name} {100 * rivals[name]:.3g} %"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    known = {one["log"]: one["estimators"] for one in json.loads((HERE / "results.json").read_text(encoding="utf-8"))}
    print(
        "| log | least ω [1/s] | error | of searched gains | their ω | intrinsic | intrinsic-kalman | without a model |"
    )
    for name in LOGS:
        log = case(entries()[name])
        assert log is not None
        print(compare(log, known[name]), flush=True)


if __name__ == "__main__":
    main()
