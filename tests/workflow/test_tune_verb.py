"""`covariant.tune` from Python: what it finds, saves and draws."""

from pathlib import Path

import pytest

from covariant.workflow import simulate, tune


@pytest.fixture(scope="module")
def log():
    """An oscillator with noise of 0.2 mm, a gap of two seconds, and an outlier."""
    table = simulate("oscillator", duration=16.0, rate=50.0, q0=1.0, noise=2e-4).to_pandas()
    table.loc[300, "q"] = 7.0
    return table[(table["t"] < 4.0) | (table["t"] > 6.0)].reset_index(drop=True)


@pytest.mark.parametrize("logs", [[], ()])
def test_no_log_is_refused(logs):
    with pytest.raises(ValueError, match="log: no log is given"):
        tune("oscillator", logs)


def test_a_log_that_is_not_there_is_named():
    with pytest.raises(FileNotFoundError, match=r"absent\.csv"):
        tune("oscillator", Path("absent.csv"))
