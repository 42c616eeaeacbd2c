"""Runs an observer on a log, and says what the run shows: errors, consistency, pushes, a model that does not fit."""

import math
import time
from collections.abc import Iterable, Mapping
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.engine import EngineName as Engine, run_log
from covariant.models import ModelFile
from covariant.observers import AbstractObserver
from covariant.observers.base import Diagnostics
from covariant.scoring import SETTLED
from covariant.signals import Run, StepCode
from covariant.verbs.base.inputs import INFORMED, Job, Loaded, numbered
from covariant.verbs.base.model_text import advice

KEPT = (
    *("innovation", "innovation_cov", "distance", "result", "nis", "noise_scale", "sensors"),
    *("velocity_std", "state_std", "slow", "slow_std"),
)
"""What the commands use of the info of an observer."""
MARGIN = 2.0
"""How far above the band of a right model the mean NIS is before it is called too large: noise is seldom known well."""
LARGE, SMALL = 3.0, 0.1
"""Mean NEES that is called too large, and mean NEES or NIS that is called too small: noise is seldom known well, and is
rather told too large than too small."""
QUANTILE = 3.09
"""Upper 99.9 % quantile of a standard normal distribution."""
FALSE_ALARM = 1e-3
"""Largest probability that a row in which nothing pushes is called pushed, where model and noise are right."""
AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


def slow_units(loaded: Loaded) -> dict[str, str]:
    """Units of the forces that are estimated along with the motion, by their names; other numbers have none here."""
    units = dict(zip(numbered("external_force", loaded.file.dimension), loaded.kind.force_units, strict=False))
    return units | {
        f"{axis}_{link}": "N" if axis[0] == "f" else "N m" for axis in AXES for link in loaded.file.wrenches
    }


class Score(NamedTuple):
    """Errors of velocities or states against a reference.

    Attributes:
        rmse: Root mean square errors (n,), in the units of what is estimated.
        nees: Normalised estimation error squared: mean of the squared errors over their variances, for each velocity. 1
            is expected; NaN for an observer without a covariance.
        median: Medians (n,) of the absolute errors.
        apart: The same without the rows in and after holes of the log; None where it has none.
        holes: The same of these rows only.
    """

    rmse: np.ndarray
    nees: float
    median: np.ndarray
    apart: "Score | None" = None
    holes: "Score | None" = None


