"""The search for the largest number that is proved, and what start a certificate covers."""

import math
from typing import Any

import numpy as np
import pytest

import covariant
from covariant.certificates import ContractionCertificate, Hypothesis, Start, Statement, largest
from scalargraph.errors import InputError
from scalargraph.proofs import box

REGION = {"velocity": 1.0, "error": 0.1, "region": {"q": (-1.0, 1.0)}}


def proved_up_to(limit, calls, refuse=math.inf):
    """A prover that proves all values up to a limit."""

    def prove(value):
        calls.append(value)
        if value > refuse:
            raise InputError("the error must be below π\nand more")
        verdict = "holds" if value <= limit else "undecided"
        statement = Statement("it contracts", (), (Hypothesis("it contracts", "proved", verdict),), value)
        domain = box(v=(-1.0, 1.0), e=(-0.1, 0.1), f=(0.0, 0.0))
        given = {"noise": [0.0], "disturbance": [0.0], "slopes": [[0.0]]}
        nothing: Any = None
        start = statement, value, 0.1, nothing, np.eye(2), nothing
        return ContractionCertificate(*start, domain, np.ones(1), given, (), None)

    return prove


@pytest.mark.parametrize("limit", [0.13, 1.0, 1.02, 7.0])
def test_one_step_beyond_the_largest_was_not_proved(limit):
    calls = []
    found = largest(proved_up_to(limit, calls), 1.0, runs=30)
    assert found.value is not None
    assert found.refused is not None
    assert found.certificate is not None
    assert found.value <= limit < found.refused <= 1.05 * found.value
    assert found.certificate.rate == found.value
    assert [attempt.value for attempt in found.attempts] == calls
    assert [attempt.verdict == "holds" for attempt in found.attempts] == [value <= limit for value in calls]
    again = largest(proved_up_to(limit, []), 1.0, runs=30)
    assert again.attempts == found.attempts


def test_a_search_ends_after_its_runs_and_at_the_least_value():
    calls = []
    assert largest(proved_up_to(1e9, calls), 1.0, runs=4).refused is None
    assert calls == [1.0, 2.0, 4.0, 8.0]
    nothing = largest(proved_up_to(0.1, calls := []), 1.0, least=0.3, runs=30)
    assert nothing.value is None
    assert calls == [1.0, 0.5, 0.3]
    assert nothing.certificate is not None
    assert nothing.certificate.statement.verdict == "undecided"


def test_values_that_are_refused_are_attempts_and_a_bad_first_value_is_an_error():
    found = largest(proved_up_to(1e9, [], refuse=3.0), 1.0, runs=4)
    assert str(found.attempts[2]) == "4: refused: the error must be below π"
    assert found.value == pytest.approx(2 * math.sqrt(2))
    with pytest.raises(ValueError, match="below π"):
        largest(proved_up_to(1.0, [], refuse=0.5), 1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"first": 0.0}, "first must be"), ({"runs": 0}, "runs must be"), ({"step": 1.0}, "step must be")],
    ids=str,
)
def test_bad_requests_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        largest(proved_up_to(1.0, []), **({"first": 1.0} | options))


@pytest.mark.parametrize(
    ("find", "words"),
    [
        ("radius", "choose one of error, rate, interval; got 'radius'"),
        ("rate", "give rate, with which the search for the largest begins"),
        ("interval", "give interval"),
    ],
)
def test_bad_searches_of_the_verb_are_refused(find, words):
    with pytest.raises(ValueError, match=f"find: {words}"):
        covariant.certify("oscillator", find=find, alpha=10.0, beta=50.0, **REGION)


def test_what_a_start_covers_is_rounded_down_and_what_none_exceeds_is_rounded_up():
    numbers = np.array([[0.0123456, 0.001], [0.02, 0.2], [0.0299999, 0.30001]])
    start = Start(("q", "v_q"), ("rad", "rad/s"), *numbers)
    assert start.lines[0] == "q 0.707° (1.14° alone, never more than 1.72°)"
    assert start.lines[1] == "v_q 0.001 rad/s (0.2 rad/s alone, never more than 0.301 rad/s)"
    slider = Start(("x", "v_x"), ("m", "m/s"), *numbers)
    assert slider.lines[0] == "x 0.0123 m (0.02 m alone, never more than 0.03 m)"
