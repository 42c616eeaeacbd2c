"""What takes long of `test_estimators.py`."""

import pytest
from test_estimators import FLAT, RATE, SHEET, trial, trial_error, ungated

from covariant.calibration import observer_gains, tuned_estimators
from covariant.calibration.tuning._filters import filter_bandwidth, jerk_bound, joint_noise, polynomial
from covariant.observers import PLL, FilteredDerivative, HighGain, JointKalman, Levant, SavitzkyGolay, run


@pytest.mark.exhaustive("0.0001-True", "0.01-False", "0.0001-False")
@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_on_a_trial_filters_are_the_best_of_their_kind(noise, missing):
    part = trial(noise, missing)
    window, order = polynomial(SHEET, RATE, part)
    best = trial_error(SavitzkyGolay(window, order), part)
    for other in (polynomial(SHEET, RATE), (window + 6, order), (max(window - 6, order + 1), order)):
        assert best <= 1.02 * trial_error(SavitzkyGolay(*other), part)
    bandwidth = filter_bandwidth(SHEET, RATE, part)
    best = trial_error(FilteredDerivative(bandwidth), part)
    for other in (
        filter_bandwidth(SHEET, RATE),
        min(1.3 * bandwidth, 3 * RATE),
        bandwidth / 1.3,
    ):  # 3: the largest tried
        assert best <= 1.02 * trial_error(FilteredDerivative(other), part)


@pytest.mark.exhaustive
@pytest.mark.parametrize("missing", [False, True])
def test_on_a_trial_loops_have_their_best_number(missing):
    """Searched by their weights or by a run; here all are run in earnest, with more of it and with less."""
    part = trial(1e-3, missing)
    std, *rest = joint_noise(SHEET, RATE, part)
    found = (
        (PLL, filter_bandwidth(SHEET, RATE, part, PLL)),
        (HighGain, filter_bandwidth(SHEET, RATE, part, HighGain)),
        (Levant, jerk_bound(SHEET, part)),
        (lambda number: JointKalman(number, *rest), std),
    )
    for kind, number in found:
        best = trial_error(kind(number), part)
        assert best < 0.1
        for factor in (0.5, 0.8, 1.25, 2.0):
            assert best <= 1.02 * trial_error(kind(factor * number), part)


def test_a_cubic_is_taken_where_it_is_better():
    assert polynomial(SHEET, RATE, trial(1e-4))[1] == 3
    observers = ungated(tuned_estimators(FLAT, 2, SHEET, RATE, trial(1e-4)))
    assert observers["savitzky-golay"].order == 3
    assert observers["intrinsic"].alpha == observer_gains(SHEET, RATE).alpha