class Outcome(NamedTuple):
    """Run of an observer on a log, with its accuracy.

    Attributes:
        run: Stamps, estimates and diagnostics of every sample.
        velocity: Velocities (T, n), or states of a state-space model.
        nis: Mean normalised innovation squared for each measured number. 1 is expected; NaN for an observer without a
            covariance.
        score: Errors against the reference; None without one.
        microseconds: Computing time of a sample [µs] without compilation; NaN where it was not measured.
        engine: What computed the run, "c" or "jax", with the reason where C could not.
        slow_names: Names of what was estimated along with the motion, such as an external force.
        observer: The observer; None for one that was stored.
    """

    run: Run
    velocity: np.ndarray
    nis: float
    score: Score | None
    microseconds: float
    engine: str = ""
    slow_names: tuple[str, ...] = ()
    observer: Any = None

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples with each result, by its name."""
        codes = np.bincount(np.asarray(self.run.info.result), minlength=len(StepCode))
        return {StepCode(i).name.lower(): int(count) for i, count in enumerate(codes) if count}

    @property
    def failed(self) -> bool:
        """Whether the estimate left the finite numbers."""
        return "not_finite" in self.counts

    @property
    def failure(self) -> str:
        """Where the estimate left the finite numbers first, and what to look at."""
        row = int(np.argmax(np.asarray(self.run.info.result) == StepCode.NOT_FINITE)) + 1
        remedy = "look at the inputs just before, then at model and units"
        return f"row {row}: the estimate left the finite numbers; {remedy}"


def drive(observer: AbstractObserver, loaded: Loaded, engine: Engine = "auto") -> Outcome:
    """Run an observer on a log and score it."""
    run, by = run_log(observer, loaded.record_for(observer), KEPT, engine)
    return scored(observer, jax.block_until_ready(run), loaded, by)._replace(observer=observer)


ROUNDS = 9
"""Runs of which the quickest counts, since other load only lengthens a run."""


def timed(
    outcomes: dict[str, Outcome], observers: Mapping[str, AbstractObserver], loaded: Loaded
) -> dict[str, Outcome]:
    """Measure the computing time of each run. They take turns, so that load which comes and goes hits all alike."""
    least = dict.fromkeys(outcomes, math.inf)
    for _ in range(ROUNDS):
        for name, outcome in outcomes.items():
            began = time.perf_counter()
            # The engine that did the first run, by its name: what it compiled is used again.
            engine = "c" if outcome.engine == "c" else "jax"
            jax.block_until_ready(run_log(observers[name], loaded.record_for(observers[name]), KEPT, engine)[0])
            least[name] = min(least[name], time.perf_counter() - began)
    return {name: each._replace(microseconds=1e6 * least[name] / len(each.run.t)) for name, each in outcomes.items()}


def scored(observer: AbstractObserver, run: Run, loaded: Loaded, engine: str) -> Outcome:
    """Score a run of an observer on a log."""
    velocity = np.asarray(loaded.model.sought.of(run.estimate))
    score = None if loaded.reference is None else _score(velocity, run.info, loaded)
    return Outcome(run, velocity, mean_nis(run.info, loaded), score, math.nan, engine, _slow_names(observer))


def _slow_names(observer: AbstractObserver) -> tuple[str, ...]:
    """Names of what an observer estimates along with the motion, behind a gate or a delay, too."""
    inner = getattr(observer, "observer", None)
    return observer.slow_names if inner is None else _slow_names(inner)


def engine_is_notable(by: str, asked: Engine) -> bool:
    """Whether a result names its engine: where one was asked for, and where C could not do the work."""
    return asked != "auto" or not (by == "c" or by.startswith("jax: fewer than"))


def known(info: Diagnostics, name: str) -> np.ndarray | None:
    """Read a field of an observer's info."""
    return np.asarray(getattr(info, name)) if name in info._fields else None


def deviations(info: Diagnostics) -> np.ndarray | None:
    """Read standard deviations from an observer's info."""
    fields = [known(info, name) for name in ("velocity_std", "state_std")]
    return next((std for std in fields if std is not None), None)


def _score(velocity: np.ndarray, info: Diagnostics, loaded: Loaded) -> Score:
    reference: Any = loaded.reference
    std, holes = deviations(info), loaded.holes

    def of(rows: np.ndarray) -> Score | None:
        if not rows.any():
            return None
        off = velocity[rows] - reference.v[rows]
        nees = math.nan if std is None else float(np.mean((off / std[rows]) ** 2))
        return Score(np.sqrt(np.mean(off**2, axis=0)), nees, np.median(np.abs(off), axis=0))

    score: Any = of(reference.scored)
    if holes is None:
        return score
    known = reference.scored & np.isfinite(reference.v).all(1)
    return score._replace(apart=of(known & ~holes.concerned), holes=of(known & holes.concerned))


def mean_nis(info: Diagnostics, loaded: Loaded) -> float:
    """Mean normalised innovation squared for each measured number.

    Refused measurements are left out, and so is the first, from which the state starts.
    """
    nis = known(info, "nis")
    if nis is None:
        return math.nan
    accepted, count = counted(info, loaded)
    return float(nis[accepted].sum() / count) if count else math.nan


def counted(info: Diagnostics, loaded: Loaded) -> tuple[np.ndarray, int]:
    """Samples whose innovations count."""
    measured = ~np.asarray(jax.vmap(loaded.model.manifold.missing)(jnp.asarray(loaded.record.y)))
    accepted = np.asarray(info.result) < StepCode.OUTLIER  # codes grow with how bad a sample is
    accepted[0] = False
    return accepted, int(measured[accepted].sum())


