"""The stages of a diagnosis, in their order: each removes what would hide the faults that the later ones look for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from covariant.calibration.diagnosis._broken_parts import broken_parts
from covariant.calibration.diagnosis._case import (
    Case,
    Residual,
    best_window,
    busiest,
    case_without_outliers,
    in_coordinates,
    long_enough,
    names_of,
    smoothed,
    smoothed_residual,
)
from covariant.calibration.diagnosis._clock import set_forward, stamps
from covariant.calibration.diagnosis._corrections import (
    LATE,
    compare_columns,
    composed,
    correct_columns,
    correct_curves,
    correct_guesses,
)
from covariant.calibration.diagnosis._edges import edge_findings
from covariant.calibration.diagnosis._finding import Finding, Rows
from covariant.calibration.diagnosis._guesses import NUMBERS, other_numbers
from covariant.calibration.diagnosis._jumps import (
    period_findings,
    periods,
    second_sender,
    sender_finding,
    without_full_turns,
)
from covariant.calibration.diagnosis._missing_torques import friction_beside_scales, missing_torques
from covariant.calibration.diagnosis._on_group import clock_findings, group_findings
from covariant.calibration.diagnosis._on_legs import late_encoders
from covariant.calibration.diagnosis._readings import known_ticks, missing_cells, readings, still_findings
from covariant.calibration.diagnosis._repeats import find_repeats, made_rows
from covariant.calibration.diagnosis._sensor_checks import sensor_checks
from covariant.calibration.diagnosis._sensor_findings import NOISIER, sensor_findings, standstill
from covariant.calibration.diagnosis._sensor_motion import Beside
from covariant.calibration.diagnosis._servo_faults import servo_findings
from covariant.calibration.diagnosis._suspicion import judge, unexplained_at
from covariant.calibration.diagnosis._thresholds import BARELY, FEW_ROWS, MOST_ROWS, PLAUSIBLE_OF_SERVOS, THRESHOLDS
from covariant.calibration.diagnosis._timing import Timing, fit_timing, inputs_between_rows, moved_rows, row_shifts
from covariant.calibration.diagnosis._unexplained import constant_inputs, unexplained
from covariant.models import ModelFile
from covariant.models.robots import servos_in
from covariant.observers import on_legs
from covariant.scoring import unwrap
from covariant.signals import Record

SHIFTED = (1.0, 2.0, 4.0)
"""Half-widths of windows in which to look for shifts by whole rows, as multiples of the one that explains most."""
NOISY = 0.01
"""Noise, as a fraction of the deviation of a position, from which a second sender is looked for."""
HELD = 0.2
"""Motion of a command [rad or m] during which friction may hold a joint, which is up to half of it on either side."""
BETTER = 0.5
"""What other numbers of the model leave at most, relative to what a fault leaves, to be the cause instead of it."""


def compared(file: ModelFile) -> tuple[str, ...]:
    """Names of the checks that compare accelerations."""
    torques = f"friction and {file.vocabulary.inertia}"
    return "units", "order and signs of columns", "scales of inputs", "delays", torques, "accelerations"


@dataclass
class Examination:
    """A log, its model, and what the stages have made of them so far.

    Attributes:
        file: The model and its data sheet.
        record: The log as it was read; later stages remove wraps and repair stuck parts.
        quantum: Ticks that the model file states, or None.
        rows: Stamps, and where the rows are in the file.
        sensors: Sensors beside the positions.
        family: Function that makes the family of the model whose numbers may be guesses; None where none may.
        findings: Findings of the stages so far.
        checks: Names of the checks that were made.
        case: The log without outliers, as it is compared with the model.
        as_read: The same with the readings as they are in the log, for what only depends on these.
        wraps: Period at which each position wraps, 0 for none.
        still, outliers, edges, repeated: Findings on the readings, which later stages add or replace.
    """

    file: ModelFile
    record: Record
    quantum: float | tuple[float, ...] | None
    rows: Rows
    sensors: Sequence[Beside]
    family: Callable[[], Any] | None = None
    findings: list[Finding] = field(default_factory=list)
    checks: tuple[str, ...] = ("clock", "missing rows", "irregular stamps", "missing measurements")
    case: Case = field(init=False)
    as_read: Case = field(init=False)
    wraps: np.ndarray = field(init=False)
    still: list[Finding] = field(default_factory=list)
    outliers: list[Finding] = field(default_factory=list)
    edges: list[Finding] = field(default_factory=list)
    repeated: list[Finding] = field(default_factory=list)

    @property
    def y(self) -> np.ndarray:
        """Readings (T, n) of the record."""
        return np.asarray(self.record.y)

    def drop(self, *names: str) -> None:
        """Drop findings that another one explains."""
        self.findings = [each for each in self.findings if each.what not in names]


Stage = Callable[[Examination], bool]
"""A stage examines the log, and returns True to end the examination."""


def look_at_clock(log: Examination) -> bool:
    """Stamps and missing cells."""
    log.findings += [*stamps(log.rows.t), *missing_cells(log.y)]
    return False


def look_without_coordinates(log: Examination) -> bool:
    """The whole examination of a machine that is not in coordinates: a body on a group, a robot on legs."""
    if in_coordinates(log.file):
        return False
    if not log.file.mechanical:
        late = late_encoders(log.file, log.record) if on_legs(log.file.model) else None
        log.findings += late or []
        log.checks += () if late is None else ("delays",)
        return True
    model: Any = log.file.model
    on_group = group_findings(model, log.record, log.file.columns.t, log.rows)
    clock = [] if any(each.what == "unit of time" for each in on_group) else log.findings
    log.findings = [*on_group, *clock]
    log.checks += ("unit of time", "repeated rows")
    return True


def look_for_rest(log: Examination) -> bool:
    """Positions that stand still in the whole log."""
    log.checks += ("periods", "several senders", "outliers", "repeated rows", "ticks", "noise")
    names = names_of(log.file)
    log.still, whole = still_findings(log.y, names.q, names.units)
    servos: Any = servos_in(log.file.model) if whole and log.file.input_kind == "command" else None
    moved = 0.0 if servos is None else float(np.ptp(np.asarray(log.record.u) @ np.asarray(servos.commands).T, 0).max())
    if moved > HELD:
        evidence = f"{log.still[0].evidence}, while a command moves by {moved:.3g}"
        line = "look at the power of the servos, and at what reads their positions"
        log.still = [log.still[0]._replace(what="servo off", evidence=evidence, line=line)]
    log.findings += log.still if whole else []
    return whole


def look_for_made_rows(log: Examination) -> bool:
    """Empty the readings that were made from their neighbours, which look like finer ticks and like no noise."""
    made, findings = made_rows(log.rows.t, log.y, names_of(log.file), log.rows)
    log.findings += findings
    log.record = log.record._replace(y=np.where(made, np.nan, log.y))
    return False


def look_for_senders(log: Examination) -> bool:
    """Remove wraps, and then look for a second sender: either hides all other faults."""
    log.wraps = periods(log.rows.t, log.y, known_ticks(log.record, (), log.quantum))
    log.record = log.record._replace(y=unwrap(log.y, (), log.wraps))
    log.case, log.outliers = case_without_outliers(log.file, log.record, log.rows, log.quantum)
    senders = _second_senders(log.case, log.record, log.outliers, log.rows)
    if senders:
        # Two motions in one column look like noise, outliers, delays and wrong units.
        log.drop("missing rows", "irregular stamps")
        log.findings += [*log.still, *senders]
    return bool(senders)


def mend_broken_parts(log: Examination) -> bool:
    """Parts of the log in which a position is stuck, or after which its zero has shifted."""
    broken = [] if log.file.input_kind == "command" else broken_parts(log.case, log.y, log.rows)
    for each, _ in broken:
        log.record = each.apply(log.case._replace(record=log.record)).record
    if broken:
        log.findings += [finding for _, finding in broken]
        log.case, log.outliers = case_without_outliers(log.file, log.record, log.rows, log.quantum)
    return False


def look_at_readings(log: Examination) -> bool:
    """Rows that come only at the edges of an encoder, and readings that repeat; later stages use the busiest rows."""
    case, names = log.case, log.case.names
    log.as_read = case._replace(record=log.record)
    log.edges = edge_findings(log.rows.t, log.y, case.ticks, names, log.quantum)
    if log.edges:
        log.drop("missing rows", "irregular stamps")
    again, log.repeated = find_repeats(log.y, case.ticks, names.q, log.rows)
    if any(each.wrong for each in log.repeated):
        case = case.with_readings(np.where(again, np.nan, np.asarray(case.record.y)))
    log.case = case._replace(record=busiest(case.record, MOST_ROWS))
    return False


def look_at_servos(log: Examination) -> bool:
    """The rest of the examination of a machine whose inputs are commands of servos."""
    if log.file.input_kind != "command":
        return False
    ticks = log.case.ticks
    on_servos, case = servo_findings(log.case)
    steps, line = np.abs(np.nan_to_num(np.diff(log.y, axis=0))), log.file.columns.t
    log.findings += clock_findings(log.rows.t, steps, line, PLAUSIBLE_OF_SERVOS)
    log.findings += [*log.still, *_periods(log, case, ticks), *log.outliers, *log.repeated, *on_servos]
    log.findings += [*_sensors(case, log.quantum, log.edges), *sensor_checks(case, log.rows.t, log.sensors)]
    log.checks += ("sensors beside the positions",) if log.sensors else ()
    log.checks += ("units, signs and order of commands", "servos", "delays of commands")
    return True


def look_at_columns(log: Examination) -> bool:
    """Units, order and signs of columns, and then the readings in the units of the model."""
    y, ticks = log.y, log.as_read.ticks
    plain, log.case = correct_curves(log.case)
    first, tried = log.case, compare_columns(log.case)
    corrections, changes, log.case = correct_guesses(log.case, log.family, tried)
    curves, log.case = correct_curves(log.case) if changes else ([], log.case)
    if curves:  # beside any curve the inputs, and with them the numbers, may be too large together
        case = log.case._replace(model=first.model, file=first.file)
        _, numbers, log.case = correct_guesses(case, log.family, compare_columns(case))
        changes = [each for each in changes if each.what != NUMBERS] + numbers
    further, columns, log.case = correct_columns(log.case, tried if log.case is first else compare_columns(log.case))
    corrections, changes = corrections + further, changes + columns
    for each in corrections:
        log.as_read = each.apply(log.as_read) if each.what.startswith("unit of") else log.as_read
    case, changed = log.case, np.asarray(log.as_read.record.y)
    if not np.array_equal(changed, y, equal_nan=True):
        # Angles in another unit wrap at other places, so the readings are examined again in the unit of the model.
        again, log.outliers = case_without_outliers(log.file, log.record._replace(y=changed), log.rows, log.quantum)
        largest = np.nanargmax(np.abs(y), axis=0), np.arange(y.shape[1])
        log.wraps = log.wraps * np.abs(changed[largest] / y[largest])
        ticks = again.ticks
        _, log.repeated = find_repeats(changed, ticks, case.names.q, log.rows)
    noise = np.maximum(np.nan_to_num(readings(log.record._replace(y=changed), case.model.circles).std), ticks)
    forward = set_forward(log.rows.t, unwrap(changed, case.model.circles), noise, log.rows)
    log.findings += [
        *forward,
        *log.still,
        *_periods(log, case, ticks),
        *log.outliers,
        *log.repeated,
        *plain,
        *curves,
        *changes,
    ]
    # In another unit of time the readings have other rates too: they are judged once it is right.
    log.sensors = () if any(each.what == "unit of time" for each in changes) else log.sensors
    log.checks += ("sensors beside the positions",) if log.sensors else ()
    return False


def compare_accelerations(log: Examination) -> bool:
    """Torques that the model lacks, delays, scales, noise: what the accelerations tell, if there are any."""
    case, best = log.case, best_window(log.case)
    constant = constant_inputs(log.record, case.names)
    if best is None or not best[1].told.any():
        log.findings += [*_sensors(case, log.quantum, log.edges), *sensor_checks(case, log.rows.t, log.sensors)]
        log.findings.append(standstill(case.record, case.model.circles, case.names, case.ticks))
        return True
    log.checks += compared(log.file)
    found = _beyond_columns(log, case, best, constant)
    if any(each.wrong for each in found.findings) and log.family is not None:
        short = case._replace(record=busiest(case.record, FEW_ROWS))
        other = other_numbers(short, log.family, (), "guesses or a fault")
        if other is not None and other[2].numbers["unexplained_after"] < BETTER * found.left:
            # Guesses that are off look like delays, scales and friction, which leave more.
            case = other[0](case)
            wrong = other[2].numbers["unexplained"] > THRESHOLDS["guesses"].least
            log.drop(NUMBERS)
            log.findings.append(other[2]._replace(wrong=wrong))
            found = _beyond_columns(log, case, best_window(case) or best, constant)
    log.findings += found.findings
    return True


class _Found(NamedTuple):
    """Findings on what accelerations tell, and the unexplained share that they leave."""

    findings: list[Finding]
    left: float


def _beyond_columns(log: Examination, case: Case, best: tuple[float, Residual], constant: str) -> _Found:
    """Findings on torques that the model lacks, delays, scales, rows and noise."""
    as_it_is = case
    lacking, case, timing = _torques_or_timing(case, *best)
    delays = timing.findings(case, best[0])
    if lacking and not timing.explains_most(case, best[0]):
        delays = [_until_fitted(each) if each.what in LATE else each for each in delays]
    in_time = timing.apply(case)
    small = _rows_and_inputs(in_time, best[0], not any(each.what == "delay" for each in delays))
    # Readings of a column that is rows late are those of a sensor only in their own rows.
    shift = [sum(int(each.numbers["rows"]) for each in small if each.where == name) for name in case.names.q]
    moved = case.with_readings(moved_rows(np.asarray(case.record.y), timing.rows + np.array(shift)))
    after = smoothed_residual(in_time, best[0])
    left = [] if small else unexplained(case, after, best[0], constant)
    beside = sensor_checks(case, log.rows.t, log.sensors, timing.delay - timing.delay.min())
    share = min([after.misfit, *(each.numbers["unexplained_after"] for each in small)])
    if any(each.wrong for each in delays):
        whole = _rows_and_inputs(as_it_is, best[0], rows=True)
        if whole and whole[0].numbers["unexplained_after"] <= THRESHOLDS["torques"].alike * share:
            # One shift by whole rows is simpler than several delays and scales.
            return _Found([*_sensors(as_it_is, log.quantum, log.edges), *beside, *whole], share)
    return _Found([*_sensors(moved, log.quantum, log.edges), *beside, *lacking, *delays, *small, *left], share)


STAGES: tuple[Stage, ...] = (
    *(look_at_clock, look_without_coordinates, look_for_rest, look_for_made_rows, look_for_senders, mend_broken_parts),
    look_at_readings,
    *(look_at_servos, look_at_columns, compare_accelerations),
)
"""The stages in their order."""


def _periods(log: Examination, case: Case, ticks: np.ndarray) -> list[Finding]:
    return period_findings(without_full_turns(log.wraps, case.model.circles), ticks, case.names)


def _until_fitted(delay: Finding) -> Finding:
    """Turn a delay that explains little beside missing torques into a note: untried friction looks like one."""
    evidence = f"{delay.evidence}; friction that is not fitted yet looks like this"
    return delay._replace(evidence=evidence, line="fit what the model lacks, then check again", wrong=False)


def _torques_or_timing(case: Case, half: float, as_it_is: Residual) -> tuple[list[Finding], Case, Timing]:
    """Findings on torques that the model lacks, the case with these, and its delays and scales.

    Friction looks like a delay and like a scale of an input, so these are judged against each other, alone and
    together; where the model lacks torques, delays and scales are looked for in the model that has them.
    """
    timing = fit_timing(case, half)
    log = smoothed(case, half)
    torques, beside = list(missing_torques(case, log)), list(friction_beside_scales(case, log))
    if not torques and not beside:
        return [], case, timing
    plain = [each for each in torques if each.threshold == "torques"]
    rotors = [each for each in torques if each.threshold == "rotors"]
    both, timings = [], {id(each): each for each in torques}
    for each in (*torques, *beside):
        later = fit_timing(each.apply(case), half)
        if later.suspicions:
            both.append(each._replace(apply=composed(each, later.together), threshold="torques and fitted"))
            timings[id(both[-1])] = each
    accepted = judge(case, [*plain, timing.together, *rotors, *both], unexplained_at(half))
    if accepted is None or id(accepted[0]) not in timings:
        return [], case, timing
    suspicion, finding = timings[id(accepted[0])], accepted[1]
    # Only a note if the residual is within what the data sheet allows.
    wrong = as_it_is.misfit > BARELY or bool(unexplained(case, as_it_is, half))
    case = suspicion.apply(case)
    return [finding._replace(wrong=wrong)], case, fit_timing(case, half)


def _rows_and_inputs(case: Case, half: float, rows: bool) -> list[Finding]:
    """At most one finding: a column that is late by whole rows, if `rows`, or how inputs vary between rows.

    Wider windows average out more noise and show smaller shifts. The search stops once the noise is below the smallest
    shift that is reported: beyond that, windows show only what they smooth away.
    """
    for wide in (w * half for w in SHIFTED):
        if not long_enough(case, wide):
            break
        compare = unexplained_at(wide)
        now = compare(case)
        suspicions = [*(row_shifts(case) if rows else ()), *inputs_between_rows(case)]
        accepted = judge(case, suspicions, lambda each, now=now, at=compare: now if each is case else at(each))
        if accepted is not None:
            return [accepted[1]]
        if now is not None and now.most <= THRESHOLDS["rows"].least:
            break
    return []


def _sensors(case: Case, stated: float | tuple[float, ...] | None, edges: list[Finding]) -> list[Finding]:
    found = sensor_findings(case.record, case.model.circles, case.names, stated, case.file.measurement_std)
    return [*edges, *(each for each in found if not (edges and each.what == "ticks"))]


def _second_senders(case: Case, record: Record, outliers: list[Finding], rows: Rows) -> list[Finding]:
    """The findings on columns whose readings come from two motions in turn."""
    stated, continuous = case.file.measurement_std, unwrap(np.asarray(record.y), case.model.circles)
    usual = np.maximum(np.broadcast_to(0.0 if stated is None else stated, len(case.names.q)), case.ticks)
    noise = np.nan_to_num(readings(case.record, case.model.circles).noise)
    many = [each.where for each in outliers if each.wrong]
    findings = []
    for i, name in enumerate(case.names.q):
        # The search is long, so that only columns that are no single motion with the stated noise are looked at.
        if name not in many and not noise[i] > max(NOISIER * usual[i], NOISY * np.nanstd(continuous[:, i])):
            continue
        second = second_sender(np.asarray(record.t), continuous[:, i])
        if second is not None:
            findings.append(sender_finding(second, name, rows))
    return findings
