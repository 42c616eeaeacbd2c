"""The verb `smooth`: a table with the filter beside it, what it refuses, and what it prints."""

import pytest

import covariant
from covariant.observers import REGISTRY, SMOOTHED
from covariant.observers.filters._gated_filter import AbstractGatedFilter

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.2}


def swing(noise: float = 1e-3):
    return covariant.simulate("oscillator", duration=3.0, rate=100.0, q0=[1.0], noise=noise, seed=1)


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory):
    log = swing().save(tmp_path_factory.mktemp("smooth") / "log.csv")
    return covariant.smooth("oscillator", log, overrides=NOISE, columns={"truth": "true_v1"}), log


def test_the_names_are_those_of_the_filters_with_a_covariance_and_a_gate():
    assert tuple(e.name for e in REGISTRY if issubclass(e.observer, AbstractGatedFilter)) == SMOOTHED