def summary(outcome: Outcome, what: str = "velocity") -> dict[str, Any]:
    """Convert the accuracy of an outcome to JSON data."""
    score = outcome.score
    scored, consistency = {}, {"nis": outcome.nis}
    if score is not None:
        scored = {f"{what}_rmse": rounded(score.rmse), f"{what}_median_error": rounded(score.median)}
        consistency["nees"] = score.nees
        for name, part in (("without_holes", score.apart), ("in_holes", score.holes)):
            if part is not None:
                scored[f"{what}_rmse_{name}"] = rounded(part.rmse)
                consistency[f"nees_{name}"] = part.nees
    used, refused = innovation_rms(outcome)
    return {
        **scored,
        "innovation_rms": rounded(used),
        **({} if refused is None else {"innovation_rms_refused": rounded(refused)}),
        **{name: plain(value) for name, value in consistency.items()},
        "results": outcome.counts,
    }


def innovation_rms(outcome: Outcome) -> tuple[np.ndarray, np.ndarray | None]:
    """Root mean squares (n,) of the innovations of rows that no gate refused, and of those that one did, if any."""
    innovation = np.asarray(outcome.run.info.innovation)
    refused = np.asarray(outcome.run.info.result) >= StepCode.OUTLIER
    parts = [np.sqrt(np.mean(innovation[rows] ** 2, axis=0)) for rows in (~refused, refused) if rows.any()]
    return (parts[0], None) if refused.all() or not refused.any() else (parts[0], parts[1])


