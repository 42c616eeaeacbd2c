"""The page of estimates on one log."""

import abc
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

import covariant
from covariant.models import Motion
from covariant.report import Along, EstimateReport, write_article, write_report
from covariant.signals import StepCode
from covariant.verbs.base.inputs import Job, Loaded
from covariant.verbs.base.outcome import Outcome, deviations, known, pushes, slow_units
from covariant.verbs.base.result import AbstractResult, AbstractTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def estimate_report(
    title: str,
    job: Job,
    loaded: Loaded,
    outcomes: dict[str, Outcome],
    notes: tuple[str, ...],
    facts: Mapping[str, str] = MappingProxyType({}),
    **more: Any,
) -> EstimateReport:
    """Collect what a page of estimates shows, the first of which is the one reported on.

    Args:
        title: Title of the page.
        job: Model and log by name.
        loaded: Both as they were read.
        outcomes: Runs by label.
        notes: Sentences on gains and errors.
        facts: What else stands in the header, by name, such as the observer.
        more: Further fields of the report.
    """
    kind, y, t = loaded.kind, np.asarray(loaded.record.y), np.asarray(loaded.record.t)
    first = next(iter(outcomes.values()))
    curves = _curves(outcomes)
    if more.get("contrast"):  # a smoother has the innovations of its filter
        for name in ("innovation", "innovation_std", "distance"):
            curves[name].pop(more["contrast"], None)
    if not kind.draws_innovations:
        curves = {name: curves[name] for name in ("estimates", "std")}
    report = EstimateReport(
        title=title,
        estimated=kind.what,
        coordinates=kind.axes.names,
        units=kind.axes.units,
        t=t,
        q_measured=kind.drawn(y),
        notes=notes,
        facts=_facts(job, loaded, facts),
        **curves,
    )
    if loaded.reference is not None:
        report = report._replace(v_reference=loaded.reference.v, v_reference_label=loaded.reference.label)
    if len(outcomes) <= MOST_MARKED:
        report = report._replace(marks=_marks(first), along=_along(loaded, first), shaded=_pushed(loaded, first, t))
    else:  # the bands of many would hide each other
        report = report._replace(std={}, innovation_std={})
    return report._replace(**more)


MOST_MARKED = 2
"""Runs of a page up to which rows that were refused, coasted or restarted are marked on the first."""
OFTEN = 0.2
"""Share of the rows from which a mark on each would hide the curve."""
CODES = {"no measurement": StepCode.COASTED, "refused": StepCode.OUTLIER, "restarted": StepCode.RESTARTED}
"""The marks of a page, and the results of the rows that have them."""
FINEST = 500
"""Stretches closer than the log's duration over this are shaded as one."""
MOST_WORDS = 40
"""Words of a command line that the page shows whole."""


def _curves(outcomes: dict[str, Outcome]) -> dict[str, Any]:
    """The curves of several runs by the fields of a report."""
    infos = {name: outcome.run.info for name, outcome in outcomes.items()}
    expected = {name: known(info, "innovation_cov") for name, info in infos.items()}
    return {
        "estimates": {name: _states(outcome) for name, outcome in outcomes.items()},
        "innovation": {name: _used_innovation(outcome) for name, outcome in outcomes.items()},
        "distance": {name: np.asarray(info.distance) for name, info in infos.items() if "distance" in info._fields},
        "std": {name: std for name, info in infos.items() if (std := deviations(info)) is not None},
        "innovation_std": {
            name: np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) for name, cov in expected.items() if cov is not None
        },
    }


def _states(outcome: Outcome) -> np.ndarray:
    """The curves to draw: states in coordinates (T, 2n), velocities (T, n) where the estimate is on a group."""
    x = outcome.run.estimate
    return outcome.velocity if isinstance(x, Motion) else np.asarray(x)


def _used_innovation(outcome: Outcome) -> np.ndarray:
    """The innovations, NaN in rows without a measurement."""
    innovation = np.array(outcome.run.info.innovation, float)
    innovation[np.asarray(outcome.run.info.result) == StepCode.COASTED] = np.nan
    return innovation


def _marks(outcome: Outcome) -> dict[str, np.ndarray]:
    result = np.asarray(outcome.run.info.result)
    rows = {name: result == code for name, code in CODES.items()}
    return {name: each for name, each in rows.items() if 0 < each.mean() < OFTEN}


def _along(loaded: Loaded, outcome: Outcome) -> Along | None:
    slow, std = (known(outcome.run.info, name) for name in ("slow", "slow_std"))
    if slow is None or std is None or not outcome.slow_names or slow.shape != std.shape:
        return None
    units = slow_units(loaded)
    return Along(outcome.slow_names, tuple(units.get(name, "") for name in outcome.slow_names), slow, std)


