"""Runs an observer on a log and summarises the result."""

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from covariant import scoring
from covariant.cli._job import Loaded
from covariant.observers import AbstractObserver, run
from covariant.signals import Result, Run


class Outcome(NamedTuple):
    """A run, its velocities (T, n), their error (n,) where scored, and the compiled time for each sample [µs]."""

    run: Run
    velocity: np.ndarray
    velocity_rmse: np.ndarray
    microseconds: float

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples with each result, by its name."""
        codes = np.bincount(np.asarray(self.run.info.result), minlength=len(Result))
        return {Result(i).name.lower(): int(count) for i, count in enumerate(codes) if count}

    @property
    def failed(self) -> bool:
        return "not_finite" in self.counts


def drive(observer: AbstractObserver, loaded: Loaded, timed: bool = False) -> Outcome:
    """Run an observer on the loaded record; `timed` runs it again, to measure its time without compilation."""
    done = jax.block_until_ready(run(observer, loaded.record))
    spent = float("inf")
    for _ in range(3 if timed else 0):  # the quickest of three, since other load only lengthens a run
        began = time.perf_counter()
        jax.block_until_ready(run(observer, loaded.record))
        spent = min(spent, time.perf_counter() - began)
    velocity = np.asarray(loaded.model.motion(done.estimate).v)
    error = scoring.rmse(velocity[loaded.scored], loaded.reference[loaded.scored])
    return Outcome(done, velocity, error, 1e6 * spent / len(done.t) if timed else float("nan"))


def summary(outcome: Outcome) -> dict[str, Any]:
    """The numbers of an outcome as JSON data."""
    innovation = np.asarray(outcome.run.info.innovation)
    return {
        "velocity_rmse": rounded(outcome.velocity_rmse),
        "innovation_rms": rounded(np.sqrt(np.mean(innovation**2, axis=0))),
        "results": outcome.counts,
    }


def rounded(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values)]


def report_arrays(outcomes: dict[str, Outcome]) -> dict[str, Any]:
    """The curves of several outcomes, as fields of `report.EstimateReport`."""
    infos = {name: outcome.run.info for name, outcome in outcomes.items()}
    return {
        "estimates": {name: _drawn(outcome) for name, outcome in outcomes.items()},
        "innovation": {name: np.asarray(info.innovation) for name, info in infos.items()},
        "distance": {
            name: np.asarray(info.distance) for name, info in infos.items() if "distance" in type(info)._fields
        },
    }


def _drawn(outcome: Outcome) -> np.ndarray:
    """The curves to draw: states in coordinates, otherwise velocities."""
    x = outcome.run.estimate
    return np.asarray(x) if isinstance(x, jax.Array) else outcome.velocity
