"""`smooth`: offline estimates of velocities or states, each from the rows before and after it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from covariant import logs
from covariant.calibration import estimators
from covariant.models import Overrides
from covariant.observers import SMOOTHED, smooth as smooth_record
from covariant.verbs.base.estimates import EstimateResult, choose_observer, error_lines, head_lines, hole_lines
from covariant.verbs.base.inputs import ColumnNames, Job, load, periods_of, refuse_delays
from covariant.verbs.base.outcome import KEPT, deviations, rounded, scored, with_units
from covariant.verbs.base.pages import AbstractEstimates, estimate_report
from covariant.verbs.base.progress import Progress, notebook_line
from scalargraph.errors import InputError


def smooth(
    model: Any,
    log: Any,
    *,
    observer: str | None = None,
    lag: float | None = None,
    score: bool = False,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    progress: Progress = notebook_line,
) -> "SmoothResult":
    """Estimate velocities, or states of a state-space model, offline: each row from the rows before and after it.

    A filter runs over the log, and then a Rauch–Tung–Striebel smoother runs backwards over its results; see
    `observers.smooth`. Filter and smoother rely on the same model, so a model error affects both.

    Args:
        model, log, score, overrides, every, start, until, columns, anyway, progress: As for `estimate`.
        observer: Name of the filter: `intrinsic-kalman` (default of a mechanical model), `ekf`, `ukf`, `joint-kalman`,
            or `covariance-ekf` (default of a state-space model).
        lag: Time [s] after each row from which its estimate uses later rows too, counted in rows at the median
            interval; by default it uses all later rows.

    Returns:
        The smoothed estimates with their standard deviations, and those of the filter for comparison.

    Raises:
        MisfitError: The model explains nothing of the motion in the log.
        ValueError: For an observer without a covariance, late readings, other bad arguments, a model or log that cannot
            be used, or an estimate that diverged.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=2.0, rate=100.0, q0=[1.0], noise=1e-3).record
        >>> noise = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.1}
        >>> result = covariant.smooth("oscillator", log, overrides=noise)
        >>> bool((result.velocity_std <= result.filtered.velocity_std).all())
        True
    """
    if lag is not None and not 0 <= lag < np.inf:
        raise InputError(f"`lag` must be a time [s], 0 or more; got {lag}")
    if observer is not None and observer not in SMOOTHED:
        raise InputError(f"observer {observer} cannot be smoothed; these can: {', '.join(SMOOTHED)}")
    job = Job(model, log, overrides, every, until, columns or {}, anyway, start)
    progress("reading the log")
    loaded = load(job, score, missing_inputs=True)
    fitting = [name for name in SMOOTHED if name in estimators(loaded.model)]
    if not fitting:
        raise InputError(f"{job.model_name}: its observers cannot be smoothed; these can: {', '.join(SMOOTHED)}")
    name = observer or fitting[0]
    chosen, notes = choose_observer(job, loaded, name)
    refuse_delays(job, loaded, chosen, "a smoother does not compensate late readings")
    rows = None if lag is None else lag_rows(np.asarray(loaded.record.t), lag)
    progress(f"smoothing with {name}")
    periods = periods_of(job, loaded.file)
    smoothed = jax.block_until_ready(smooth_record(chosen, loaded.record_for(chosen), rows, KEPT, periods))
    smoothed_result, filtered_result = (
        EstimateResult(job, loaded, name, notes, scored(chosen, jax.tree.map(np.asarray, run), loaded, "jax"), "auto")
        for run in (smoothed.run, smoothed.filtered)
    )
    if filtered_result.outcome.failed:
        raise InputError(f"{job.log_name}: {filtered_result.outcome.failure}")
    if not (np.isfinite(smoothed_result.velocity).all() and np.isfinite(smoothed.std).all()):
        raise InputError(f"{job.log_name}: the estimate left the finite numbers; check model and units")
    names = loaded.kind.measured.names
    turns = tuple(hole._asdict() | {"coordinate": names[hole.coordinate]} for hole in smoothed.holes)
    return SmoothResult(smoothed_result, filtered_result, np.asarray(smoothed.std), rows, turns)


SURE = 0.95
"""Probability of a number of turns below which it counts as unknown."""


def lag_rows(t: np.ndarray, lag: float) -> int | None:
    """Number of rows within a lag at the median interval; None for the whole log."""
    if lag >= t[-1] - t[0]:
        return None
    spacing = float(np.median(np.diff(t)))
    if 0 < lag < spacing / 2:
        raise InputError(
            f"`lag={lag:g}` is less than half a row of the log, {spacing:.3g} s; give 0 for the filter itself"
        )
    return round(lag / spacing)


@dataclass(frozen=True, repr=False)
class SmoothResult(AbstractEstimates):
    """Smoothed estimates from a log: a table of time, configuration and velocities with their standard deviations.

    Attributes:
        smoothed: The smoothed estimates.
        filtered: The estimates of the filter, each from the rows up to it only.
        error_std: Standard deviations (T, N) of the error of the smoothed estimates, as in
            `observers.Smoothed.std`.
        lag: Number of later rows that each estimate uses; None for all.
        turns: How many turns a coordinate moved in a hole so long that the filter could not tell, and how probable that
            is: for each `begin` and `end` [s], `coordinate`, `turns` and `probability`.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=2.0, rate=100.0, q0=[1.0], noise=1e-3).record
        >>> noise = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.1}
        >>> result = covariant.smooth("oscillator", log, overrides=noise, lag=0.1)
        >>> result
        <SmoothResult: velocity from 201 rows by intrinsic-kalman, smoothed from 10 rows after each>
        >>> list(result.columns)
        ['t', 'q', 'v', 'v_std', 'q_std', 'v_filtered', 'v_filtered_std']
    """

    smoothed: EstimateResult
    filtered: EstimateResult
    error_std: np.ndarray
    lag: int | None
    turns: tuple[dict[str, Any], ...] = ()

    @property
    def t(self) -> np.ndarray:
        """Stamps (T,) [s]."""
        return self.smoothed.t

    @property
    def velocity(self) -> np.ndarray:
        """Smoothed velocities (T, n), or states of a state-space model, in the units of the model."""
        return self.smoothed.velocity

    @property
    def velocity_std(self) -> np.ndarray:
        """Standard deviations (T, n) of `velocity`, in its units."""
        return np.asarray(self.smoothed.velocity_std)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        table, kind = {}, self.smoothed.loaded.kind
        table |= {f"{name}_std": std for name, std in zip(kind.positions.names, self.error_std.T, strict=False)}
        for suffix, values in (("", self.filtered.velocity), ("_std", deviations(self.filtered.run.info))):
            for name, column in zip(kind.estimates.names, np.asarray(values).T, strict=True):
                table[f"{name}_filtered{suffix}"] = column
        return self.smoothed.columns | self.smoothed.loaded.file.columns.as_logged(table)

    @property
    def units(self) -> dict[str, str]:
        units = self.smoothed.units
        for name, unit in self.smoothed.loaded.kind.estimates.table.items():
            units |= {f"{name}_filtered": unit, f"{name}_filtered_std": unit}
        return units | self.smoothed.loaded.file.columns.units_of(units)

    written = logs.WRITTEN

    @property
    def _log(self) -> Any:
        return self.smoothed.job.log

    def _write(self, path: Path) -> None:
        if path.suffix in logs.MESSAGES:  # without the filter's columns
            self.smoothed.save(path)
        else:
            logs.write(path, self.columns, self.smoothed.loaded.log.origin_ns)

    @property
    def row(self) -> dict[str, Any]:
        """Numbers and short texts of the filter by name: the row of this log in a table of many."""
        return self.filtered.row

    @property
    def summary(self) -> dict[str, Any]:
        what = self.smoothed.loaded.kind.what
        numbers = self.filtered.summary
        filter_summary = {key: numbers[key] for key in (f"{what}_rmse", "nis", "nees") if key in numbers}
        std, filter_std = (
            {f"{what}_std": rounded(np.median(np.asarray(each.velocity_std), axis=0))}
            for each in (self.smoothed, self.filtered)
        )
        turns = {"turns": list(self.turns)} if self.turns else {}
        return self.smoothed.summary | std | {"lag_rows": self.lag, "filter": filter_summary | filter_std} | turns

    @property
    def headline(self) -> str:
        return f"{self.smoothed.headline}, {self._extent}"

    @property
    def _extent(self) -> str:
        after = "all rows" if self.lag is None else f"{self.lag} row{'s' * (self.lag != 1)} after each"
        return f"smoothed from {after}"

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.smoothed.warnings

    @property
    def _turn_lines(self) -> list[str]:
        """A sentence on each number of turns in a hole."""
        return [
            f"hole from {each['begin']:.4g} to {each['end']:.4g} s: {each['coordinate']} "
            + ("moved by" if each["probability"] >= SURE else "by an unknown number of turns, most probably")
            + f" {each['turns']:.2f} turns, probability {each['probability']:.3f}"
            for each in self.turns
        ]

    def __str__(self) -> str:
        result, loaded = self.summary, self.smoothed.loaded
        what, units = loaded.kind.what, loaded.kind.estimates.units
        lines = head_lines(result, loaded, f", {self._extent}") + self._turn_lines
        if f"{what}_rmse" in result:
            lines.append(f"{what} RMSE of the filter: {with_units(result['filter'][f'{what}_rmse'], units)}")
        stds = (with_units(each[f"{what}_std"], units) for each in (result, result["filter"]))
        lines.append("median standard deviation of the {}: {}; of the filter {}".format(what, *stds))
        return "\n".join([*lines, *self.warnings])

    def _page(self) -> Any:
        loaded, name = self.smoothed.loaded, self.smoothed.observer_name
        result = self.summary
        return estimate_report(
            f"{loaded.kind.title} of {self.smoothed.job.title}, smoothed",
            self.smoothed.job,
            loaded,
            {"smoothed": self.smoothed.outcome, name: self.filtered.outcome},
            (*error_lines(result, loaded), *hole_lines(result, loaded), *self._turn_lines),
            {"observer": f"{name}, {self._extent}", "design": " ".join(self.smoothed.design)},
            rows=self._rows(),
            headline=self.headline,
            warnings=self.warnings,
            contrast="smoothed",
            table=self.columns,
        )

    def _rows(self) -> tuple[dict[str, Any], ...]:
        """The smoother and the filter: errors, where they are known, and median standard deviations."""
        kind, result = self.smoothed.loaded.kind, self.summary
        measures = {"RMSE": f"{kind.what}_rmse", "median std": f"{kind.what}_std"}
        return tuple(
            {"estimator": label}
            | {
                f"{measure} {name}": value
                for measure, key in measures.items()
                for name, value in zip(kind.estimates.headings, numbers.get(key, ()), strict=False)
            }
            for label, numbers in (("smoothed", result), (self.smoothed.observer_name, result["filter"]))
        )
