"""How often `check` calls a log wrong that is right, and how often it names what is wrong with one."""

import pytest
from logs_with_faults import alarms, named, with_fault, without_fault

from covariant.calibration import diagnose, misfit


@pytest.mark.core(1)
@pytest.mark.long("25", "31")
@pytest.mark.exhaustive("1")
@pytest.mark.parametrize("seed", [0, 1, 2, 8, 11, 20, 25, 31, 36, 56])
def test_a_log_without_faults_is_not_called_wrong(seed):
    """Those that had been called wrong, with coarse encoders and inputs that jump, are among them."""
    log = without_fault(seed)
    assert alarms(list(diagnose(log.file, log.record).findings)) == []
    assert misfit(log.file, log.record) is None


@pytest.mark.core(1)
@pytest.mark.long("inputs after they acted", "degrees", "thousandths", "second sender")
@pytest.mark.parametrize(
    "kind",
    [
        *("row shift", "other inputs", "inputs after they acted", "degrees", "common delay"),
        *("thousandths", "compensated", "geared", "second sender"),
    ],
)
def test_a_fault_is_named(kind):
    fault = with_fault(kind, 0)
    found = list(diagnose(fault.file, fault.record).findings)
    assert named(found, fault), found
