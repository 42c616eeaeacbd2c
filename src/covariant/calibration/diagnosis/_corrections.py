"""Corrections of a case, one after another: other numbers of the model, curves of inputs, columns."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

from covariant.calibration.diagnosis._broken_parts import MOST_CHANGES
from covariant.calibration.diagnosis._case import Case, busiest, clearly
from covariant.calibration.diagnosis._columns import COLUMNS
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._guesses import other_numbers
from covariant.calibration.diagnosis._input_curves import Balance, input_curve, late_inputs
from covariant.calibration.diagnosis._missing_torques import missing_torques
from covariant.calibration.diagnosis._moving_zeros import moving_zero
from covariant.calibration.diagnosis._suspicion import Comparison, Suspicion, choose, clearly_unexplained, compare_all
from covariant.calibration.diagnosis._thresholds import EXPLAINED, FEW_ROWS, THRESHOLDS

MOST_PAIRS = 6
"""Largest number of suspicions of missing torques to try, alone or with one about a column; the best come first."""
LATE = ("delay", "delay against the inputs")
"""Findings on delays, which friction that the model lacks can imitate."""
Compared = list[tuple[Suspicion, Comparison]]
"""Suspicions with what each explains."""


def compare_columns(case: Case) -> Compared:
    """The changes of columns that may be right, with what each explains."""
    short = _few_rows(case)
    return compare_all(short, _changes(short), clearly_unexplained)


def correct_guesses(
    case: Case, family: Callable[[], Any] | None, tried: Compared
) -> tuple[list[Suspicion], list[Finding], Case]:
    """Like `correct_columns`, beside other numbers of the model: at most one finding, on a column or on the numbers."""
    if family is None:
        return [], [], case
    short = _few_rows(case)
    torques = (pair for pair, _ in _with_torques(short, []))
    alone = itertools.chain(tried, compare_all(short, torques, clearly_unexplained))
    if any(one.after < EXPLAINED for _, one in alone):
        return [], [], case  # by one of them alone, which is found later
    found = other_numbers(short, family, _changes(short))
    if found is None:
        return [], [], case
    fitted, change, finding = found
    case = case if change is None else change.apply(case)
    return [] if change is None else [change], [finding], fitted(case)


def correct_curves(case: Case) -> tuple[list[Finding], Case]:
    """Findings on inputs that act by a curve and on zeros that move, and the case without these."""
    findings = []
    while len(findings) < MOST_CHANGES and (balance := Balance.of(case)) is not None:
        found = [one for one in (input_curve(balance, signs=False), moving_zero(balance)) if one is not None]
        if not found and case.effects is not None and LATE[1] not in {each.what for each in findings}:
            late = late_inputs(balance)
            found = [late] if late is not None and late[1].numbers["unexplained_after"] < EXPLAINED else []
        if not found:
            break
        shares = [one[1].numbers["unexplained_after"] for one in found]
        # An offset of an input and a zero of a position look alike: the input is the simpler one.
        suspicion, finding = found[int(shares[0] > THRESHOLDS["curve"].alike * min(shares))]
        case = suspicion.apply(case)
        findings.append(finding)
    return findings, case


def correct_columns(case: Case, tried: Compared) -> tuple[list[Suspicion], list[Finding], Case]:
    """The accepted corrections of columns, the findings on them, and the corrected case."""
    accepted, findings = [], []
    # One after another: in wrong units a swap of columns explains nothing.
    for _ in range(MOST_CHANGES):
        tried = compare_columns(case) if accepted else tried
        best = choose(tried)
        columns = {id(each): each for each, _ in tried}
        if tried and not (best and best[1].numbers["unexplained_after"] < EXPLAINED):
            short = _few_rows(case)
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


def _few_rows(case: Case) -> Case:
    """The case with few rows: many changes of columns are tried, and such faults are so large that these show them."""
    return case._replace(record=busiest(case.record, FEW_ROWS))


def _changes(case: Case) -> Iterator[Suspicion]:
    return itertools.chain.from_iterable(suspect(case) for suspect in COLUMNS)


def _with_torques(case: Case, tried: Compared) -> list[tuple[Suspicion, Suspicion | None]]:
    """Pairs of a suspicion and the part of it about a column: torques alone, with None, or with a column.

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
                words, apply = f"{column.words} and {torques.words}", composed(column, torques)
                pair = column._replace(words=words, apply=apply, threshold="columns and torques")
                pairs.append((pair._replace(expected=torques.expected), column))
    best = sorted(pairs, key=lambda pair: pair[0].expected)[:MOST_PAIRS]
    # Torques alone come first: without gravity, its zero and its sign are nothing.
    return sorted(best, key=lambda pair: pair[1] is not None)


def composed(first: Suspicion, second: Suspicion) -> Callable[[Case], Case]:
    return lambda case: second.apply(first.apply(case))
