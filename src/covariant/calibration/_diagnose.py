"""Compares a log with a model, before anybody estimates from it.

The model's accelerations along the smoothed log are compared with the measured ones. What it leaves says whether the
log is in the units, the order and the signs that the model is written in, and whether all of it was measured when its
stamps say.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from covariant.calibration import _sensor
from covariant.calibration._changes import Change, Names, structure_changes, unit_changes
from covariant.calibration._delays import Stated, delay_findings
from covariant.calibration._finding import Diagnosis, Finding
from covariant.calibration._readings import one_or_each, readings, shown, written
from covariant.calibration._residual import CLEAR, Residual, residual
from covariant.calibration._smooth import FEWEST, ORDER, Smooth, smooth
from covariant.models import MechanicalSystem, ModelFile
from covariant.scoring import unwrap
from covariant.signals import Record, acting_inputs, lag_inputs

MOST_ROWS = 10_000
"""Rows of the log that are compared with the model: the stretch in which most moves."""
FEW_ROWS = 4_000
"""The same for the check before an estimate."""
SHORTEST = 6.0
"""Length of a log that is compared with the model, in half windows."""
WINDOWS = (1.0, 2.0, 3.0)
"""Half windows that are tried, in those of the reference of the model file; that is kept which explains most."""
WIDER = (2.0, 4.0, 8.0, 16.0)
"""The same until accelerations are more than noise, as they are late in a slow motion."""
FITS = 0.15
"""Largest unexplained fraction of the accelerations with which no other reading of the log is looked for."""
BARELY = 0.5
"""Unexplained fraction from which a log is refused."""
MARGIN = 4.0
"""What is unexplained must fall by this factor before a change is believed."""
BLOCKS = 30
SIGNIFICANT = 4.0
"""Standard errors of the signed ranks of its falls in so many blocks of the log, from which it is (all fall: 4.8)."""
RIVAL = 1.5
"""A change that leaves at most so many times as much as the best one is named beside it."""
FARTHEST = 3.0
"""Largest acceleration that the model may leave, as a multiple of what the data sheet states."""
NOISIER = 4.0
"""Measured noise, as a multiple of that of the data sheet, that is a finding."""
MOST_CHANGES = 3
WEIGHTS = (
    *("nothing moves", "unit of", "swapped", "sign of", "zero of", "model", "too little motion", "delay", "scale of"),
    *("uncertainty", "noise", "ticks", "repeated", "outliers", "a position"),
)
"""How findings begin, in the order of what they spoil: a wrong unit or order makes all numbers below it wrong."""


class _Case(NamedTuple):
    """A record in coordinates, without outliers, and what it is compared with."""

    file: ModelFile
    model: MechanicalSystem
    names: Names
    record: Record

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(np.asarray(self.record.t))))


def diagnose(
    file: ModelFile,
    record: Record,
    quantum: float | tuple[float, ...] | None = None,
    first_row: int = 1,
    every: int = 1,
) -> Diagnosis:
    """Compare a log with a model: what is wrong with the log, or with the model file for it.

    Args:
        file: The model and its data sheet. For a machine that is not in coordinates, and for a `StateSpace`, only the
            stamps and missing measurements are looked at.
        record: The log as it was read, without a lag of the inputs. Of more than `MOST_ROWS` rows, the stretch in which
            most moves is compared with the model.
        quantum: One tick of the encoders that the model file states, or one for each coordinate, where `file` no longer
            has it.
        first_row: The row of the file, counted from 1, that the record begins with, by which rows are named.
        every: The record has each so-many-th row.

    Returns:
        The findings, those that spoil most first. A log that fits has none that is `wrong`.
    """
    found, looked = _findings(file, record, quantum, _sensor.Rows(np.asarray(record.t), first_row, every))
    return Diagnosis(tuple(sorted(found, key=_weight)), looked)


def _weight(finding: Finding) -> tuple[bool, int]:
    """By what findings are sorted: those that are wrong first, and those first that make others meaningless."""
    place = next((k for k, begin in enumerate(WEIGHTS) if finding.what.startswith(begin)), len(WEIGHTS))
    return not finding.wrong, place


def _findings(
    file: ModelFile, record: Record, quantum: float | tuple[float, ...] | None, rows: _sensor.Rows
) -> tuple[list[Finding], tuple[str, ...]]:
    """The findings as they come, and what was looked for."""
    found = [*_sensor.stamps(rows.t), *_sensor.missing_cells(np.asarray(record.y))]
    looked = ("missing rows", "irregular stamps", "missing measurements")
    if not in_coordinates(file):
        return found, looked
    looked += ("outliers", "repeated rows", "ticks", "noise")
    y, names = np.asarray(record.y), _names(file)
    still, whole = _sensor.still_findings(y, names.q, names.units)
    if whole:
        return [*found, *still], looked
    case, outliers = case_without_outliers(file, record, rows)
    repeated = _sensor.repeated_findings(y, readings(case.record, case.model.circles).ticks, names.q, rows)
    case = case._replace(record=busiest(case.record, MOST_ROWS))
    changes, case = _put_right(case)
    found += [*still, *outliers, *repeated, *changes, *_sensors(case, file.quantum if quantum is None else quantum)]
    best = best_window(case)
    if best is None or not best[1].told.any():
        return [*found, _standstill(case)], looked
    looked += ("units", "order and signs of columns", "scales of inputs", "delays", "accelerations")
    delays, now = delay_findings(
        case.model,
        case.names,
        case.spacing,
        Stated(np.broadcast_to(np.asarray(file.delay, float), len(case.names.q)), file.input_lag),
        lambda delay: _smoothed(case, best[0], delay),
    )
    return [*found, *delays, *_unexplained(file, case.names, now)], looked


def misfit(file: ModelFile, record: Record) -> Finding | None:
    """What makes a log useless for a model: other units, or a motion that the model has nothing to do with.

    None where the model explains the accelerations, where they cannot be told from noise, and where the model is not
    in coordinates. It looks at `FEW_ROWS` rows of the record at most, and takes a fraction of the time of an estimate.
    """
    if not in_coordinates(file):
        return None
    case, _ = case_without_outliers(file, busiest(record, FEW_ROWS))
    asis = _compared(case)
    if asis is not None and asis.told.any() and asis.misfit < BARELY:
        return None
    better = _best_change(case, asis, ((change, _compared(_changed(case, change))) for change in _units(case)), BARELY)
    if better is not None:
        return better[0]
    found = [finding for finding in _unexplained(file, case.names, asis) if finding.what == "model"] if asis else []
    return found[0] if found else None


def in_coordinates(file: ModelFile) -> bool:
    """Whether the model of a file is a mechanical system in coordinates, so that its accelerations can be compared."""
    return file.mechanical and file.model.manifold.commuting  # pyright: ignore[reportAttributeAccessIssue]


def busiest(record: Record, rows: int) -> Record:
    """The stretch of so many rows of a record in which the positions move most, or all of it where it is shorter."""
    if len(record.t) <= rows:
        return record
    moved = np.nan_to_num(np.abs(np.diff(np.asarray(record.y), axis=0)))
    moved = np.cumsum(np.sum(moved / np.maximum(np.quantile(moved, 0.95, axis=0), 1e-300), axis=1))
    start = int(np.argmax(moved[rows - 1 :] - moved[: len(moved) - rows + 1]))
    return Record(*(np.asarray(a)[start : start + rows] for a in record[:3]))


def _names(file: ModelFile) -> Names:
    n = len(file.columns.q)
    units = file.model.units or ("",) * n
    angles = np.array([unit == "rad" or i in file.model.circles for i, unit in enumerate(units)])
    return Names(file.columns.t, file.columns.q, file.columns.u, units, angles, file.columns.units)


def case_without_outliers(
    file: ModelFile, record: Record, rows: _sensor.Rows | None = None
) -> tuple[_Case, list[Finding]]:
    """The case of a record whose outliers are taken to be missing, and findings about them; `rows` names its rows."""
    model, names = file.need_mechanical(file.name, "accelerations are compared with those of"), _names(file)
    t, y = np.asarray(record.t), np.asarray(record.y)
    far, sizes = _sensor.outliers(t, y, model.circles)
    case = _Case(file, model, names, Record(t, np.asarray(record.u), np.where(far, np.nan, y)))
    return case, _sensor.outlier_findings(far, sizes, names.q, names.units, rows or _sensor.Rows(t))


def _smoothed(case: _Case, half: float, delay: Any = 0.0) -> Smooth:
    file = case.file
    record = acting_inputs(lag_inputs(case.record, file.input_lag), file.input_between, file.input_delay)
    return smooth(record, half, case.model.circles, delay + np.asarray(file.delay, float))


def _long_enough(case: _Case, half: float) -> bool:
    """Whether the record can be smoothed over windows of ±`half` [s]."""
    t, y = np.asarray(case.record.t), np.asarray(case.record.y)
    enough = np.isfinite(y).sum(axis=0).min() > 10 * (ORDER + 1)
    return bool(enough and t[-1] - t[0] >= SHORTEST * max(half, FEWEST * case.spacing))


def _clearly(case: _Case) -> Smooth | None:
    """The record smoothed by the first window in which accelerations are more than noise, or else the widest one.

    None where the record is too short for any.
    """
    log = None
    for half in (w * case.file.reference_half for w in WIDER):
        if not _long_enough(case, half):
            break
        log = _smoothed(case, half)
        if np.any(np.mean(log.a[log.used] ** 2, axis=0) > CLEAR * log.a_noise**2) if log.used.any() else False:
            break
    return log


def _compared(case: _Case) -> Residual | None:
    """What the model leaves of the record; None where that is too short to be smoothed."""
    log = _clearly(case)
    return None if log is None else residual(case.model, log)


def best_window(case: _Case) -> tuple[float, Residual] | None:
    """The half window [s] with which the model explains most, and what it leaves; None where nothing can be told."""
    halves = [half for half in (w * case.file.reference_half for w in WINDOWS) if _long_enough(case, half)]
    tried = [(half, residual(case.model, _smoothed(case, half))) for half in halves]
    if not any(left.told.any() for _, left in tried) and (log := _clearly(case)) is not None:
        tried = [(log.half, residual(case.model, log))]
    known = [(half, left) for half, left in tried if left.told.any()]
    return min(known, key=lambda entry: entry[1].misfit) if known else None


def _units(case: _Case) -> Iterable[Change]:
    return unit_changes(case.names, case.record)


def _changed(case: _Case, change: Change) -> _Case:
    return case._replace(record=change.of_record(case.record), names=case.names.after(change))


def _put_right(case: _Case) -> tuple[list[Finding], _Case]:
    """Findings of units, orders and signs that are wrong, and the case after the changes that they ask for."""
    findings = []
    for _ in range(MOST_CHANGES):
        asis = _compared(case)
        if asis is not None and asis.told.any() and asis.misfit < FITS:
            break
        tried = [(change, _compared(_changed(case, change))) for change in _units(case)]
        log = _clearly(case)
        if log is not None:
            tried += [(change, residual(case.model, change.of_smooth(log))) for change in structure_changes(case.names)]
        better = _best_change(case, asis, tried, BARELY)
        if better is None:
            break
        findings.append(better[0])
        case = _changed(case, better[1])
    return findings, case


def _best_change(
    case: _Case, asis: Residual | None, tried: Iterable[tuple[Change, Residual | None]], most: float
) -> tuple[Finding, Change] | None:
    """The change that explains most, where it leaves less than `most` and far less than the record as it is."""
    fitting = [(left.misfit, change, left) for change, left in tried if left is not None and left.told.any()]
    fitting = [entry for entry in fitting if entry[0] < most]
    if not fitting:
        return None
    least = min(entry[0] for entry in fitting)
    alike = [entry for entry in fitting if entry[0] <= RIVAL * least]
    _, change, left = alike[0]
    then, fallen = float("nan"), 0
    if asis is not None:
        falls = (asis.misfits(BLOCKS) - left.misfits(BLOCKS))[:, left.told].mean(axis=1)
        then, fallen = float(asis.misfits()[0, left.told].mean()), int((falls > 0).sum())
        if then < MARGIN * left.misfit or _signed_ranks(falls) < SIGNIFICANT:
            return None
    if asis is None:
        evidence = (
            "as the log is, it lasts too short a time to compare accelerations; of their squares the model leaves "
        )
        evidence += f"{_percent(left.misfit)} with {change.words}"
    else:
        evidence = (
            f"of the squares of the accelerations the model leaves {_percent(then)} as the log is, and "
            f"{_percent(left.misfit)} with {change.words}, less in {fallen} of {BLOCKS} parts of the log"
        )
    rivals = [other.words for _, other, _ in alike[1:]]
    if rivals:
        evidence += f"; the log cannot tell it from {', or '.join(rivals)}"
    numbers = {"unexplained": then, "unexplained_after": left.misfit, "parts": fallen}
    return Finding(change.what, change.where, evidence, change.line, True, numbers), change


def _signed_ranks(falls: np.ndarray) -> float:
    """Wilcoxon's statistic of differences (b,), as a standard normal: how surely their middle is above zero."""
    count = len(falls)
    ranks = np.argsort(np.argsort(np.abs(falls))) + 1.0
    return float(np.sum(ranks * np.sign(falls)) / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if np.isfinite(share) else "all"


def _sensors(case: _Case, stated: float | tuple[float, ...] | None) -> list[Finding]:
    """Findings about ticks and noise, in the units of the model."""
    seen, names, units = readings(case.record, case.model.circles), case.names.q, case.names.units
    if not seen.known:
        return []
    ticks, findings = seen.ticks, []
    known = np.zeros(len(ticks)) if stated is None else np.broadcast_to(stated, len(ticks))
    other = (ticks > 0) & ~((0.95 * known < ticks) & (ticks < 1.05 * known))
    if other.any():
        counting = [i for i in range(len(ticks)) if ticks[i] > 0]
        apart = shown([ticks[i] for i in counting], [units[i] for i in counting], 5)
        said = f"the model file says {shown(known, units, 4)}" if stated else "the model file does not say so"
        key, number = ("quantum", ticks) if len(counting) == len(ticks) else ("std", seen.std)
        findings.append(
            Finding(
                "ticks",
                ", ".join(names[i] for i in counting),
                f"positions are whole ticks of {apart} apart, and {said}",
                f"[measurement] {key} = {written(one_or_each(number, units, 5))}",
                stated is not None,
                {"quantum": one_or_each(ticks, units, 17), "stated": stated},
            )
        )
    std = case.file.measurement_std
    usual = np.full(len(ticks), np.inf) if std is None else np.broadcast_to(std, len(ticks))
    noisy = (ticks == 0) & seen.white & (seen.noise > NOISIER * usual)
    if noisy.any():
        worst = int(np.argmax(np.where(noisy, seen.noise / usual, 0.0)))
        std = one_or_each(np.where(noisy, seen.noise, usual), units, 2)
        findings.append(
            Finding(
                "noise",
                ", ".join(name for name, bad in zip(names, noisy, strict=True) if bad),
                f"positions have noise of {shown(seen.noise[[worst]], [units[worst]], 3)}, "
                f"{seen.noise[worst] / usual[worst]:.2g} times that of the model file",
                f"[measurement] std = {written(std)}",
                True,
                {"std": float(seen.noise[worst]), "stated": float(usual[worst])},
            )
        )
    return findings


def _standstill(case: _Case) -> Finding:
    """Why nothing can be told of the log by its motion."""
    t, y = np.asarray(case.record.t), unwrap(np.asarray(case.record.y), case.model.circles)
    ranges = [
        f"{name} by {np.nanmax(c) - np.nanmin(c):.3g} {unit}".rstrip()
        for name, c, unit in zip(case.names.q, y.T, case.names.units, strict=True)
    ]
    return Finding(
        "too little motion",
        "",
        f"in {t[-1] - t[0]:.3g} s of {len(t)} rows {', '.join(ranges)} moved: too little or too short to tell an "
        "acceleration from noise",
        "log a motion: nothing can be told of units, signs, order and delays from this log",
        True,
        {"rows": len(t)},
    )


def _unexplained(file: ModelFile, names: Names, left: Residual) -> list[Finding]:
    """A finding where the model leaves more than its data sheet states."""
    told = left.told
    if not told.any():
        return []
    squares = np.mean(left.left**2, axis=0) - left.noise**2
    size = np.sqrt(np.maximum(squares, 0.0))
    stated = file.acceleration_std
    beyond = told & (size > FARTHEST * (stated or 0.0))
    if not beyond.any() or (stated is None and left.misfit < BARELY):
        return []
    worst = int(np.argmax(np.where(beyond, size, 0.0)))
    unit = f"{names.units[worst]}/s²".lstrip("/") if names.units[worst] else ""
    whole = float(np.sqrt(np.mean(left.measured[left.used, worst] ** 2)))
    evidence = (
        f"the model leaves {size[worst]:.3g} {unit} of the {whole:.3g} {unit} with which {names.q[worst]} accelerates; "
        f"{f'its data sheet says {stated:.3g} {unit}' if stated else 'its data sheet says nothing of it'}"
    )
    numbers = {"left": float(size[worst]), "acceleration": whole, "stated": stated, "unexplained": left.misfit}
    if left.misfit > BARELY:
        line = "look at [parameters] and at what the columns are: no other unit, order or sign of the log explains it"
        return [Finding("model", names.q[worst], evidence, line, True, numbers)]
    line = f"[uncertainty] acceleration = {size[worst]:.2g}, or better [parameters]"
    return [Finding("uncertainty", names.q[worst], evidence, line, True, numbers)]
