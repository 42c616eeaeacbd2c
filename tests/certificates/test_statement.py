"""A verdict is computed from its hypotheses, and its text has all that the claim is about."""

import itertools

import numpy as np
import pytest

from covariant.certificates import Hypothesis, Statement
from covariant.certificates.base import _statement

PROVED = Hypothesis("a", "proved")
OPEN = Hypothesis("b", "proved", "undecided")
WRONG = Hypothesis("c", "sampled", "fails")
SAMPLED = Hypothesis("d", "sampled")
CLAIMED = Hypothesis("e", "claimed")
ASSUMED = Hypothesis("f", "assumed")


def statement(*hypotheses) -> Statement:
    return Statement("claim", (), hypotheses, 0.0)


@pytest.mark.parametrize(
    ("hypotheses", "verdict", "evidence"),
    [
        ((PROVED,), "holds", "proved"),
        ((PROVED, ASSUMED), "holds", "proved"),
        ((PROVED, SAMPLED), "holds", "sampled"),
        ((PROVED, SAMPLED, CLAIMED), "holds", "claimed"),
        ((PROVED, OPEN), "undecided", "proved"),
        ((PROVED, OPEN, WRONG), "fails", "sampled"),
        ((ASSUMED,), "undecided", "assumed"),
        ((), "undecided", "assumed"),
    ],
)
def test_the_verdict_is_that_of_the_weakest_hypothesis(hypotheses, verdict, evidence):
    for order in itertools.permutations(hypotheses):
        found = statement(*order)
        assert (found.verdict, found.evidence) == (verdict, evidence)
        assert found.proved == (verdict == "holds" and evidence == "proved")


def test_prints_never_claim_more_than_is_proved():
    rng = np.random.default_rng(0)
    for value in rng.uniform(1e-9, 1e9, 1000) * 10.0 ** rng.integers(-9, 9, 1000):
        assert value * (1 - 2e-3) < float(_statement.rounded_down(value)) <= value
