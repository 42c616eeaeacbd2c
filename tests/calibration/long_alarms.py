"""How often `check` calls a log wrong that is right, and how often it names what is wrong with one: what takes long."""

import pytest
from logs_with_faults import FAULTS, PAIRS, alarms, named, with_fault, with_two_faults, without_fault

from covariant.calibration import diagnose, misfit

MOST_ALARMS, MOST_MISSED = 0.01, 0.05
"""Largest fractions of logs without faults that are called wrong, and of faults that are not named."""


@pytest.mark.exhaustive
def test_false_alarms_are_rare():
    wrong, logs = [], 100
    for seed in range(logs):
        log = without_fault(seed)
        found = alarms(list(diagnose(log.file, log.record).findings))
        if found or misfit(log.file, log.record):
            wrong.append((seed, found))
    print(f"{len(wrong)} of {logs} logs without faults are called wrong: {wrong}")
    assert len(wrong) <= MOST_ALARMS * logs, wrong


@pytest.mark.exhaustive
def test_most_faults_are_named():
    missed, each = [], 6
    for kind in FAULTS:
        for seed in range(each):
            fault = with_fault(kind, seed)
            found = list(diagnose(fault.file, fault.record).findings)
            if not named(found, fault):
                missed.append((kind, seed, [(finding.what, finding.where) for finding in found if finding.wrong]))
    print(f"{len(missed)} of {len(FAULTS) * each} faults are not named: {missed}")
    assert len(missed) <= max(1, MOST_MISSED * len(FAULTS) * each), missed


@pytest.mark.exhaustive(
    "compensated-thousandths", "unknown friction-thousandths", "delay-milliseconds", "unknown friction-milliseconds"
)
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_two_faults_are_named_together(first, second):
    fault = with_two_faults(first, second, 0)
    found = list(diagnose(fault.file, fault.record).findings)
    assert alarms(found, fault.names) == []
    # Friction that the data sheet admits is only a note.
    assert len({each.what for each in found if each.what in fault.names}) >= 2, found
