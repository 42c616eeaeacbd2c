"""A verb that reads a part of a log: what acts in its rows is known from all of it: what takes long."""

import numpy as np
import pytest
from test_parts_of_logs import NOISE, table

import covariant


@pytest.mark.parametrize(("frequency", "every"), [(2.0, 5), (20.0, 5)])
def test_a_thinned_log_is_as_consistent_as_a_whole_one(frequency, every):
    result = covariant.estimate(
        "oscillator",
        table(frequency=frequency),
        observer="intrinsic-kalman",
        overrides=NOISE,
        columns={"truth": "true_v"},
        every=every,
        anyway=True,
    )
    assert result.outcome.nis < 1.3
    assert result.outcome.score is not None
    assert result.outcome.score.nees < 1.0
    assert not result.warnings


def test_a_log_that_is_cut_keeps_what_was_on_its_way():
    """At the start an input of a quarter of a second ago still acts."""
    overrides = NOISE | {"inputs.delay": 0.25}
    result = covariant.estimate(
        "oscillator",
        table(overrides={"inputs.delay": 0.25}),
        observer="intrinsic-kalman",
        overrides=overrides,
        columns={"truth": "true_v"},
        start=2.0,
        anyway=True,
    )
    error = (result.velocity - np.asarray(result.loaded.log.truth)) / np.asarray(result.velocity_std)
    assert np.abs(error[:200]).max() < 4