def rounded(values: np.ndarray) -> list[float | None]:
    """Round numbers to six significant digits."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values)]


def plain(value: float) -> float | None:
    """Round one number as `rounded` does."""
    return rounded(np.array([value]))[0]


def with_units(values: Iterable[float | None], units: tuple[str, ...]) -> str:
    """Format numbers in one line, each with its unit."""
    pairs = zip(values, units, strict=True)
    return ", ".join("—" if v is None else f"{v:.4g} {unit}".removesuffix(" 1").rstrip() for v, unit in pairs)


class Pushes(NamedTuple):
    """Rows in which something pushes.

    The error of an estimated force is a sum of what the force itself, the noise and all other unknowns have done. Where
    there is no force its part is missing, so that the estimate then has at most the variance that the filter tells for
    its error. A row is called pushed where any force is more of these standard deviations from zero than a normal
    number is with the probability `FALSE_ALARM` over the number of forces.

    Attributes:
        names: The forces that count: those on links, or where there are none the external forces of the joints.
        rows: Whether something pushes, in each row (T,).
        starts: Rows at which it begins.

    Example:
        >>> import covariant
        >>> force = {"uncertainty.external_force_std": 1.0, "uncertainty.external_force_time": 0.3}
        >>> noise = force | {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
        >>> log = covariant.simulate("oscillator", duration=4.0, rate=100.0, noise=1e-4, push=[3.0]).record
        >>> result = covariant.estimate("oscillator", log, observer="intrinsic-kalman", overrides=noise)
        >>> result.pushes.names, result.pushes.starts.tolist(), int(result.pushes.rows.sum())
        (('external_force1',), [129, 177, 330, 376], 96)
    """

    names: tuple[str, ...]
    rows: np.ndarray
    starts: np.ndarray

    def __str__(self) -> str:
        count, share = len(self.starts), 100 * np.mean(self.rows)
        return (
            f"pushed {count} time{'s' * (count != 1)}, in {share:.3g} % of the rows; where model and noise are right, "
            f"a row without a push is called pushed at most once in {1 / FALSE_ALARM:.0f}"
        )


def force_names(file: ModelFile, names: tuple[str, ...]) -> tuple[str, ...]:
    """Which slow states are forces that push.

    Beside forces on links, an external force is what the model does not know of the joints.
    """
    linked = {f"{axis}_{name}" for name in file.wrenches for axis in AXES}
    return tuple(name for name in names if (name in linked if linked else name.startswith("external_force")))


def pushes(file: ModelFile, outcome: Outcome) -> Pushes | None:
    """Rows in which something pushes; None of an observer that estimates no force."""
    slow, std = (known(outcome.run.info, name) for name in ("slow", "slow_std"))
    names = force_names(file, outcome.slow_names)
    if slow is None or std is None or not names:
        return None
    at = [outcome.slow_names.index(name) for name in names]
    limit = NormalDist().inv_cdf(1 - FALSE_ALARM / (2 * len(at)))
    rows = np.asarray(np.any(np.abs(slow[:, at]) > limit * std[:, at], axis=1))
    return Pushes(names, rows, np.flatnonzero(rows & ~np.concatenate([[False], rows[:-1]])))


def unexplained(job: Job, loaded: Loaded, observer: str, outcome: Outcome) -> str | None:
    """One sentence where the mean NIS is larger than a right model has it; None where it is not.

    The NIS of a right model with right noise, summed over N measured numbers, is χ²-distributed with N degrees of
    freedom. Said is what exceeds `MARGIN` times its 99.9 % quantile.
    """
    if not (observer in INFORMED and loaded.file.mechanical and math.isfinite(outcome.nis)):
        return None
    limit = MARGIN * mean_quantile(int(counted(outcome.run.info, loaded)[1]))
    if outcome.nis < SMALL and loaded.file.quantum is None:
        remedy = advice(job.model, tune="; `covariant tune` finds noise that fits")
        return (
            f"NIS averages {outcome.nis:.3g} a measured number, where 1 is expected: the noise of the model file is "
            f"larger than that of the log, and standard deviations are too large{remedy}"
        )
    if outcome.nis <= limit:
        return None
    return (
        f"NIS averages {outcome.nis:.3g} a measured number, where 1 is expected and more than {limit:.3g} is no "
        "chance: the model, or the noise of the model file, does not explain this log, and standard deviations are too "
        "small; "
        f"`covariant check {job.model_name} {job.log_name}` looks for what is wrong, "
        + advice(job.model, tune="`covariant tune` finds noise that fits, ")
        + "and pushes or friction that are not known are estimated along with the motion by intrinsic-kalman with "
        "[uncertainty] external_force_std and external_force_time, or parameters"
    )


def inconsistent(loaded: Loaded, observer: str, outcome: Outcome) -> str | None:
    """One sentence where errors against true velocities are far from what the standard deviations say."""
    score, reference = outcome.score, loaded.reference
    if score is None or reference is None or loaded.log.truth is None or not math.isfinite(score.nees):
        return None
    # A filter that knows no model has the usual motion as its noise, so that it is cautious on a calm one.
    if (SMALL if observer in INFORMED else 0.0) <= score.nees <= LARGE:
        return None
    size = "small" if score.nees > 1 else "large"
    text = (
        f"NEES averages {score.nees:.3g}, where 1 is expected: standard deviations are too {size} by a factor of "
        f"{max(score.nees, 1 / score.nees) ** 0.5:.2g}"
    )
    if score.apart is not None and score.holes is not None:
        text += (
            f"; it is {score.holes.nees:.3g} in the holes of the log and {SETTLED:g} s after each, and "
            f"{score.apart.nees:.3g} elsewhere"
        )
    return text


def mean_quantile(count: int) -> float:
    """The 99.9 % quantile of the mean of so many squared standard normal numbers, to 2 % from 3 of them on.

    Source: Wilson & Hilferty 1931, The distribution of chi-square, PNAS 17(12).
    """
    ninth = 2 / (9 * max(count, 1))
    return (1 - ninth + QUANTILE * math.sqrt(ninth)) ** 3