def _pushed(loaded: Loaded, outcome: Outcome, t: np.ndarray) -> np.ndarray | None:
    """Begin and end [s] of the stretches in which something pushes."""
    pushed = pushes(loaded.file, outcome)
    if pushed is None or not pushed.rows.any():
        return None
    edges = np.diff(np.concatenate([[0], pushed.rows.astype(int), [0]]))
    begin, end = t[np.flatnonzero(edges > 0)], t[np.flatnonzero(edges < 0) - 1]
    apart = begin[1:] - end[:-1] > (t[-1] - t[0]) / FINEST
    return np.stack([begin[np.concatenate([[True], apart])], end[np.concatenate([apart, [True]])]], axis=1)


def _facts(job: Job, loaded: Loaded, more: Mapping[str, str]) -> dict[str, str]:
    """What a page says first: the machine, the log, what was computed by what, and when."""
    t, y = np.asarray(loaded.record.t), np.asarray(loaded.record.y)
    missing = int(np.isnan(y.reshape(len(y), -1)).any(1).sum())
    gaps = "none" if loaded.holes is None else str(loaded.holes)
    return {
        "model": f"{job.model_name} ({', '.join(loaded.kind.axes.names)})",
        "log": f"{job.log_name}, {len(t)} rows, {t[-1] - t[0]:.4g} s at {loaded.rate:.4g} Hz",
        "missing": f"{missing} rows without a measurement; holes: {gaps}",
        **more,
        **made(),
    }


def made() -> dict[str, str]:
    """By what a page was made: version, time, and the command line where there was one."""
    named = {"made by": f"covariant {covariant.__version__}, {time.strftime('%Y-%m-%d %H:%M %Z')}"}
    words = [shlex.quote(word) for word in ("covariant", *sys.argv[1:])]
    if len(words) > MOST_WORDS:  # hundreds of logs, which the page lists itself
        words[6:-4] = [f"… ({len(words) - 10} more) …"]
    return named | ({"command": " ".join(words)} if Path(sys.argv[0]).stem == "covariant" else {})


def accuracy(loaded: Loaded, outcome: Outcome) -> tuple[dict[str, Any], ...]:
    """How good each velocity or state is, as rows of a table: errors, lag, and what the filter claims."""
    kind, score, reference = loaded.kind, outcome.score, loaded.reference
    std, rows, t = deviations(outcome.run.info), [], np.asarray(loaded.record.t)
    lags = None if reference is None else lag(t, outcome.velocity, reference.v, reference.scored)
    for i, heading in enumerate(kind.estimates.headings):
        row: dict[str, Any] = {kind.what: heading}
        if score is not None:
            row |= {"RMSE": score.rmse[i], "median error": score.median[i]}
        if lags is not None and kind.what == "velocity":
            row["lag [ms]"] = round(1e3 * lags[i], 2)
        if std is not None:
            row["median σ"] = float(np.nanmedian(std[:, i]))
        if std is not None and reference is not None:
            off = np.abs(outcome.velocity[:, i] - reference.v[:, i])[reference.scored]
            row["within ±2σ [%]"] = round(100 * float(np.mean(off <= 2 * std[reference.scored, i])), 1)
        rows.append(row)
    return tuple(rows) if rows and len(rows[0]) > 1 else ()


def lag(t: np.ndarray, estimate: np.ndarray, reference: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Time (n,) [s] by which estimates follow a reference, by least squares: to first order e = −τ dv/dt."""
    slope = np.gradient(reference, t, axis=0)
    error = estimate - reference
    fine = rows[:, None] & np.isfinite(slope) & np.isfinite(error)
    slope, error = np.where(fine, slope, 0.0), np.where(fine, error, 0.0)
    power = np.sum(slope**2, axis=0)
    return np.where(power > 0, -np.sum(error * slope, axis=0) / np.where(power > 0, power, 1.0), np.nan)


def write_result_page(
    path: Path,
    title: str,
    result: AbstractResult,
    blocks: Sequence[Any],
    facts: Mapping[str, str] = MappingProxyType({}),
    drawn: bool = False,
) -> list[Path]:
    """Write a page of text, tables and the figure, if any, of a result, with the header that all pages have."""
    figures = [path.with_suffix(".png")] if drawn else []
    for figure in figures:
        result.plot(figure)
    page = write_article(title, [*figures, *blocks], path, result.headline, result.warnings, {**facts, **made()})
    return [page, *figures]


class AbstractEstimates(AbstractTable):
    """Table of estimates, which is drawn on one page."""

    def _write_page(self, path: Path) -> list[Path]:
        return write_report(self._page(), path)

    def _figure(self) -> "Figure":
        from covariant.report import figure

        return figure(self._page())

    @property
    def _blocks(self) -> Sequence[Any]:
        page = self._page()
        lines = [*([page.facts["design"]] if "design" in page.facts else []), *page.notes]
        return [page.rows, *lines] if page.rows else []

    @abc.abstractmethod
    def _page(self) -> Any:
        """What the page and the figures show."""
