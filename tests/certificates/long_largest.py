"""The search for the largest number that is proved, and what start a certificate covers: what takes long."""

import pytest
from test_largest import REGION

import covariant
from covariant import models
from covariant.certificates import largest


def test_the_verb_returns_the_certificate_of_the_largest_error_with_all_attempts():
    result = covariant.certify(
        models.oscillator(), alpha=10.0, beta=50.0, rate=1.0, find="error", runs=2, checker="off", **REGION
    )
    assert result.holds
    assert [attempt.value for attempt in result.attempts] == [1.0, 2.0]
    assert result.certificate.domain.high[2] == 0.2
    text = str(result)
    assert "tried for the largest multiple of the errors:\n  1: holds, 4 boxes\n  2: holds" in text
    assert "all of them are proved, and larger ones were not tried: give more runs" in text
    start = result.certificate.start
    assert start is not None
    assert f"  {start.lines[0]}" in text
    assert "errors of a start that are within ε, all at once: q 0.0" in text
    assert result.summary["start"]["q"]["farthest"] == pytest.approx(0.2)


@pytest.mark.exhaustive
def test_the_longest_interval_of_a_pendulum_is_found():
    settings = {"velocity": 4.0, "error": 0.1, "region": {"q1": (-3.0, 3.0)}, "input": 0.5, "alpha": 10.0, "beta": 50.0}
    pendulum = models.pendulum_chain(mass=(1.0,), length=(0.5,))
    result = covariant.certify(
        pendulum, interval=(0.02, 0.05), find="interval", runs=4, checker="off", boxes=3000, **settings
    )
    assert result.holds
    proved = [attempt.value for attempt in result.attempts if attempt.verdict == "holds"]
    others = [attempt.value for attempt in result.attempts if attempt.verdict != "holds"]
    assert result.certificate.sampling is not None
    assert result.certificate.sampling.interval[1] == max(proved)
    assert max(proved) < min(others)
    # Simulated errors grow from a quarter of a second on.
    assert max(proved) < 0.25
