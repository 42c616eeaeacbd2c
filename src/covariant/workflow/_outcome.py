"""Runs an observer on a log and summarises the result."""

import math
import time
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.engine import EngineName as Engine, run_log
from covariant.models import Motion
from covariant.observers import AbstractObserver
from covariant.signals import Result, Run
from covariant.workflow._inputs import Loaded, ReferenceVelocity

KEPT = ("innovation", "distance", "result", "nis", "velocity_std", "state_std", "slow", "slow_std")
"""What the commands use of the info of an observer."""


class Score(NamedTuple):
    """How far velocities or states are from a reference: root mean square errors (n,), and NEES of a filter that knows.

    `nees` is the mean of the squared errors over their variances, for each velocity: 1 is expected.
    """

    rmse: np.ndarray
    nees: float


class Outcome(NamedTuple):
    """A run, its velocities or states (T, n), their score where there is a reference, and the compiled time a sample
    [µs].

    `nis` is the mean normalised innovation squared for each measured number, NaN for an observer without a covariance;
    1 is expected. `engine` says what computed the run, and `slow_names` what was estimated along with the motion.
    """

    run: Run
    velocity: np.ndarray
    nis: float
    score: Score | None
    microseconds: float
    engine: str = ""
    slow_names: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples with each result, by its name."""
        codes = np.bincount(np.asarray(self.run.info.result), minlength=len(Result))
        return {Result(i).name.lower(): int(count) for i, count in enumerate(codes) if count}

    @property
    def failed(self) -> bool:
        return "not_finite" in self.counts


def drive(observer: AbstractObserver, loaded: Loaded, engine: Engine = "auto", timed: bool = False) -> Outcome:
    """Run an observer on the loaded record; `timed` runs it again, to measure its time without compilation."""
    done, by = run_log(observer, loaded.record, KEPT, engine)
    done = jax.block_until_ready(done)
    spent = float("inf")
    for _ in range(3 if timed else 0):  # the quickest of three, since other load only lengthens a run
        began = time.perf_counter()
        jax.block_until_ready(run_log(observer, loaded.record, KEPT, "c" if by == "c" else "jax")[0])
        spent = min(spent, time.perf_counter() - began)
    velocity = np.asarray(loaded.model.sought.of(done.estimate))
    score = None if loaded.reference is None else _score(velocity, done.info, loaded.reference)
    each = 1e6 * spent / len(done.t) if timed else math.nan
    named = getattr(getattr(observer, "observer", observer), "slow_names", ())
    return Outcome(done, velocity, _nis(done.info, loaded), score, each, by, named)


def engine_is_notable(by: str, asked: Engine) -> bool:
    """Whether a person is told which engine worked: where one was asked for, and where C could not do the work."""
    return asked != "auto" or not (by == "c" or by.startswith("jax: fewer than"))


def known(info: Any, name: str) -> np.ndarray | None:
    """A field of an observer's info, or None where it has no such field."""
    return np.asarray(getattr(info, name)) if name in info._fields else None


def deviations(info: Any) -> np.ndarray | None:
    """Standard deviations of velocities or states that a filter knows of its own; None for another observer."""
    found = [known(info, name) for name in ("velocity_std", "state_std")]
    return next((std for std in found if std is not None), None)


def _score(velocity: np.ndarray, info: Any, reference: ReferenceVelocity) -> Score:
    off = velocity[reference.scored] - reference.v[reference.scored]
    std = deviations(info)
    nees = math.nan if std is None else float(np.mean((off / std[reference.scored]) ** 2))
    return Score(np.sqrt(np.mean(off**2, axis=0)), nees)


def _nis(info: Any, loaded: Loaded) -> float:
    """Refused measurements are left out, and so is the first, from which the state starts."""
    nis = known(info, "nis")
    if nis is None:
        return math.nan
    measured = ~np.asarray(jax.vmap(loaded.model.manifold.missing)(jnp.asarray(loaded.record.y)))
    taken = np.asarray(info.result) < Result.OUTLIER
    taken[0] = False
    count = measured[taken].sum()
    return float(nis[taken].sum() / count) if count else math.nan


def summary(outcome: Outcome, what: str = "velocity") -> dict[str, Any]:
    """The numbers of an outcome as JSON data, with the error of what is estimated."""
    innovation = np.asarray(outcome.run.info.innovation)
    scored = {} if outcome.score is None else {f"{what}_rmse": rounded(outcome.score.rmse)}
    found = {"nis": outcome.nis} | ({} if outcome.score is None else {"nees": outcome.score.nees})
    return {
        **scored,
        "innovation_rms": rounded(np.sqrt(np.mean(innovation**2, axis=0))),
        **{name: rounded(np.array([value]))[0] for name, value in found.items()},
        "results": outcome.counts,
    }


def rounded(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values)]


def with_units(values: Iterable[float | None], units: tuple[str, ...]) -> str:
    """Numbers in one line, each with its unit; a dash where there is none."""
    written = (
        "—" if v is None else f"{v:.4g} {unit}".removesuffix(" 1").rstrip()
        for v, unit in zip(values, units, strict=True)
    )
    return ", ".join(written)


def report_curves(outcomes: dict[str, Outcome]) -> dict[str, Any]:
    """The curves of several outcomes, as fields of `report.EstimateReport`."""
    infos = {name: outcome.run.info for name, outcome in outcomes.items()}
    return {
        "estimates": {name: _drawn(outcome) for name, outcome in outcomes.items()},
        "innovation": {name: np.asarray(info.innovation) for name, info in infos.items()},
        "distance": {name: np.asarray(info.distance) for name, info in infos.items() if "distance" in info._fields},
    }


def _drawn(outcome: Outcome) -> np.ndarray:
    """The curves to draw: states in coordinates (T, 2n), velocities (T, n) where the estimate is on a group."""
    x = outcome.run.estimate
    return outcome.velocity if isinstance(x, Motion) else np.asarray(x)
