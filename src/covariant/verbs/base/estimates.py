"""The estimates of one observer on a log, and the sentences on them."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from covariant import logs
from covariant.engine import EngineName
from covariant.models.robots import servos_in
from covariant.observers import AbstractObserver, Gated
from covariant.scoring import SETTLED, rmse
from covariant.signals import Run, StepCode
from covariant.verbs.base.bands import narrow_bands
from covariant.verbs.base.design import design, widens
from covariant.verbs.base.determined import Determinacy
from covariant.verbs.base.holes import LONGEST_SHOWN
from covariant.verbs.base.inputs import INFORMED, Job, Loaded, last_known, tells_noise, with_acting_inputs
from covariant.verbs.base.outcome import (
    Outcome,
    Pushes,
    deviations,
    engine_is_notable,
    inconsistent,
    known,
    plain,
    pushes,
    rounded,
    summary,
    unexplained,
    with_units,
)
from covariant.verbs.base.pages import AbstractEstimates, accuracy, estimate_report
from covariant.verbs.base.refusals import LISTED, Refusal, refusals, refused_text
from covariant.verbs.base.sensors import SensorCount, sensor_counts
from covariant.verbs.base.without_model import WithoutModel, without_model


@dataclass(frozen=True, repr=False)
class EstimateResult(AbstractEstimates):
    """Estimates from a log: a table of time, configuration and velocities, with their standard deviations if known.

    Attributes:
        job: The model and the log, and which part of it was read.
        loaded: Both as they were read.
        observer_name: Name of the observer.
        design: Sentences on gains and noise.
        outcome: The run of the observer, with its score where there is a reference.
        asked_engine: The engine that was asked for.
        determined: How well the log determines what is estimated along with the motion, such as biases and forces.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=2.0, rate=100.0, q0=[1.0], noise=1e-4).record
        >>> result = covariant.estimate("oscillator", log, alpha=40.0, beta=800.0)
        >>> result
        <EstimateResult: velocity from 201 rows by intrinsic>
        >>> list(result.columns), result.units["v"]
        (['t', 'q', 'v'], 'm/s')
        >>> bool((result.codes == covariant.StepCode.OK).all())
        True
    """

    job: Job
    loaded: Loaded
    observer_name: str
    design: tuple[str, ...]
    outcome: Outcome
    asked_engine: EngineName
    determined: tuple[Determinacy, ...] = ()

    @property
    def run(self) -> Run:
        """Stamps, estimates and diagnostics of every sample."""
        return self.outcome.run

    @property
    def observer(self) -> AbstractObserver:
        """The observer, for an `engine.Stream`: it takes inputs as they are sent, and starts at rest."""
        return with_acting_inputs(self.outcome.observer, self.loaded.file, self.loaded.rate, self.loaded)

    @property
    def t(self) -> np.ndarray:
        """Stamps (T,) [s]."""
        return np.asarray(self.outcome.run.t)

    @property
    def velocity(self) -> np.ndarray:
        """Estimated velocities (T, n), or states of a state-space model, in the units of the model."""
        return self.outcome.velocity

    @property
    def velocity_std(self) -> np.ndarray | None:
        """Standard deviations (T, n) of `velocity`, in its units; None for an observer without a covariance."""
        return deviations(self.outcome.run.info)

    @property
    def codes(self) -> np.ndarray:
        """Result code (T,) of every sample, an integer that is a `covariant.StepCode`."""
        return np.asarray(self.outcome.run.info.result)

    @property
    def sensors(self) -> dict[str, SensorCount]:
        """What was used of the readings of each sensor, by its name; empty for an observer without sensors."""
        info, readings = getattr(self.outcome.run.info, "sensors", None), self.loaded.readings
        return {} if info is None or readings is None else sensor_counts(self.loaded.sensors, readings, info)

    @property
    def refused(self) -> list[Refusal]:
        """Refused readings, each stretch of them with what the first one read and what was expected."""
        return refusals(self.loaded, self.outcome)

    @property
    def pushes(self) -> Pushes | None:
        """Rows in which something pushes; None of an observer that estimates no force."""
        return pushes(self.loaded.file, self.outcome)

    @functools.cached_property
    def without_model(self) -> WithoutModel | str:
        """What the best filter without a model makes of the log; "" for such a filter, or why there is none."""
        return without_model(self.loaded, self.velocity) if self.observer_name in INFORMED else ""

    @property
    def columns(self) -> dict[str, np.ndarray]:
        kind = self.loaded.kind
        return self.loaded.file.columns.as_logged(self._columns(kind.positions.names, kind.estimates.names))

    @property
    def units(self) -> dict[str, str]:
        table = self.loaded.kind.estimates.table | self.loaded.kind.positions.table
        units = {"t": "s"} | table | {f"{name}_std": unit for name, unit in table.items()}
        units |= {name: unit for name, (unit, _) in self._torques.items()}
        return units | self.loaded.file.columns.units_of((*units, *self.loaded.file.columns.measured))

    @functools.cached_property
    def _torques(self) -> dict[str, tuple[str, np.ndarray]]:
        """Units and values (T,) of the torques of servos at the estimates, by column; none where inputs are torques."""
        loaded, estimate = self.loaded, self.outcome.run.estimate
        servos = servos_in(loaded.model)
        if servos is None:
            return {}
        q, v = estimate[:, : len(loaded.model.coordinates)], self.outcome.velocity
        u = last_known(np.asarray(loaded.record.u, float))  # as in the estimate
        columns = np.asarray(jax.jit(jax.vmap(servos.torque))(jnp.asarray(q), jnp.asarray(v), jnp.asarray(u))).T
        places = np.argmax(np.abs(np.asarray(servos.commands)), axis=1)
        names = (f"torque_{servos.input_names[i].removeprefix('cmd_')}" for i in places)
        units = ("N m" if servos.input_units[i] == "rad" else "N" for i in places)
        return dict(zip(names, zip(units, columns, strict=True), strict=True))

    def _columns(self, positions: tuple[str, ...], velocities: tuple[str, ...]) -> dict[str, np.ndarray]:
        """The columns: t, the configuration as the log has it, the velocities, and what else is estimated.

        An observer that knows how accurate it is adds standard deviations, v1_std…; one that estimates more than the
        motion adds that, as external_force1… and external_force1_std…, and one that estimates forces adds whether
        something pushes, 1 or 0. A robot with servos adds the torque of each, torque_elbow….
        """
        outcome, info = self.outcome, self.outcome.run.info
        table = {"t": self.t} | self.loaded.kind.configuration(outcome.run.estimate, positions)
        motion = velocities, outcome.velocity, deviations(info)
        slow = outcome.slow_names, known(info, "slow"), known(info, "slow_std")
        for names, values, std in (motion, slow):
            for suffix, each in (("", values), ("_std", std)):
                if each is not None and each.size:
                    table |= {f"{name}{suffix}": column for name, column in zip(names, each.T, strict=True)}
        table |= {name: values for name, (_, values) in self._torques.items()}
        return table if self.pushes is None else table | {"pushed": self.pushes.rows.astype(float)}

    written = logs.WRITTEN

    @property
    def _log(self) -> Any:
        return self.job.log

    def _write(self, path: Path) -> None:
        # In messages of ROS coordinates are joints by their names in the log: shoulder/position, shoulder/velocity….
        columns = self._columns(*self.loaded.kind.message_columns) if path.suffix in logs.MESSAGES else self.columns
        logs.write(path, columns, self.loaded.log.origin_ns)

    @property
    def summary(self) -> dict[str, Any]:
        loaded, outcome = self.loaded, self.outcome
        reference, logged = loaded.reference, loaded.log.v
        result = {
            "model": self.job.model_name,
            "log": self.job.log_name,
            "observer": self.observer_name,
            "rows": len(outcome.run.t),
            **({} if loaded.origin is None else {"t_counts_from": loaded.origin}),
            "engine": outcome.engine,
            **({} if reference is None else {"scored_against": reference.label}),
            "design": self.design[0],
            **summary(outcome, loaded.kind.what),
            **({} if loaded.holes is None else {"holes": loaded.holes.table}),
        }
        if self.sensors:
            result["sensors"] = {name: each._asdict() | {"nis": plain(each.nis)} for name, each in self.sensors.items()}
        if self.refused:
            result["refused"] = [each.data for each in self.refused[:LISTED]]
        if self.pushes is not None:
            result["pushes"] = len(self.pushes.starts)
            result["share_of_rows_pushed"] = plain(float(np.mean(self.pushes.rows)))
        if self.determined:
            named = ({"name": each.name, "ratio": plain(each.ratio)} | _stds(each) for each in self.determined)
            result["determined"] = list(named)
        free = self.without_model
        if not isinstance(free, str):
            result["without_model"] = free.data
        if reference is not None and logged is not None:
            both = reference.scored & np.isfinite(logged).all(1)
            result["difference_to_logged_velocity"] = rounded(rmse(outcome.velocity[both], logged[both]))
            result["logged_velocity_rmse"] = rounded(rmse(logged[both], reference.v[both]))
        return result

    @property
    def row(self) -> dict[str, Any]:
        """Numbers and short texts by name: the row of this log in a table of many."""
        # Without the comparison with filters that know no model, which takes three quarters of the time of `estimate`.
        numbers = _flat(summary(self.outcome, self.loaded.kind.what))
        row = {"observer": self.observer_name, "rows": float(len(self.t))} | dict(numbers)
        return row | ({} if self.loaded.origin is None else {"t_counts_from": self.loaded.origin})

    @property
    def headline(self) -> str:
        odd = sum(count for name, count in self.outcome.counts.items() if name != "ok")
        return f"{self._verdict}; {odd} samples were not ordinary" if odd else self._verdict

    @property
    def _verdict(self) -> str:
        what = self.loaded.kind.what
        text = f"{what} from {len(self.t)} rows by {self.observer_name}"
        if self.outcome.score is not None:
            text += f", RMSE {with_units(rounded(self.outcome.score.rmse), self.loaded.kind.estimates.units)}"
        return text

    @property
    def warnings(self) -> tuple[str, ...]:
        """Whether innovations are larger than a right model has them, and how many samples had each result but ok.

        Of samples without a measurement the longest stretches are named.
        """
        counts, rows, free = self.outcome.counts, len(self.t), self.without_model
        doubts = (
            unexplained(self.job, self.loaded, self.observer_name, self.outcome),
            inconsistent(self.loaded, self.observer_name, self.outcome),
            *narrow_bands(self.job, self.loaded, self.observer_name, self.outcome),
            *hole_doubts(self.loaded, {self.observer_name: self.outcome}),
            free.advice(self.job, self.observer_name) if not isinstance(free, str) and free.verdict.is_worse else None,
        )
        return tuple(doubt for doubt in doubts if doubt is not None) + tuple(
            f"{count} of {rows} samples: {StepCode[name.upper()].message}"
            + (f" ({_longest(self.t, self.codes == StepCode.COASTED)})" if name == "coasted" else "")
            + (f": {refused_text(self.refused)}" if name == "outlier" and self.refused else "")
            for name, count in counts.items()
            if name != "ok"
        )

    def __str__(self) -> str:
        result = self.summary
        lines = head_lines(result, self.loaded)
        lines += [
            f"{name}: {each.readings} readings, {each.refused} refused, NIS {each.nis:.3g} per component"
            for name, each in self.sensors.items()
        ]
        lines += self._findings
        if "logged_velocity_rmse" in result:
            speeds = with_units(result["logged_velocity_rmse"], self.loaded.kind.estimates.units)
            lines.append(f"the same for the velocity in the log: {speeds}")
        if engine_is_notable(result["engine"], self.asked_engine):
            lines.append(f"engine: {result['engine']}")
        return "\n".join([*lines, *self.warnings])

    @property
    def _findings(self) -> list[str]:
        """Sentences on the filter without a model, on pushes, and on what the log determines."""
        free, pushed = self.without_model, self.pushes
        line = free if isinstance(free, str) else "" if free.verdict.is_worse else free.sentence(self.observer_name)
        return [*[line] * bool(line), *([] if pushed is None else [str(pushed)]), *map(str, self.determined)]

    def _page(self) -> Any:
        result = self.summary
        errors = (line for line in error_lines(result, self.loaded) if "RMSE" not in line)  # these are in the table
        return estimate_report(
            f"{self.loaded.kind.title} of {self.job.title}",
            self.job,
            self.loaded,
            {self.observer_name: self.outcome},
            (*errors, *hole_lines(result, self.loaded), *self._findings),
            {"observer": self.observer_name, "design": " ".join(self.design)},
            rows=accuracy(self.loaded, self.outcome),
            headline=self._verdict,
            warnings=self.warnings,
            table=self.columns,
        )


def _flat(summary: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, float | str]]:
    for name, value in summary.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}_")
        elif isinstance(value, list):
            numbers = [each for each in value if isinstance(each, int | float)]
            yield from _flat({f"{name}{k + 1}": each for k, each in enumerate(numbers)}, before)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{before}{name}", float(value)
        elif isinstance(value, str):
            yield f"{before}{name}", value


def _stds(each: Determinacy) -> dict[str, float | None]:
    first, last = rounded(np.array([each.first, each.last]))
    return {"std_without_log": first, "std": last}


def choose_observer(
    job: Job, loaded: Loaded, observer: str, gains: dict[str, Any] | None = None
) -> tuple[AbstractObserver, tuple[str, ...]]:
    """Design the observer of a name for a log, as if its readings were never late, and describe it in sentences."""
    designed = design(loaded.file, observer, gains, loaded.rate, loaded, spec=job.model_name)
    if gains is None:
        unused = loaded.kind.unused(designed.observer, observer, bool(loaded.sensors))
        chosen = f" The model file chooses {observer}." if observer == loaded.file.observer else ""
        return designed.observer, (f"{designed.notes}{_start(designed.observer)}{chosen}{loaded.note}{unused}",)
    unknown = "" if tells_noise(loaded.file) else " No measurement is refused: the model file tells no noise."
    return designed.observer, (designed.notes + _start(designed.observer) + unknown,)


def _start(observer: AbstractObserver) -> str:
    """A sentence on larger gains at the start that last longer than what is never scored; "" where none do."""
    length = observer.start_length if isinstance(observer, Gated) else 0.0
    return f" In the first {length:.3g} s gains are larger, to learn the velocity." if length > 1 else ""


def head_lines(result: Mapping[str, Any], loaded: Loaded, extent: str = "") -> list[str]:
    """Log, rows and observer, the design, and the sentences on errors and holes."""
    return [
        f"{result['log']}: {result['rows']} rows, {result['observer']} observer{extent}",
        *([f"t counts from {result['t_counts_from']}"] if "t_counts_from" in result else []),
        result["design"],
        *error_lines(result, loaded),
        *hole_lines(result, loaded),
    ]


def error_lines(result: Mapping[str, Any], loaded: Loaded) -> list[str]:
    """Sentences on the errors, and on the innovations, which need no reference."""
    lines = []
    what = loaded.kind.what
    if f"{what}_rmse" in result:
        errors = with_units(result[f"{what}_rmse"], loaded.kind.estimates.units)
        reference: Any = loaded.reference
        since = loaded.record.t[np.argmax(reference.scored)] - loaded.record.t[0]
        lines.append(f"{what} RMSE against the {result['scored_against']}, from {since:.3g} s on: {errors}")
    units = loaded.kind.measured.units
    lines.append(f"innovation RMS: {with_units(result['innovation_rms'], units)}")
    if "innovation_rms_refused" in result:
        refused = with_units(result["innovation_rms_refused"], units)
        lines[-1] += f" of rows that were used, {refused} of those that were refused"
    measures = [f"{name.upper()} {result[name]:.3g}" for name in ("nis", "nees") if result.get(name) is not None]
    if measures:
        lines.append(f"{' and '.join(measures)} per component; about 1 if model and noise are right")
    return lines


def hole_lines(result: Mapping[str, Any], loaded: Loaded) -> list[str]:
    """Sentences on the holes of a log, and on the errors with and without them."""
    holes, what = loaded.holes, loaded.kind.what
    if holes is None:
        return []
    lines, units = [str(holes)], loaded.kind.estimates.units
    parts = {
        name: with_units(result[f"{what}_rmse_{key}"], units)
        for key, name in (("without_holes", f"without the holes and {SETTLED:g} s after each"), ("in_holes", "there"))
        if f"{what}_rmse_{key}" in result
    }
    if parts:
        errors = ", ".join(f"{value} {name}" for name, value in parts.items())
        median = with_units(result[f"{what}_median_error"], units)
        lines.append(f"{what} RMSE: {errors}; median of all errors: {median}")
    return lines


def hole_doubts(loaded: Loaded, outcomes: Mapping[str, Outcome]) -> list[str]:
    """A sentence on the estimators that trust themselves too much in the holes of a log."""
    holes = loaded.holes
    if holes is None or not holes.of_inputs:
        return []
    widened = {"intrinsic-kalman"} if widens(loaded.file, loaded) else set()
    with_std = {name for name, outcome in outcomes.items() if deviations(outcome.run.info) is not None}
    rigid = [name for name in outcomes if name in (with_std & INFORMED) - widened]
    if not rigid:
        return []
    verb, better = ("takes", "its") if len(rigid) == 1 else ("take", "their")
    text = f"in the holes of the log {', '.join(rigid)} {verb} the last input as held, so that {better} standard "
    text += "deviations are too small there"
    return [text + "; those of intrinsic-kalman grow with what the inputs could have been" * bool(widened)]


def _longest(t: np.ndarray, coasted: np.ndarray) -> str:
    """The longest stretches of samples without a measurement, in words."""
    # The zeros at both ends let a stretch begin at the first sample and end at the last.
    edges = np.diff(np.concatenate([[0], coasted.astype(int), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    # Lengths are negative, so the longest stretch comes first, and of equal ones the earliest.
    order = np.argsort(t[first] - t[last], kind="stable")[:LONGEST_SHOWN]
    ends = zip(first[order], last[order], strict=True)
    spans = [f"{t[k]:.4g} s" if k == m else f"{t[k]:.4g} to {t[m]:.4g} s" for k, m in ends]
    return f"{'the longest at' if len(first) > LONGEST_SHOWN else 'at'} t = {', '.join(spans)}"
