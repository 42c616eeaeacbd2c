"""`covariant design metric`: what it prints, how it goes on, and what it refuses."""

import commands
import pytest

from covariant.cli._console import progress_bar
from covariant.verbs import _metric

SHAPE = ("--grid", "5", "--block", "64")
"""Of nearly all runs below, so that few programs are compiled."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("design")


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


def refused(*arguments: str, named=()) -> str:
    return commands.refused("design", "metric", *arguments, named=named)


def test_the_progress_bar_counts_points(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TTY_INTERACTIVE", "1")
    monkeypatch.setenv("COLUMNS", "120")
    with progress_bar() as progress:
        progress("solving, 40 of 125 points", 40 / 125)
        progress("solving, 80 of 125 points", 80 / 125)
    with progress_bar(quiet=True) as progress:
        progress("quiet", 0.5)
    out, error = capsys.readouterr()
    assert out == ""
    assert "80 of 125" in error
    assert "quiet" not in error


PAPER = ("unknown_frequency", *SHAPE, "-o", "new.zarr")
RATE = (*PAPER, "--rate", "8")


@pytest.mark.core(8)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (PAPER, ["rate", "process-cov", "neither"]),
        ((*PAPER, "--rate", "-8"), ["rate", "-8", "≥ 0"]),
        ((*PAPER, "--rate", "8", "--window", "30"), ["rate", "window", "keep one"]),
        ((*PAPER, "--window", "0"), ["window", "positive"]),
        (("duffing", "--grid", "5", "--window", "10", "-o", "new.zarr"), ["twice its rate of growth"]),
        ((*PAPER, "--rate", "nan"), ["rate", "nan"]),
        ((*PAPER, "--process-cov", "1,2"), ["process-cov needs 3 positive", "x1, x2, x3", "1, 2"]),
        ((*PAPER, "--process-cov", "1,2,-3"), ["process-cov", "positive", "1, 2, -3"]),
        ((*PAPER, "--process-cov", "1,2,much"), ["process-cov", "much"]),
        ((*RATE, "--measurement-cov", "1,1"), ["measurement-cov needs 1 positive", "x1"]),
        ((*RATE, "--input", "1"), ["input needs 0 finite", "got 1"]),
        ((*RATE, "--box", "x4=0:1"), ["region", "'x4'", "x1, x2, x3"]),
        ((*RATE, "--box", "x1=1:0"), ["region", "x1", "below", "got 1 and 0"]),
        ((*RATE, "--box", "x1=0:inf"), ["region", "x1", "finite"]),
        ((*RATE, "--box", "x1=0"), ["region", "'x1=0'", "NAME=LOW:HIGH"]),
        ((*RATE, "--box", "x1=0:1,x1=0:2"), ["region", "x1", "twice"]),
        ((*RATE, "--box", ""), ["region", "NAME=LOW:HIGH"]),
        ((*RATE, "--domain", "x3=2:1"), ["domain", "x3", "below"]),
        ((*RATE, "--grid", "5,5"), ["grid", "got 5, 5", "or 3, for", "x1, x2, x3"]),
        ((*RATE, "--grid", "1"), ["grid", "got 1", "2 or more"]),
        ((*RATE, "--grid", "5.5"), ["grid", "'5.5'"]),
        ((*RATE, "--start", "0"), ["start", "positive", "got 0"]),
        ((*RATE, "--tolerance", "-1"), ["tolerance", "positive", "-1"]),
        ((*RATE, "-o", "new.csv"), ["new.csv", ".zarr"]),
        ((*RATE, "-o", "absent/new.zarr"), ["absent", "make it first"]),
        ((*RATE, "--scheduler", "nowhere"), ["scheduler", "'nowhere'", "tcp://"]),
        ((*RATE, "--scheduler", "nowhere", "--workers", "2"), ["scheduler", "workers", "give one"]),
        ((*RATE, "--set", "parameters.k=1"), ["unknown_frequency"]),
        (("oscillator", "--grid", "5", "--rate", "1", "-o", "new.zarr"), ["region", "no box", "q=LOW:HIGH,q_dot="]),
        (("heavy_top", "--grid", "5", "--rate", "1", "-o", "new.zarr"), ["heavy_top is on a group", "StateSpace"]),
        (("lorentz", "--grid", "5", "--rate", "1", "-o", "new.zarr"), ["lorentz", "lorenz"]),
    ],
)
def test_bad_input_gives_one_line(arguments, named):
    refused(*arguments, named=named)


def test_a_scheduler_that_does_not_answer_is_given_up_soon(monkeypatch):
    monkeypatch.setattr(_metric, "PATIENCE", 0.3)
    named = ["scheduler: no Dask scheduler answers at 'tcp://127.0.0.1:9'"]
    refused(*RATE, "--scheduler", "tcp://127.0.0.1:9", named=named)
