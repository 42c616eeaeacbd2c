"""Compares a log with a model, before anybody estimates from the log.

The model's accelerations along the smoothed log are compared with the measured ones. The remainder shows whether the
log is in the units, order and signs of the model, and whether every column was measured at its stamps.

Suspicions are judged against each other on rows held out, in an order where that cannot decide:

1. What readings and stamps show by themselves, since smoothing needs readings without outliers; of parts in which a
   position may be stuck, or from which on its zero may be another one, the model decides.
2. `COLUMNS`, one after another: in wrong units or order nothing else explains anything.
3. Delays and scales against friction and rotors, each of which looks like the other.
4. Whole rows and what inputs do between rows, in the log without these: so small a fault shows only there.
5. What is left when no suspicion explains it.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from covariant.calibration.diagnosis._case import (
    Case,
    Residual,
    best_window,
    busiest,
    case_without_outliers,
    clearly,
    in_coordinates,
    long_enough,
    names_of,
    smoothed,
    smoothed_residual,
)
from covariant.calibration.diagnosis._clock import set_forward, stamps
from covariant.calibration.diagnosis._columns import COLUMNS
from covariant.calibration.diagnosis._edges import edge_findings
from covariant.calibration.diagnosis._finding import Diagnosis, Finding, Rows
from covariant.calibration.diagnosis._jumps import (
    moved_zeros,
    period_findings,
    periods,
    second_sender,
    sender_finding,
    without_full_turns,
)
from covariant.calibration.diagnosis._misfit import OF_COMMANDS
from covariant.calibration.diagnosis._missing_torques import friction_beside_scales, missing_torques
from covariant.calibration.diagnosis._on_group import group_findings
from covariant.calibration.diagnosis._on_legs import late_encoders
from covariant.calibration.diagnosis._readings import (
    known_ticks,
    missing_cells,
    readings,
    still_findings,
)
from covariant.calibration.diagnosis._repeats import repeated_findings, stuck, without_repeated
from covariant.calibration.diagnosis._sensor_checks import sensor_checks
from covariant.calibration.diagnosis._sensor_findings import NOISIER, sensor_findings, standstill
from covariant.calibration.diagnosis._sensor_motion import Beside
from covariant.calibration.diagnosis._servo_faults import servo_findings
from covariant.calibration.diagnosis._suspicion import (
    Comparison,
    Suspicion,
    choose,
    clearly_unexplained,
    compare_all,
    judge,
    unexplained_at,
)
from covariant.calibration.diagnosis._thresholds import BARELY, EXPLAINED, FEW_ROWS, MOST_ROWS, THRESHOLDS
from covariant.calibration.diagnosis._timing import Timing, fit_timing, inputs_between_rows, moved_rows, row_shifts
from covariant.calibration.diagnosis._unexplained import constant_inputs, unexplained
from covariant.models import ModelFile
from covariant.observers import on_legs
from covariant.scoring import unwrap
from covariant.signals import Record

SHIFTED = (1.0, 2.0, 4.0)
"""Half windows to look for shifts by whole rows in, in those that explain most."""
NOISY = 0.01
"""Noise, as a fraction of the deviation of a position, from which a second sender is looked for."""
MOST_PAIRS = 6
"""Suspicions of missing torques, alone or with one about columns, that are tried: those that promise most."""
AROUND_PART, FEWEST_AROUND = 3, 150
"""Rows on either side of a part of the log that judge it, if many do not show it: relative to its own rows with the
windows beside it, and the fewest."""
MOST_CHANGES = 3
"""Suspicions about columns that are accepted one after another."""
COMPARED = (
    *("units", "order and signs of columns", "scales of inputs", "delays"),
    *("friction and rotor inertia", "accelerations"),
)
"""Checks that compare accelerations."""
HIDING = ("nothing moves", "several senders", "too little motion")
"""Findings on logs that show no accelerations."""
LATE = ("delay", "delay against the inputs")
"""Findings that friction looks like."""
WEIGHTS = (
    *OF_COMMANDS,
    *("servo off", "gain of a servo", "zero of a servo", "limit of a servo"),
    *(
        "clock",
        "nothing moves",
        "several senders",
        "unit of",
        "period",
        "swapped",
        "sign of",
        "axes of",
        "sensor",
        "zero of",
        "gravity",
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

    Call it before any fit, tuning or estimate: a wrong unit, sign or delay looks like noise or a wrong parameter. Mend
    the first finding first, since it can cause the later ones. Where the model explains nothing of the motion, begin
    with the columns and units. The verb `covariant.check` does the same from files.

    Args:
        file: The model and its data sheet. For a machine that is not in coordinates, and for a `StateSpace`, only the
            stamps and missing measurements are checked, and the delay of the encoders of a robot on legs.
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
    findings, checks = _findings(file, record, quantum, Rows(np.asarray(record.t), first_row, every), sensors)
    findings = sorted(findings, key=_weight)
    hidden = any(each.what in HIDING for each in findings)
    return Diagnosis(tuple(findings), checks, tuple(each for each in COMPARED if hidden and each not in checks))


def _weight(finding: Finding) -> tuple[bool, int]:
    """Sort key of a finding: wrong ones first, and among them those that make others meaningless."""
    place = next((k for k, begin in enumerate(WEIGHTS) if finding.what.startswith(begin)), len(WEIGHTS))
    return not finding.wrong, place


def _findings(
    file: ModelFile,
    record: Record,
    quantum: float | tuple[float, ...] | None,
    rows: Rows,
    sensors: Sequence[Beside],
) -> tuple[list[Finding], tuple[str, ...]]:
    """All findings, unsorted, and the names of the checks."""
    findings = [*stamps(rows.t), *missing_cells(np.asarray(record.y))]
    checks = ("clock", "missing rows", "irregular stamps", "missing measurements")
    if not in_coordinates(file):
        if not file.mechanical:
            late = late_encoders(file, record) if on_legs(file.model) else None
            return (findings, checks) if late is None else ([*findings, *late], (*checks, "delays"))
        model: Any = file.model
        on_group = group_findings(model, record, file.columns.t, rows)
        clock = [] if any(each.what == "unit of time" for each in on_group) else findings
        return [*on_group, *clock], (*checks, "unit of time", "repeated rows")
    checks += ("periods", "several senders", "outliers", "repeated rows", "ticks", "noise")
    y, names = np.asarray(record.y), names_of(file)
    constant = constant_inputs(record, names)
    quantum = file.quantum if quantum is None else quantum
    still, whole = still_findings(y, names.q, names.units)
    if whole:
        return [*findings, *still], checks
    # Jumps of a period and readings of a second sender hide everything else, so that they are removed first.
    wraps = periods(rows.t, y, known_ticks(record, (), quantum))
    record = record._replace(y=unwrap(y, (), wraps))
    case, outliers = case_without_outliers(file, record, rows, quantum)
    senders = _second_senders(case, record, outliers, rows)
    if senders:
        # Two motions in one column look like noise, outliers, delays and wrong units.
        clock = [each for each in findings if each.what not in ("missing rows", "irregular stamps")]
        return [*clock, *still, *senders], checks
    broken = [] if file.input_kind == "command" else _broken_parts(case, np.asarray(record.y), rows)
    for each, _ in broken:
        record = each.apply(case._replace(record=record)).record
    if broken:
        findings += [finding for _, finding in broken]
        case, outliers = case_without_outliers(file, record, rows, quantum)
    y, ticks, as_read = np.asarray(record.y), case.ticks, case._replace(record=record)
    edges = edge_findings(rows.t, y, ticks, names, quantum)
    if edges:
        findings = [each for each in findings if each.what not in ("missing rows", "irregular stamps")]
    repeated = repeated_findings(y, ticks, names.q, rows)
    if any(each.wrong for each in repeated):
        case = case._replace(record=case.record._replace(y=without_repeated(np.asarray(case.record.y), ticks)))
    case = case._replace(record=busiest(case.record, MOST_ROWS))
    if file.input_kind == "command":
        on_servos, case = servo_findings(case)
        findings += [*still, *period_findings(without_full_turns(wraps, case.model.circles), ticks, names), *outliers]
        findings += [*repeated, *on_servos, *_sensors(case, quantum, edges), *sensor_checks(case, rows.t, sensors)]
        checks += ("sensors beside the positions",) if sensors else ()
        return findings, (*checks, "units, signs and order of commands", "servos", "delays of commands")
    corrections, changes, case = _correct_columns(case)
    for each in corrections:
        as_read = each.apply(as_read) if each.what.startswith("unit of") else as_read
    if not np.array_equal(as_read.record.y, y, equal_nan=True):
        # Angles in another unit jump at other places, so the readings are looked at anew, in that of the model.
        y = np.asarray(as_read.record.y)
        again, outliers = case_without_outliers(file, record._replace(y=y), rows, quantum)
        largest = np.nanargmax(np.abs(np.asarray(record.y)), axis=0), np.arange(y.shape[1])
        wraps = wraps * np.abs(y[largest] / np.asarray(record.y)[largest])
        ticks = again.ticks
        repeated = repeated_findings(y, ticks, names.q, rows)
    noise = np.maximum(np.nan_to_num(readings(record._replace(y=y), case.model.circles).std), ticks)
    forward = set_forward(rows.t, unwrap(y, case.model.circles), noise, rows)
    jumps = period_findings(without_full_turns(wraps, case.model.circles), ticks, names)
    findings += [*forward, *still, *jumps, *outliers, *repeated, *changes]
    # In another unit of time the readings have other rates too: they are judged once it is right.
    sensors = () if any(each.what == "unit of time" for each in changes) else sensors
    checks += ("sensors beside the positions",) if sensors else ()
    best = best_window(case)
    if best is None or not best[1].told.any():
        return [
            *findings,
            *_sensors(case, quantum, edges),
            *sensor_checks(case, rows.t, sensors),
            standstill(case.record, case.model.circles, case.names, case.ticks),
        ], checks
    checks += COMPARED
    lacking, case, timing = _torques_or_timing(case, *best)
    delays = timing.findings(case, best[0])
    if lacking and not timing.explains_most(case, best[0]):
        delays = [_until_fitted(each) if each.what in LATE else each for each in delays]
    in_time = timing.apply(case)
    small = _rows_and_inputs(in_time, best[0], not any(each.what == "delay" for each in delays))
    # Readings of a column that is rows late are those of a sensor only in their own rows.
    shift = [sum(int(each.numbers["rows"]) for each in small if each.where == name) for name in names.q]
    moved = case._replace(
        record=case.record._replace(y=moved_rows(np.asarray(case.record.y), timing.rows + np.array(shift)))
    )
    left = [] if small else unexplained(case, smoothed_residual(in_time, best[0]), best[0], constant)
    beside = sensor_checks(case, rows.t, sensors, timing.delay - timing.delay.min())
    return [*findings, *_sensors(moved, quantum, edges), *beside, *lacking, *delays, *small, *left], checks


def _broken_parts(case: Case, read: np.ndarray, rows: Rows) -> list[tuple[Suspicion, Finding]]:
    """What is accepted about parts of the log in which a position is stuck, or from which on its zero is another one.

    Readings name the rows, and the model judges them on those around: a joint may rest, and its readings may jump over
    rows that are missing.
    """
    found: list[tuple[Suspicion, Finding]] = []
    for _ in range(MOST_CHANGES):
        suspicions = itertools.chain(stuck(case, read, rows), moved_zeros(case, read, rows))
        judged = [one for each in suspicions if (one := _judge_around(case, each)) is not None]
        if not judged:
            break
        # A stuck encoder that is read again jumps, and beside a jump a turn may look stuck.
        accepted = min(judged, key=lambda one: one[1].numbers["unexplained_after"])
        found.append(accepted)
        case = accepted[0].apply(case)
        read = np.asarray(accepted[0].apply(case._replace(record=case.record._replace(y=read))).record.y)
    # The rows before the first one are right; those before another one are not, as they stand.
    found.sort(key=lambda each: each[1].numbers["begin"])
    return [
        (each, one if k == 0 else one._replace(line=one.line.split("; or ")[-1])) for k, (each, one) in enumerate(found)
    ]


def _judge_around(case: Case, suspicion: Suspicion) -> tuple[Suspicion, Finding] | None:
    """Judge a suspicion about a part of the log on many rows around it, or, if it is short, on few."""
    t = np.asarray(case.record.t)
    begin, end = np.searchsorted(t, [suspicion.numbers["begin"], suspicion.numbers["end"]])
    # Of 30 blocks of so few rows some that are held out see it.
    few = int(AROUND_PART * (end - begin + 2 * case.file.reference_half / case.spacing))
    for beside in (FEW_ROWS // 2, np.clip(few, FEWEST_AROUND, FEW_ROWS // 2)):
        near = slice(max(begin - beside, 0), min(end, begin + FEW_ROWS) + beside)
        around = case._replace(record=Record(*(np.asarray(a)[near] for a in case.record[:3])))
        if (accepted := judge(around, [suspicion], clearly_unexplained)) is not None:
            return accepted
    return None


def _correct_columns(case: Case) -> tuple[list[Suspicion], list[Finding], Case]:
    """What is accepted of `COLUMNS`, the findings on it, and the case with it."""
    accepted, findings = [], []
    # One after another: in wrong units a swap of columns explains nothing.
    for _ in range(MOST_CHANGES):
        # Many are tried, and such faults are large, so that fewer rows show them.
        short = case._replace(record=busiest(case.record, FEW_ROWS))
        suspicions = itertools.chain.from_iterable(suspect(short) for suspect in COLUMNS)
        tried = compare_all(short, suspicions, clearly_unexplained)
        best = choose(tried)
        columns = {id(each): each for each, _ in tried}
        if tried and not (best and best[1].numbers["unexplained_after"] < EXPLAINED):
            pairs = _with_torques(short, tried)
            columns |= {id(pair): column for pair, column in pairs}
            best = choose([*tried, *compare_all(short, [pair for pair, _ in pairs], clearly_unexplained)])
        change = None if best is None else columns[id(best[0])]
        if best is None or change is None:
            break
        accepted.append(change)
        findings.append(best[1])
        case = change.apply(case)
    return accepted, findings, case


def _with_torques(
    case: Case, tried: Sequence[tuple[Suspicion, Comparison]]
) -> list[tuple[Suspicion, Suspicion | None]]:
    """Suspicions about columns, and none, each with torques that are missing then, and the one about columns.

    Missing torques are reported later, in narrower windows; here they keep a wrong column from being blamed for them.
    """
    pairs: list[tuple[Suspicion, Suspicion | None]] = []
    for column in (None, *(each for each, _ in tried)):
        changed = case if column is None else column.apply(case)
        log = clearly(changed)
        for torques in missing_torques(changed, log) if log is not None else ():
            if column is None:
                pairs.append((torques, None))
            elif torques.threshold != "rotors":
                words, apply = f"{column.words} and {torques.words}", _both(column, torques)
                pair = column._replace(words=words, apply=apply, threshold="columns and torques")
                pairs.append((pair._replace(expected=torques.expected), column))
    best = sorted(pairs, key=lambda pair: pair[0].expected)[:MOST_PAIRS]
    # Torques alone come first: without gravity, its zero and its sign are nothing.
    return sorted(best, key=lambda pair: pair[1] is not None)


def _both(first: Suspicion, second: Suspicion) -> Callable[[Case], Case]:
    return lambda case: second.apply(first.apply(case))


def _until_fitted(delay: Finding) -> Finding:
    """A delay that explains little beside torques that the model lacks, as a note: a law of friction with other numbers
    or of another form than was tried looks like one."""
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
            both.append(each._replace(apply=_both(each, later.together), threshold="torques and fitted"))
            timings[id(both[-1])] = each
    accepted = judge(case, [*plain, timing.together, *rotors, *both], unexplained_at(half))
    if accepted is None or id(accepted[0]) not in timings:
        return [], case, timing
    suspicion, finding = timings[id(accepted[0])], accepted[1]
    # A note as long as the data sheet admits what the model leaves.
    wrong = as_it_is.misfit > BARELY or bool(unexplained(case, as_it_is, half))
    case = suspicion.apply(case)
    return [finding._replace(wrong=wrong)], case, fit_timing(case, half)


def _rows_and_inputs(case: Case, half: float, rows: bool) -> list[Finding]:
    """At most one finding on a column that is whole rows late, if `rows`, or on how inputs go from row to row.

    Wider windows show shifts in time below the noise of narrower ones. Where these see so little noise that they would
    show the smallest shift that is reported, wider ones only show what they smooth away.
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
