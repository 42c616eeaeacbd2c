"""`compare`: all estimators on the same log, tuned from the same data sheet, and ranked."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from covariant.calibration import Trial, estimators
from covariant.engine import EngineName
from covariant.models import Overrides
from covariant.observers import AbstractObserver
from covariant.report import table, write_report
from covariant.scoring import SETTLED
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.estimates import hole_doubts
from covariant.verbs.base.inputs import INFORMED, ColumnNames, Job, Loaded, load, with_sensor_delays
from covariant.verbs.base.outcome import (
    Outcome,
    drive,
    engine_is_notable,
    inconsistent,
    rounded,
    summary,
    timed,
    with_units,
)
from covariant.verbs.base.outputs import write_table
from covariant.verbs.base.pages import estimate_report
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractTable
from covariant.verbs.base.trial import judging_reference, trial_part
from covariant.verbs.base.without_model import beside_filters


def compare(
    model: Any,
    log: Any,
    *,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    engine: EngineName = "auto",
    progress: Progress = notebook_line,
) -> "CompareResult":
    """Run all estimators that fit a model on a log, tuned from the same data sheet, and rank them.

    Use it to choose an observer for a machine. A ranking on the true velocities is the more reliable one; without them
    the estimators are ranked by slopes of the positions, in the windows that predict left-out rows best. The ranking is
    that of one motion and one data sheet: call `tune` first where the noise is not known.

    Args:
        model, log, overrides, every, start, until, columns, anyway, engine, progress: As for `estimate`. Noise of the
            model file, or of `overrides`, is the data sheet.

    Returns:
        The estimators in order of their errors, on rows on which none was tuned.

    Raises:
        MisfitError: Where the model explains nothing of the motion in the log.
        ValueError: For a model or a log that cannot be used.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=1.0, rate=100.0, noise=1e-4, q0=[1.0]).record
        >>> noise = {"measurement.std": 1e-4, "uncertainty.acceleration": 1.0}
        >>> covariant.compare("oscillator", log, overrides=noise).to_pandas()["estimator"].size > 5
        True
    """
    job = Job(model, log, overrides, every, until, columns or {}, anyway, start)
    progress("reading the log")
    loaded = load(job, missing_inputs=True)
    progress("tuning")
    reference, trial, tuned_on = loaded.reference, None, np.zeros(len(loaded.record.t), bool)
    if reference is not None:
        reference = judging_reference(loaded)
        trial, tuned_on = trial_part(loaded, reference)
        apart = reference.scored & np.isfinite(reference.v).all(axis=1) & ~tuned_on
        loaded = loaded._replace(reference=reference._replace(scored=apart if apart.any() else reference.scored))
    observers, note = line_up(loaded, trial, tuned_on)
    outcomes: dict[str, Outcome] = {}
    for place, (name, observer) in enumerate(observers.items()):
        progress(name, place / len(observers))
        outcomes[name] = drive(observer, loaded, engine)
    progress("timing")
    outcomes = timed(outcomes, observers, loaded)
    ranked = {name: outcomes[name] for name in rank(outcomes, loaded)}
    informed = next((name for name in ranked if name in INFORMED), None)
    sentence = ""
    if informed is not None and reference is not None and any(name not in INFORMED for name in ranked):
        beside = beside_filters(loaded, ranked[informed].velocity, reference, trial, tuned_on, observers)
        sentence = beside if isinstance(beside, str) else beside.sentence(informed)
    return CompareResult(job, loaded, note, ranked, engine, sentence)


@dataclass(frozen=True, repr=False)
class CompareResult(AbstractTable):
    """Estimators ranked on a log, best first.

    Attributes:
        job: The model and the log, and which part of it was read.
        loaded: Both as they were read.
        design: Sentences on how all of them are tuned.
        outcomes: Run and score of each estimator by name, in order of error.
        asked_engine: The engine that was asked for.
        without_model: A sentence that judges the best of them with the model beside the best filter without one, as
            `estimate` does; "" where none of them fits.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=1.0, rate=100.0, noise=1e-4, q0=[1.0]).record
        >>> noise = {"measurement.std": 1e-4, "uncertainty.acceleration": 1.0}
        >>> result = covariant.compare("oscillator", log, overrides=noise)
        >>> "intrinsic" in result.ranking, list(result.columns)[:3]
        (True, ['rank', 'estimator', 'v_rmse'])
        >>> bool(result.columns["v_rmse"][0] < 0.05)
        True
    """

    job: Job
    loaded: Loaded
    design: str
    outcomes: dict[str, Outcome]
    asked_engine: EngineName
    without_model: str = ""

    written = (".csv",)

    @property
    def _log(self) -> Any:
        return self.job.log

    def _write(self, path: Path) -> None:
        write_table(path, self.columns)  # a number that an estimator does not have is left empty

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of the estimators, best first."""
        return tuple(self.outcomes)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        loaded, outcomes = self.loaded, self.outcomes.values()
        scored = loaded.kind.estimates.names if loaded.reference else loaded.file.columns.q
        scores = [outcome.score for outcome in outcomes]
        errors: dict[str, list[Any]] = {
            "rmse": [rmse(outcome) for outcome in outcomes],
            "median_error": [score and score.median for score in scores],
            "rmse_without_holes": [score and score.apart and score.apart.rmse for score in scores],
        }
        known = [consistency(outcome) for outcome in outcomes]
        return {
            "rank": np.arange(1, len(outcomes) + 1),
            "estimator": np.array(self.ranking),
            **{
                f"{name}_{suffix}": np.array(rows)[:, i]
                for suffix, rows in errors.items()
                if all(row is not None for row in rows)
                for i, name in enumerate(scored)
            },
            **{key.lower(): np.array([row[key] for row in known]) for key in ("NIS", "NEES")},
            "microseconds": np.array([outcome.microseconds for outcome in outcomes]),
        }

    @property
    def ranking_without_holes(self) -> tuple[str, ...] | None:
        """The names in order of the errors without the rows in and after holes; None where the log has no holes."""
        return without_holes(self.outcomes, self.loaded)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Holes of the log, whether they decide the order, and estimators whose errors are not what they say."""
        holes, apart = self.loaded.holes, self.ranking_without_holes
        lines = [] if holes is None else [str(holes)]
        if apart is not None and apart[0] != self.ranking[0]:
            lines.append(
                f"the holes decide the order: without them and {SETTLED:g} s after each it is {', '.join(apart)}"
            )
        elif apart is not None and apart != self.ranking:
            lines.append(f"without the holes and {SETTLED:g} s after each the order is {', '.join(apart)}")
        doubts = {name: inconsistent(self.loaded, name, outcome) for name, outcome in self.outcomes.items()}
        lines += hole_doubts(self.loaded, self.outcomes)
        return (*lines, *(f"{name}: {doubt}" for name, doubt in doubts.items() if doubt is not None))

    @property
    def summary(self) -> dict[str, Any]:
        what = self.loaded.kind.what
        return {
            "model": self.job.model_name,
            "log": self.job.log_name,
            "scored_against": scored_against(self.loaded),
            "design": self.design,
            **({} if self.loaded.holes is None else {"holes": self.loaded.holes.table}),
            **({} if self.ranking_without_holes is None else {"without_holes": list(self.ranking_without_holes)}),
            "ranking": [
                {"estimator": name, "engine": outcome.engine, **summary(outcome, what)}
                for name, outcome in self.outcomes.items()
            ],
        }

    @property
    def headline(self) -> str:
        best, loaded, kind = self.ranking[0], self.loaded, self.loaded.kind
        units = kind.measured.units if loaded.reference is None else kind.estimates.units
        error = with_units(rounded(rmse(self.outcomes[best])), units)
        return f"{len(self.outcomes)} estimators on {len(loaded.record.t)} rows; best: {best}, RMSE {error}"

    def __str__(self) -> str:
        what = self.loaded.kind.what if self.loaded.reference else "prediction"
        notable = any(engine_is_notable(each.engine, self.asked_engine) for each in self.outcomes.values())
        lines = [
            f"{self.job.log_name}, {what} errors against the {scored_against(self.loaded)}",
            "",
            table(self._rows()),
            *[self.without_model] * bool(self.without_model),
            rows_that_count(self.loaded),
            self.design,
            *self.warnings,
            *(_engines(self.outcomes) if notable else []),
        ]
        return "\n".join(lines)

    def _write_page(self, path: Path) -> list[Path]:
        title = f"Estimators compared: {Path(self.job.model_name).stem}, {Path(self.job.log_name).name}"
        drawn, rest = self._drawn_first, len(self.outcomes)
        ranked = f"Drawn are {', '.join(drawn)}; a click on a label shows another." if rest > len(drawn) else ""
        notes = (ranked, self.without_model, self.design, rows_that_count(self.loaded))
        page = estimate_report(
            title,
            self.job,
            self.loaded,
            self.outcomes,
            notes,
            rows=self._rows_by_knowledge(),
            headline=self._verdict,
            warnings=self.warnings,
            best=len(self._equals),
            hidden=tuple(name for name in self.ranking if name not in drawn),
        )
        return write_report(page, path)

    @property
    def _equals(self) -> tuple[str, ...]:
        """The best estimator, and those whose errors are as small up to `EQUAL`."""
        total = badness(self.outcomes, self.loaded)
        return tuple(name for name in self.ranking if total[name] <= EQUAL * total[self.ranking[0]])

    @property
    def _drawn_first(self) -> tuple[str, ...]:
        """A few estimators that are drawn at once: the best, the best without a model, and those best known."""
        free = [name for name in self.ranking if name not in INFORMED][:1]
        wanted = (self.ranking[0], *free, "intrinsic", "ekf", *self.ranking)
        return tuple(dict.fromkeys(name for name in wanted if name in self.outcomes))[:DRAWN]

    @property
    def _verdict(self) -> str:
        """Who is best, who is as good, and how far those with the model differ."""
        total, equals = badness(self.outcomes, self.loaded), self._equals
        text = f"{', '.join(equals)} {'are equally good' if len(equals) > 1 else 'is best'}"
        text += f" (within {100 * (EQUAL - 1):.0f} %)" * (len(equals) > 1)
        informed = [total[name] for name in self.ranking if name in INFORMED and np.isfinite(total[name])]
        if len(informed) > len(equals):
            text += f"; the {len(informed)} with the model differ by {max(informed) / min(informed) - 1:.0%}"
        return f"{text}; {len(self.outcomes)} estimators"

    def _rows_by_knowledge(self) -> tuple[dict[str, Any], ...]:
        """The rows of the table, with what each estimator knows."""
        return tuple(
            {"estimator": row["estimator"], "knows": "model" if row["estimator"] in INFORMED else "—"} | row
            for row in self._rows()
        )

    def _cells_without_holes(self, outcome: Outcome) -> dict[str, float]:
        if outcome.score is None or outcome.score.apart is None:
            return {}
        return self.loaded.kind.estimates.called("RMSE {} without holes").cells(outcome.score.apart.rmse)

    def _rows(self) -> tuple[dict[str, str | float], ...]:
        """The rows of the printed table, with units in their headings."""
        loaded, kind = self.loaded, self.loaded.kind
        labels = (kind.estimates if loaded.reference else kind.measured).called("RMSE {}")
        return tuple(
            {
                "estimator": name,
                **labels.cells(rmse(outcome)),
                **self._cells_without_holes(outcome),
                **consistency(outcome),
                "µs a sample": round(outcome.microseconds, 1),
            }
            for name, outcome in self.outcomes.items()
        )


def line_up(
    loaded: Loaded, trial: Trial | None, tuned_on: Bool[np.ndarray, "T"]
) -> tuple[dict[str, AbstractObserver], str]:
    """Tune all observers that fit a model."""
    kind, sheet = loaded.kind, functools.cache(lambda: log_sheet(loaded.file, loaded))
    note = kind.note(sheet, loaded.rate) + loaded.note
    if trial is not None:
        begin, end = np.asarray(loaded.record.t)[tuned_on][[0, -1]] - np.asarray(loaded.record.t)[0]
        note += (
            f" Filters that know no model are those that are best from {begin:.3g} to {end:.3g} s of this very log, "
            "the first third that moves with the fewest faults, or all of a short log."
        )
    note += kind.gates
    tuned = kind.tuned(sheet, loaded.rate, estimators(loaded.model), trial)
    return with_sensor_delays(tuned, loaded), note


def scored_against(loaded: Loaded) -> str:
    """Name what errors are computed against."""
    return "outputs, one sample ahead" if loaded.reference is None else loaded.reference.label


def rows_that_count(loaded: Loaded) -> str:
    """Say which rows the errors of a table are of."""
    t = np.asarray(loaded.record.t) - np.asarray(loaded.record.t)[0]
    if loaded.reference is None:
        count, begin = len(t) - len(t) // 10, t[len(t) // 10]
        return f"Errors are those of {count} of {len(t)} rows, from {begin:.3g} s on."
    at = np.flatnonzero(loaded.reference.scored)
    return f"Errors are those of {len(at)} of {len(t)} rows, from {t[at[0]]:.4g} to {t[at[-1]]:.4g} s."


def without_holes(outcomes: dict[str, Outcome], loaded: Loaded) -> tuple[str, ...] | None:
    """Order of the estimators without the rows in and after holes; None where the log has none, or nothing else."""
    apart = {name: outcome.score and outcome.score.apart for name, outcome in outcomes.items()}
    if loaded.holes is None or any(score is None for score in apart.values()):
        return None
    return tuple(rank({name: outcome._replace(score=apart[name]) for name, outcome in outcomes.items()}, loaded))


EQUAL = 1.03
"""Ratio of errors up to which estimators are called equally good."""
DRAWN = 4
"""Curves that a page of a comparison shows at first."""


def rank(outcomes: dict[str, Outcome], loaded: Loaded) -> list[str]:
    """Order estimators by error, diverged ones last."""
    return sorted(outcomes, key=badness(outcomes, loaded).__getitem__)


def badness(outcomes: dict[str, Outcome], loaded: Loaded) -> dict[str, float]:
    """Errors relative to the motion, as one number for each estimator; ∞ where it diverged."""
    reference = loaded.reference
    scale = np.nanstd(np.asarray(loaded.record.y), axis=0)
    if reference is not None:
        scale = np.sqrt(np.mean(reference.v[reference.scored] ** 2, axis=0))
    size = np.where(scale > 0, scale, 1.0)  # a column at rest has no size to divide by
    totals = {name: float(np.sqrt(np.mean((rmse(each) / size) ** 2))) for name, each in outcomes.items()}
    # NaN compares as neither smaller nor larger, which would leave the order undefined.
    return {name: total if np.isfinite(total) else math.inf for name, total in totals.items()}


def rmse(outcome: Outcome) -> np.ndarray:
    """Root mean square errors that estimators are ranked by."""
    if outcome.score is not None:
        return outcome.score.rmse
    innovation = np.asarray(outcome.run.info.innovation)
    # The first tenth is left out: the estimate starts at rest and still converges.
    return np.sqrt(np.mean(innovation[len(innovation) // 10 :] ** 2, axis=0))


def consistency(outcome: Outcome) -> dict[str, float]:
    """NIS and NEES of an outcome, normalised squares of innovations and of velocity errors.

    1 is expected of each; NaN stands for an estimator without a covariance, and for NEES also without a reference.
    """
    return {"NIS": outcome.nis, "NEES": math.nan if outcome.score is None else outcome.score.nees}


def _engines(outcomes: dict[str, Outcome]) -> list[str]:
    """Which engine computed what, a line for each."""
    by: dict[str, list[str]] = {}
    for name, outcome in outcomes.items():
        by.setdefault(outcome.engine, []).append(name)
    return [f"engine of {', '.join(names)}: {engine}" for engine, names in by.items()]
