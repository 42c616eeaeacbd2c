"""Parts of a log in which a position is stuck, or after which its zero has shifted."""

import itertools

import numpy as np

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding, Rows
from covariant.calibration.diagnosis._jumps import moved_zeros
from covariant.calibration.diagnosis._repeats import stuck
from covariant.calibration.diagnosis._suspicion import Suspicion, clearly_unexplained, judge
from covariant.calibration.diagnosis._thresholds import FEW_ROWS
from covariant.signals import Record

AROUND_PART, FEWEST_AROUND = 3, 150
"""If many rows around do not confirm a fault in a part of the log, it is judged on so many times its own length on
either side, and on at least so many rows."""
MOST_CHANGES = 3
"""Suspicions that are accepted one after another."""


def broken_parts(case: Case, read: np.ndarray, rows: Rows) -> list[tuple[Suspicion, Finding]]:
    """Accepted suspicions about parts of the log in which a position is stuck, or after which its zero has shifted.

    The readings suggest which rows are faulty, and the model decides on the rows around them: a joint may rest, and its
    readings may jump across rows that are missing.
    """
    found: list[tuple[Suspicion, Finding]] = []
    for _ in range(MOST_CHANGES):
        suspicions = itertools.chain(stuck(case, read, rows), moved_zeros(case, read, rows))
        judged = [one for each in suspicions if (one := _judge_around(case, each)) is not None]
        if not judged:
            break
        # An encoder that recovers jumps, and a turning point beside a jump can look stuck.
        accepted = min(judged, key=_certainly_stuck)
        found.append(accepted)
        case = accepted[0].apply(case)
        read = np.asarray(accepted[0].apply(case.with_readings(read)).record.y)
    # Rows before the first fault are right as logged, so only its finding may advise to keep them.
    found.sort(key=lambda each: each[1].numbers["begin"])
    return [
        (each, one if k == 0 else one._replace(line=one.line.split("; or ")[-1])) for k, (each, one) in enumerate(found)
    ]


def _certainly_stuck(accepted: tuple[Suspicion, Finding]) -> tuple[bool, float]:
    """Sort key of faulty parts of a log: a span that no motion looks like first, then what leaves least."""
    suspicion, finding = accepted
    certain = suspicion.what == "repeated rows" and suspicion.threshold == "certain"
    return not certain, finding.numbers["unexplained_after"]


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
