"""`compare_force`: estimates of external forces on the same log, by filters and by their rivals, and scored."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import models
from covariant._errors import InputError
from covariant.models import Overrides
from covariant.observers import AbstractWrapper, IntrinsicKalman, KalmanState, SlowVariables, run
from covariant.scoring import rmse, scored_window
from covariant.workflow._compare import AbstractComparison
from covariant.workflow._design import design, log_sheet
from covariant.workflow._force_rivals import rivals
from covariant.workflow._inputs import ColumnNames, Job, Loaded, column_names, load, numbered, refuse_delays
from covariant.workflow._kind import Labels
from covariant.workflow._outcome import force_names, mean_nis, plain, rounded
from covariant.workflow._progress import Progress, notebook_line

WITHIN = 1.96
"""Standard deviations of a normal distribution to both sides of its mean that hold 95 % of it."""


def compare_force(
    model: Any,
    log: Any,
    force: str | Sequence[str],
    *,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    progress: Progress = notebook_line,
) -> "CompareForceResult":
    """Estimate external forces from a log by filters and by their rivals, and score them against the true ones.

    The filter is `intrinsic-kalman` with the forces that the model file asks for, once forgotten after their time
    constant, and once as random walks of the same density. Its rivals take the velocity of a filtered derivative as if
    it were exact: the momentum observer with a usual gain; and the momentum observer and inverse dynamics, each with
    the bandwidths, gain, high-pass and scale that are best for this very log, by its true forces.

    Args:
        model, log, overrides, every, start, until, columns, anyway, progress: As for `estimate`. The model file has
            `[uncertainty] external_force_std` and `external_force_time`, or a `[wrench.NAME]`.
        force: Columns of the true forces [N or N m], a generalised force for each velocity, as `simulate` writes them.

    Returns:
        The RMS error of each force by each estimator, and how often it is within the 95 % band that a filter states.
        With forces on links, these are scored, as they act on the joints, and what the joints have beside is not.

    Raises:
        MisfitError: Where the model explains nothing of the motion in the log.
        ValueError: For a model that estimates no force, for readings that are late, for a model or a log that cannot be
            used.

    Example:
        >>> import covariant
        >>> from covariant import workflow
        >>> log = covariant.simulate("oscillator", duration=4.0, rate=100.0, noise=1e-4, push=[0.5])
        >>> noise = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
        >>> noise |= {"uncertainty.external_force_std": 0.2, "uncertainty.external_force_time": 0.3}
        >>> result = workflow.compare_force("oscillator", log.to_pandas(), log.force_columns, overrides=noise)
        >>> result.columns["estimator"][:2].tolist()
        ['intrinsic-kalman, forgotten', 'intrinsic-kalman, random walk']
        >>> bool(result.columns["external_force1_rmse"][0] < 0.1)
        True
    """
    names = column_names(force)
    if columns and columns.get("truth") is not None:
        raise InputError('`columns["truth"]` names true velocities, and with `force` forces are scored; leave it out')
    job = Job(
        _without_unit(model, overrides), log, (), every, until, {**(columns or {}), "truth": names}, anyway, start
    )
    progress("reading the log")
    loaded = load(job, score=False, why="external forces are those of")
    _check(job, loaded, names)
    true = np.asarray(loaded.log.truth)
    scored = scored_window(np.asarray(loaded.record.t)) & np.isfinite(true).all(axis=1)
    progress("estimating with intrinsic-kalman")
    by = {name: _run_filter(filter_, loaded) for name, filter_ in _filters(job, loaded).items()}
    progress("estimating with rivals")
    for rival in rivals(loaded.model, loaded.record, log_sheet(loaded.file, loaded), loaded.rate, true, scored):
        by[rival.name] = ForceEstimate(rival.force, None, np.nan, rival.design)
    return CompareForceResult(job, loaded, names, true, scored, by)


class ForceEstimate(NamedTuple):
    """Forces as one estimator sees them.

    Attributes:
        force: Generalised forces (T, n) along the velocities [N or N m].
        std: Their standard deviations (T, n); None where they are not known.
        nis: Mean normalised innovation squared for each measured number; NaN without a covariance.
        design: How the estimator was tuned.
    """

    force: Float[np.ndarray, "T n"]
    std: Float[np.ndarray, "T n"] | None
    nis: float
    design: str


@dataclass(frozen=True, repr=False)
class CompareForceResult(AbstractComparison):
    """External forces by several estimators, with their errors.

    Attributes:
        job: The model and the log, and which part of it was read.
        loaded: Both as they were read.
        names: Columns of the true forces.
        true: The true forces (T, n) [N or N m].
        scored: Which rows (T,) count.
        estimates: A `ForceEstimate` for each estimator by name; filters first.

    Example:
        >>> import covariant
        >>> from covariant import workflow
        >>> log = covariant.simulate("oscillator", duration=4.0, rate=100.0, noise=1e-4, push=[0.5])
        >>> noise = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
        >>> noise |= {"uncertainty.external_force_std": 0.2, "uncertainty.external_force_time": 0.3}
        >>> result = workflow.compare_force("oscillator", log.to_pandas(), log.force_columns, overrides=noise)
        >>> list(result.columns)
        ['estimator', 'external_force1_rmse', 'within_band', 'nis']
    """

    names: tuple[str, ...]
    true: np.ndarray
    scored: np.ndarray
    estimates: dict[str, ForceEstimate]

    @property
    def columns(self) -> dict[str, np.ndarray]:
        errors = np.array([self._errors(each) for each in self.estimates.values()])
        labels = [f"{name}_rmse" for name in numbered("external_force", errors.shape[1])]
        return {
            "estimator": np.array(tuple(self.estimates)),
            **dict(zip(labels, errors.T, strict=True)),
            "within_band": np.array([self._within(each) for each in self.estimates.values()]),
            "nis": np.array([each.nis for each in self.estimates.values()]),
        }

    @property
    def units(self) -> dict[str, str]:
        labels = Labels(numbered("external_force", self.true.shape[1]), self.loaded.kind.force_units)
        return labels.called("{}_rmse").table

    @property
    def size(self) -> np.ndarray:
        """Root mean squares (n,) of the true forces: the errors of an estimate that is zero."""
        return rmse(self.true[self.scored], np.zeros_like(self.true[self.scored]))

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "model": self.job.model_name,
            "log": self.job.log_name,
            "rows": len(self.true),
            "rms_of_the_truth": rounded(self.size),
            "estimators": [
                {
                    "estimator": name,
                    "design": each.design,
                    "force_rmse": rounded(self._errors(each)),
                    "within_band": plain(self._within(each)),
                    "nis": plain(each.nis),
                }
                for name, each in self.estimates.items()
            ],
        }

    @property
    def headline(self) -> str:
        best = min(
            self.estimates, key=lambda name: float(np.mean((self._errors(self.estimates[name]) / self.size) ** 2))
        )
        return f"external forces by {len(self.estimates)} estimators on {len(self.true)} rows; best: {best}"

    def __str__(self) -> str:
        from covariant.report import table

        labels = Labels(self.names, self.loaded.kind.force_units).called("RMSE {}")
        rows = [
            {"estimator": name, **labels.cells(self._errors(each))}
            | {"in the 95 % band": self._within(each), "NIS": each.nis}
            for name, each in self.estimates.items()
        ]
        rows.append({"estimator": "none: the size of the truth", **labels.cells(self.size)})
        designs = [f"{name}: {each.design}" for name, each in self.estimates.items()]
        return "\n".join([f"{self.job.log_name}, errors of the external force", "", table(rows), *designs])

    def _errors(self, estimate: ForceEstimate) -> np.ndarray:
        return rmse(estimate.force[self.scored], self.true[self.scored])

    def _within(self, estimate: ForceEstimate) -> float:
        if estimate.std is None:
            return float("nan")
        off = np.abs(estimate.force - self.true)[self.scored]
        return float(np.mean(off <= WITHIN * estimate.std[self.scored]))


class _Force(AbstractWrapper):
    """A filter whose estimate is the force (n,) of some of its slow states, followed by its standard deviations."""

    observer: IntrinsicKalman
    scored: tuple[bool, ...] = eqx.field(static=True)

    def init(self, y: Array, t: Any = 0.0) -> KalmanState:
        return self.observer.init(y, t)

    def predict(self, state: KalmanState, u: Array, dt: Array) -> KalmanState:
        return self.observer.predict(state, u, dt)

    def correct(self, state: KalmanState, u: Array, y: Array) -> tuple[KalmanState, Any]:
        return self.observer.correct(state, u, y)

    def innovation(self, state: KalmanState, u: Array, y: Array) -> Array:
        return self.observer.innovation(state, u, y)

    def estimate(self, state: KalmanState) -> Float[Array, "two_n"]:
        groups = self.observer.slow
        ends = np.cumsum([len(group.names) for group in groups])

        def force(s):
            parts = jnp.split(s, ends.tolist())[:-1]  # what comes after is of the sensors
            together = zip(groups, parts, self.scored, strict=True)
            return sum(
                (group.force(state.q, state.v, part) for group, part, counts in together if counts and group.force),
                jnp.zeros_like(state.v),
            )

        root = jax.jacfwd(force)(state.slow) @ state.root[2 * state.v.shape[0] :]
        return jnp.concatenate([force(state.slow), jnp.sqrt(jnp.sum(root**2, axis=1))])


def _without_unit(model: Any, overrides: Overrides) -> models.ModelFile:
    """The model file, without the unit of true velocities, which forces do not have."""
    file = models.load(model, overrides)
    units = {field: unit for field, unit in file.columns.units.items() if field != "truth"}
    return file._replace(name=models.spec_name(model), columns=file.columns._replace(units=units))


def _check(job: Job, loaded: Loaded, names: tuple[str, ...]) -> None:
    file = loaded.file
    if len(names) != file.dimension:
        raise InputError(
            f"`force` names {len(names)} columns, and {job.model_name} has {file.dimension} velocities; give a "
            f"generalised force for each, as `simulate` with `push` writes them; got {','.join(names)}"
        )
    if loaded.log.truth is None:
        raise InputError(f"{job.log_name} has no column of true forces; a Record has none, give a table with them")
    if file.external_force is None and file.external_force_std is None and not file.wrenches:
        raise InputError(
            f"{job.model_name} has the filter estimate no force; give "
            "`overrides=['uncertainty.external_force_std=NUMBER', 'uncertainty.external_force_time=SECONDS']`, "
            "the usual size of a push and how long it lasts, or a [wrench.NAME] in the model file"
        )


def _filters(job: Job, loaded: Loaded) -> dict[str, _Force]:
    """The filter with forces that are forgotten, where the model file has such, and with forces that walk."""
    kalman: Any = design(loaded.file, "intrinsic-kalman", None, loaded.rate, loaded).observer
    refuse_delays(job, loaded, kalman, "forces are not compared on what is read late")
    names = force_names(loaded.file, kalman.slow_names)
    scored = tuple(set(group.names) <= set(names) for group in kalman.slow)
    filters = {}
    if any(group.time is not None for group in kalman.slow):
        filters["intrinsic-kalman, forgotten"] = _Force(kalman, scored)
    walking = dataclasses.replace(kalman, slow=tuple(map(_walking, kalman.slow)))
    return filters | {"intrinsic-kalman, random walk": _Force(walking, scored)}


def _walking(group: SlowVariables) -> SlowVariables:
    """The same states, as uncertain at the start and by as much more in a moment, that do not return."""
    return dataclasses.replace(group, time=None)


def _run_filter(filter_: _Force, loaded: Loaded) -> ForceEstimate:
    done = jax.tree.map(np.asarray, run(filter_, loaded.record_for(filter_), ("result", "nis")))
    force, std = np.split(done.estimate, 2, axis=1)
    forgotten = any(group.time is not None for group in filter_.observer.slow)
    design = "noise and forces of the model file" + ("" if forgotten else ", as random walks of the same density")
    return ForceEstimate(force, std, mean_nis(done.info, loaded), design)
