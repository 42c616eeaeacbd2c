"""The judge of two estimates: its interval holds the true ratio, and a burst of errors weighs once."""

import numpy as np
import pytest

from covariant.calibration import ErrorRatio


def squares(random: np.random.Generator, scale: float, rows: int = 1500) -> np.ndarray:
    """Squared errors of neighbouring rows that are alike."""
    return (scale * np.convolve(random.normal(size=rows + 30), 0.8 ** np.arange(30), "valid")[:rows]) ** 2


@pytest.mark.parametrize("ratio", [1.0, 1.3])
def test_the_interval_holds_the_true_ratio_of_errors_that_are_correlated_from_row_to_row(ratio):
    random = np.random.default_rng(3)
    verdicts = [ErrorRatio.of([squares(random, ratio)], [squares(random, 1.0)]) for _ in range(200)]
    assert 0.7 <= np.mean([each.low < ratio < each.high for each in verdicts]) <= 0.9
    if ratio > 1:
        assert np.mean([each.is_worse for each in verdicts]) > 0.95
        assert not any(each.is_better for each in verdicts)


def test_it_is_symmetric_and_free_of_units():
    random = np.random.default_rng(0)
    first, second = squares(random, 1.0), squares(random, 2.0)
    one, other = ErrorRatio.of([first], [second]), ErrorRatio.of([1e12 * second], [1e12 * first])
    np.testing.assert_allclose([one.low, one.high], [1 / other.high, 1 / other.low], rtol=1e-3)
    assert one.is_better
    assert other.is_worse


def test_a_burst_in_a_single_block_does_not_hide_itself_and_no_small_one_decides():
    """The t-test on differences of squares, which this replaces, calls neither: a burst raises its scatter too."""
    random = np.random.default_rng(1)
    first, second = squares(random, 1.0), squares(random, 1.0)
    first[700:730] = 3e4
    large = ErrorRatio.of([first], [second])
    assert large.error > 10 * large.other
    assert large.is_worse
    means = np.array([block.mean() for block in np.array_split(first - second, 20)])
    assert means.mean() < 3 * means.std(ddof=1) / np.sqrt(20)
    first[700:730] = 6.0
    small = ErrorRatio.of([first], [second])
    assert small.low < 1 < small.high


def test_blocks_are_of_one_log_each_and_too_few_rows_tell_nothing():
    random = np.random.default_rng(2)
    first, second = squares(random, 1.0, 400), squares(random, 3.0, 400)
    together, apart = (ErrorRatio.of(*([*np.split(each, k)] for each in (first, second))) for k in (1, 4))
    assert together.error == pytest.approx(apart.error, rel=1e-12)
    assert together.is_better
    assert apart.is_better
    few = ErrorRatio.of([first[:12]], [second[:12]])
    assert (few.low, few.high) == (0.0, np.inf)
