"""Compares a log with a model, before anybody estimates from the log.

The model's accelerations along the smoothed log are compared with the measured ones. The remainder shows whether the
log is in the units, order and signs of the model, and whether every column was measured at its stamps.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from covariant.calibration.diagnosis import _sensor
from covariant.calibration.diagnosis._alternatives import (
    HELD_OUT,
    Blocks,
    inputs_between_rows,
    moved_rows,
    row_shift,
    signed_ranks,
)
from covariant.calibration.diagnosis._case import (
    Case,
    acting,
    best_window,
    busiest,
    case_without_outliers,
    changed,
    clearly,
    compared,
    in_coordinates,
    long_enough,
    names_of,
    smoothed,
)
from covariant.calibration.diagnosis._changes import Change, structure_changes, unit_changes
from covariant.calibration.diagnosis._clock import set_forward
from covariant.calibration.diagnosis._delays import Corrected, Stated, delay_findings
from covariant.calibration.diagnosis._finding import Diagnosis, Finding
from covariant.calibration.diagnosis._missing_torques import missing_torques
from covariant.calibration.diagnosis._readings import readings
from covariant.calibration.diagnosis._residual import Residual, residual
from covariant.calibration.diagnosis._sensor_checks import sensor_checks
from covariant.calibration.diagnosis._sensor_findings import sensor_findings, standstill
from covariant.calibration.diagnosis._sensor_motion import Beside
from covariant.calibration.diagnosis._smooth import Smooth, held_inputs, smooth
from covariant.calibration.diagnosis._twin import twin
from covariant.models import ModelFile
from covariant.scoring import unwrap
from covariant.signals import Record

MOST_ROWS = 10_000
"""Largest number of rows that are compared with the model: the stretch with most motion."""
FEW_ROWS = 4_000
"""The same for the check before an estimate."""
SHIFTED = (1.0, 2.0, 4.0)
"""Half windows to look for shifts by whole rows in, in those that explain most."""
FITS = 0.15
"""Unexplained fraction of the accelerations up to which no other reading of the log is tried."""
BARELY = 0.5
"""Unexplained fraction from which a log is refused."""
MARGIN = 4.0
"""Factor by which the unexplained fraction must fall before a change is accepted."""
BLOCKS = 30
SIGNIFICANT = 4.0
"""Standard errors of the signed ranks of its falls in these blocks of the log, from which it counts (all fall: 4.8)."""
RIVAL = 1.5
"""Ratio to the best unexplained fraction up to which another change is named beside the best."""
FARTHEST = 3.0
"""Largest residual acceleration, as a multiple of the one that the data sheet states."""
TWIN = 2.0
"""Part of the accelerations that is left, as a multiple of that in a log of the model itself, from which it counts."""
MOST_CHANGES = 3
WEIGHTS = (
    *(
        "clock",
        "nothing moves",
        "unit of",
        "swapped",
        "sign of",
        "axes of",
        "sensor",
        "zero of",
        "model",
        "friction",
        "rotor inertia",
        "too little motion",
        "delay",
        "row shift",
    ),
    *("scale of", "inputs between"),
    *("uncertainty", "noise", "ticks", "repeated", "outliers", "a position", "bias of"),
)
"""How findings begin, in the order of what they invalidate: a wrong unit or order makes all numbers below it wrong."""


def diagnose(
    file: ModelFile,
    record: Record,
    quantum: float | tuple[float, ...] | None = None,
    first_row: int = 1,
    every: int = 1,
    sensors: Sequence[Beside] = (),
) -> Diagnosis:
    """Compare a log with a model, and report what is wrong with the log, or with the model file for it.

    Args:
        file: The model and its data sheet. For a machine that is not in coordinates, and for a `StateSpace`, only the
            stamps and missing measurements are checked.
        record: The log as it was read, without a lag of the inputs. Of more than `MOST_ROWS` rows, the stretch in which
            the positions move most is compared with the model.
        quantum: One tick of the encoders that the model file states, or one for each coordinate, where `file` no longer
            has it.
        first_row: Row of the file, counted from 1, at which the record begins; messages count from it.
        every: The record has each `every`-th row of the file.
        sensors: Sensors beside the positions with their readings in the rows of the record, which are judged by what
            the positions predict of them; of a machine that is not in coordinates they are not.

    Returns:
        The findings, sorted by what they invalidate: those first that make others meaningless. A log that fits has none
        that is `wrong`.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import diagnose
        >>> from covariant.models import load
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> y = 0.2 * np.cos(t) + 1e-4 * np.random.default_rng(0).normal(size=1000)
        >>> diagnose(load("oscillator"), Record(t, np.zeros((1000, 1)), y[:, None])).findings
        ()
    """
    findings, checks = _findings(file, record, quantum, _sensor.Rows(np.asarray(record.t), first_row, every), sensors)
    return Diagnosis(tuple(sorted(findings, key=_weight)), checks)


def _weight(finding: Finding) -> tuple[bool, int]:
    """Sort key of a finding: wrong ones first, and among them those that make others meaningless."""
    place = next((k for k, begin in enumerate(WEIGHTS) if finding.what.startswith(begin)), len(WEIGHTS))
    return not finding.wrong, place


def _findings(
    file: ModelFile,
    record: Record,
    quantum: float | tuple[float, ...] | None,
    rows: _sensor.Rows,
    sensors: Sequence[Beside],
) -> tuple[list[Finding], tuple[str, ...]]:
    """All findings, unsorted, and the names of the checks."""
    findings = [*_sensor.stamps(rows.t), *_sensor.missing_cells(np.asarray(record.y))]
    checks = ("clock", "missing rows", "irregular stamps", "missing measurements")
    if not in_coordinates(file):
        return findings, checks
    checks += ("outliers", "repeated rows", "ticks", "noise")
    y, names = np.asarray(record.y), names_of(file)
    quantum = file.quantum if quantum is None else quantum
    still, whole = _sensor.still_findings(y, names.q, names.units)
    if whole:
        return [*findings, *still], checks
    case, outliers = case_without_outliers(file, record, rows, quantum)
    ticks = case.ticks
    repeated = _sensor.repeated_findings(y, ticks, names.q, rows)
    if any(each.wrong for each in repeated):
        case = case._replace(record=case.record._replace(y=_sensor.without_repeated(np.asarray(case.record.y), ticks)))
    case = case._replace(record=busiest(case.record, MOST_ROWS))
    changes, case, factor = _corrected(case)
    if (factor != 1).any():
        # Angles in another unit jump at other places, so the readings are looked at anew, in that of the model.
        y = y * factor
        again, outliers = case_without_outliers(file, record._replace(y=y), rows, quantum)
        ticks = again.ticks
        repeated = _sensor.repeated_findings(y, ticks, names.q, rows)
    noise = np.maximum(np.nan_to_num(readings(record._replace(y=y), case.model.circles).std), ticks)
    forward = set_forward(rows.t, unwrap(y, case.model.circles), noise, rows)
    findings += [*forward, *still, *outliers, *repeated, *changes]
    # In another unit of time the readings have other rates too: they are judged once it is right.
    sensors = () if any(each.what == "unit of time" for each in changes) else sensors
    checks += ("sensors beside the positions",) if sensors else ()
    best = best_window(case)
    if best is None or not best[1].told.any():
        return [
            *findings,
            *_sensors(case, quantum),
            *sensor_checks(case, rows.t, sensors),
            standstill(case.record, case.model.circles, case.names, case.ticks),
        ], checks
    checks += (
        *("units", "order and signs of columns", "scales of inputs", "delays"),
        *("friction and rotor inertia", "accelerations"),
    )
    delays, corrected = _delays(case, best[0])
    missing = missing_torques(case.model, smoothed(case, best[0]))
    if missing is not None and missing.after < Blocks.of(corrected.left, best[1]).beyond_noise(HELD_OUT):
        # Friction looks like a delay and like a scale of an input, so these are looked for in the model that has it.
        wrong = best[1].misfit > BARELY or bool(_unexplained(case, best[1], best[0]))
        findings.append(missing.finding(case.names, case.model, file.system, wrong))
        case = case._replace(model=missing.model)
        delays, corrected = _delays(case, best[0])
    shifted, inputs = _rows_and_inputs(case, corrected, best[0], not any(each.what == "delay" for each in delays))
    # Readings of a column that is rows late are those of a sensor only in their own rows.
    moved = _with_rows_moved(case, corrected.rows + np.array([_rows_late(shifted, name) for name in case.names.q]))
    unexplained = [] if shifted or inputs else _unexplained(case, corrected.left, best[0])
    beside = sensor_checks(case, rows.t, sensors, corrected.delay - corrected.delay.min())
    return [*findings, *_sensors(moved, quantum), *beside, *delays, *shifted, *inputs, *unexplained], checks


def _delays(case: Case, half: float) -> tuple[list[Finding], Corrected]:
    """Findings on delays and scales of inputs, and the log without these."""
    file = case.file
    return delay_findings(
        case.model,
        case.names,
        case.spacing,
        Stated(np.broadcast_to(np.asarray(file.delay, float), len(case.names.q)), file.input_lag),
        lambda delay, rows: smoothed(_with_rows_moved(case, rows), half, delay),
    )


def _rows_late(found: list[Finding], name: str) -> int:
    return next((int(each.numbers["rows"]) for each in found if each.where == name), 0)


def _with_rows_moved(case: Case, rows: np.ndarray) -> Case:
    if not rows.any():
        return case
    return case._replace(record=case.record._replace(y=moved_rows(np.asarray(case.record.y), rows)))


def _rows_and_inputs(case: Case, corrected: Corrected, half: float, rows: bool) -> tuple[list[Finding], list[Finding]]:
    """Findings on a column that is whole rows late, if `rows`, and on how inputs go from row to row; at most one.

    Wider windows show smaller shifts in time, as far as they do not smooth the motion away.
    """
    file = case.file
    for wide in (w * half for w in SHIFTED):
        if not long_enough(case, wide):
            break

        def of_rows(rows: np.ndarray, wide: float = wide) -> tuple[Smooth, Residual]:
            log = smoothed(_with_rows_moved(case, rows), wide, corrected.delay)
            log = log._replace(u=log.u * corrected.scale)
            return log, residual(case.model, log)

        log, before = of_rows(np.zeros(len(case.names.q), int))

        def of_inputs(record: Record, log: Smooth = log) -> Residual:
            u = held_inputs(np.asarray(record.t), np.asarray(record.u), log.t, log.step) * corrected.scale
            return residual(case.model, log._replace(u=u))

        stated = file.input_between, file.input_delay, file.input_lag
        shift = row_shift(case.names, before, lambda rows: of_rows(rows)[1]) if rows else None
        inputs = inputs_between_rows(case.names, case.record, stated, before, of_inputs)
        if shift is not None and inputs is not None:
            first = shift.numbers["unexplained_after"] <= inputs.numbers["unexplained_after"]
            shift, inputs = (shift, None) if first else (None, inputs)
        if shift is not None or inputs is not None:
            return [shift] if shift else [], [inputs] if inputs else []
    return [], []


def misfit(file: ModelFile, record: Record) -> Finding | None:
    """Reason why a log is useless for a model: other units, or a motion that the model does not explain.

    At most `FEW_ROWS` rows of the record are compared, in a fraction of the time of an estimate.

    Args:
        file: The model and its data sheet.
        record: The log as it was read.

    Returns:
        The finding. None where the model explains the accelerations, where they do not exceed the noise, and where the
        model is not in coordinates.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import misfit
        >>> from covariant.models import load
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> y = 0.2 * np.cos(t) + 1e-4 * np.random.default_rng(0).normal(size=1000)
        >>> misfit(load("oscillator"), Record(1e3 * t, np.zeros((1000, 1)), y[:, None])).line
        '[units] t = "ms"'
    """
    if not in_coordinates(file):
        return None
    case, _ = case_without_outliers(file, busiest(record, FEW_ROWS))
    unchanged = compared(case)
    if unchanged is not None and unchanged.told.any() and unchanged.misfit < BARELY:
        return None
    better = _best_change(
        case, unchanged, ((change, compared(changed(case, change))) for change in _units(case)), BARELY
    )
    if better is not None:
        return better[0]
    findings = [each for each in _unexplained(case, unchanged) if each.what == "model"] if unchanged else []
    if not findings:
        return None
    log = clearly(case)
    missing = None if log is None else missing_torques(case.model, log)
    return findings[0] if missing is None else missing.finding(case.names, case.model, file.system, True)


def _sensors(case: Case, stated: float | tuple[float, ...] | None) -> list[Finding]:
    return sensor_findings(case.record, case.model.circles, case.names, stated, case.file.measurement_std)


def _units(case: Case) -> Iterable[Change]:
    return unit_changes(case.names, case.record)


def _corrected(case: Case) -> tuple[list[Finding], Case, np.ndarray]:
    """Findings on wrong units, orders and signs, the case after these corrections, and the units of its positions.

    The latter are factors (n,) of the positions as they stand in the log.
    """
    findings, factor = [], np.ones(len(case.names.q))
    # One after another: in wrong units a swap of columns explains nothing.
    for _ in range(MOST_CHANGES):
        unchanged = compared(case)
        if unchanged is not None and unchanged.told.any() and unchanged.misfit < FITS:
            break
        # Units may change the time axis, so the log is smoothed anew; the other changes act on the smoothed log.
        tried = [(change, compared(changed(case, change))) for change in _units(case)]
        log = clearly(case)
        if log is not None:
            tried += [(change, residual(case.model, change.of_smooth(log))) for change in structure_changes(case.names)]
        better = _best_change(case, unchanged, tried, BARELY)
        if better is None:
            break
        findings.append(better[0])
        case = changed(case, better[1])
        if better[1].what.startswith("unit of") and (better[1].order == np.arange(len(factor))).all():
            factor = factor * better[1].position
    return findings, case, factor


def _best_change(
    case: Case, unchanged: Residual | None, tried: Iterable[tuple[Change, Residual | None]], most: float
) -> tuple[Finding, Change] | None:
    """The first change that explains nearly most, if it leaves less than `most` and far less than the record itself."""
    fitting = [(left.misfit, change, left) for change, left in tried if left is not None and left.told.any()]
    fitting = [entry for entry in fitting if entry[0] < most]
    if not fitting:
        return None
    least = min(entry[0] for entry in fitting)
    alike = [entry for entry in fitting if entry[0] <= RIVAL * least]
    # Of changes that explain about as much the first listed one is reported, and the others are named as rivals.
    _, change, left = alike[0]
    share_before, improved = float("nan"), 0
    if unchanged is not None:
        falls = (unchanged.misfits(BLOCKS) - left.misfits(BLOCKS))[:, left.told].mean(axis=1)
        share_before, improved = float(unchanged.misfits()[0, left.told].mean()), int((falls > 0).sum())
        # The fall has to be large, and in so many parts of the log that it is no chance.
        if share_before < MARGIN * left.misfit or signed_ranks(falls) < SIGNIFICANT:
            return None
    if unchanged is None:
        evidence = (
            "as the log is, it lasts too short a time to compare accelerations; of their squares the model leaves "
        )
        evidence += f"{_percent(left.misfit)} with {change.words}"
    else:
        evidence = (
            f"of the squares of the accelerations the model leaves {_percent(share_before)} as the log is, and "
            f"{_percent(left.misfit)} with {change.words}, less in {improved} of {BLOCKS} parts of the log"
        )
    rivals = [other.words for _, other, _ in alike[1:]]
    if rivals:
        evidence += f"; the log cannot tell it from {', or '.join(rivals)}"
    numbers = {"unexplained": share_before, "unexplained_after": left.misfit, "parts": improved}
    return Finding(change.what, change.where, evidence, change.line, True, numbers), change


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if np.isfinite(share) else "all"


def _unexplained(case: Case, left: Residual, half: float | None = None) -> list[Finding]:
    """A finding where the residual accelerations exceed what the data sheet states.

    `half` is the half width of the windows of `left`, by default that of `clearly`.
    """
    file, names, clear = case.file, case.names, left.told
    if not clear.any():
        return []
    # Noise is independent of what the model leaves, so the variances subtract; by chance the rest may be negative.
    squares = np.mean(left.left**2, axis=0) - left.noise**2
    size = np.sqrt(np.maximum(squares, 0.0))
    stated = file.acceleration_std
    beyond = clear & (size > FARTHEST * (stated or 0.0))
    if not beyond.any() or (stated is None and left.misfit < BARELY):
        return []
    usual = _left_by_a_right_model(case, half)
    if usual is not None and not (_part_left(left)[beyond] > TWIN * _part_left(usual)[beyond]).any():
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


def _part_left(left: Residual) -> np.ndarray:
    """What the model leaves of the accelerations (n,), the noise included, as a fraction of their squares."""
    return np.mean(left.left**2, axis=0) / np.maximum(np.mean(left.measured[left.used] ** 2, axis=0), 1e-300)


def _left_by_a_right_model(case: Case, half: float | None) -> Residual | None:
    """The residual of a log that the model itself makes, smoothed in the same way; None where there is none."""
    log = clearly(case) if half is None else smoothed(case, half)
    made = None if log is None else twin(case.model, log, acting(case), case.ticks)
    if made is None or log is None:
        return None
    # Its inputs act as they stand; its positions are not late.
    left = residual(case.model, smooth(made, log.half, case.model.circles, 0.0, case.ticks))
    return left if left.used.any() else None
