"""The verb `smooth`: a table with the filter beside it, what it refuses, and what it prints."""

import numpy as np
import pytest

import covariant
from covariant.observers import REGISTRY, SMOOTHED
from covariant.observers.filters._gated_filter import AbstractGatedFilter
from covariant.signals import Record

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.2}
FILTER = {"overrides": NOISE}
"""The filter, as far as a refusal needs it."""


def swing(noise: float = 1e-3):
    return covariant.simulate("oscillator", duration=3.0, rate=100.0, q0=[1.0], noise=noise, seed=1)


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory):
    log = swing().save(tmp_path_factory.mktemp("smooth") / "log.csv")
    return covariant.smooth("oscillator", log, overrides=NOISE, columns={"truth": "true_v1"}), log


def test_the_names_are_those_of_the_filters_with_a_covariance_and_a_gate():
    assert tuple(e.name for e in REGISTRY if issubclass(e.observer, AbstractGatedFilter)) == SMOOTHED


REFUSED = [
    ({"observer": "intrinsic"}, "observer intrinsic cannot be smoothed; these can: intrinsic-kalman, ekf, ukf, "),
    ({"observer": "covariance-ekf"}, "covariance-ekf does not fit oscillator"),
    ({"lag": -1.0}, "`lag` must be a time"),
    ({"overrides": NOISE | {"measurement.delay": 0.05}}, "late .*shift the positions"),
    ({"overrides": NOISE | {"measurement.delay": 0.05}, "observer": "joint-kalman"}, "late .*shift the positions"),
    ({"lag": 1e-9}, "`lag=1e-09` is less than half a row of the log"),
    ({"overrides": {}}, "measurement.std"),
]


@pytest.mark.core(2)
@pytest.mark.parametrize(("wrong", "words"), REFUSED)
def test_what_cannot_be_smoothed_is_refused(wrong, words):
    t = np.arange(0, 3.0, 0.01)
    with pytest.raises(ValueError, match=words):
        covariant.smooth("oscillator", Record(t, np.zeros((len(t), 1)), np.cos(t)[:, None]), **(FILTER | wrong))
