"""Sweeps: a study in a small file, run over all its cases; errors follow noise, gains, rates and starts."""

from pathlib import Path

import pytest

from covariant import many, models
from covariant.many._study import designed_with, read_study

STUDIES = Path(__file__).parents[2] / "benchmarks/studies"
HEAD = 'model = "oscillator"\nobservers = ["intrinsic", "intrinsic-kalman"]\nduration = 2.0\nbelow = 0.05\n'
SET = '[set]\n"measurement.std" = 1e-3\n"uncertainty.acceleration" = 1.0\n'


def run(folder, axes, head=HEAD + "rate = 50.0\n", name="study"):
    (folder / f"{name}.toml").write_text(f"{head}{SET}[axes]\n{axes}\n")
    return many.sweep(folder / f"{name}.toml", folder / f"{name}.zarr", workers=1)


@pytest.mark.exhaustive("rate = 50.0\\nfeedback = \"math:pi\"\\n-module 'math' is not in the folder of the file")
@pytest.mark.core(2)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("durations = 1\n", "unknown key"),
        ("", "rate is missing"),
        ("rate = 50.0\n[start]\nq2 = 1.0\n", "unknown state"),
        ("rate = -50.0\n", "rate must be samples a second"),
        ('rate = 50.0\ngate = "no"\n', "gate must be true or false"),
        ("rate = 50.0\npush = [1.0, 2.0]\n", "push needs 1 finite numbers, for v1"),
        ('rate = 50.0\nfeedback = "math:pi"\n', "module 'math' is not in the folder of the file"),
        ("rate = 50.0\nstart = 3\n", "start must be a table"),
        ("rate = 50.0\nfeedback = {function = 'math:pi'}\n", "feedback must be"),
        ("rate = 1e12\n", r"a run of 2 s at 1e\+12 Hz has 2e\+12 samples; it needs 5 to 1000000"),
        ("rate = 1.0\n", "has 2 samples; it needs 5"),
        ("rate = 50.0\n[spread]\nv1 = -1.0\n", "spread.v1 must be a standard deviation"),
        ("rate = 50.0\n[start]\nv9 = 1.0\n", r"study.toml: start.v9: unknown state 'v9'"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, "noise = [0.1, 0.2]", HEAD + text)
    with pytest.raises(ValueError, match="needs a list of two values"):
        run(tmp_path, "noise = [0.1]", HEAD + "rate = 50.0\n")


SPAN = "{low = 0.1, high = 0.2, count = 200}"


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ("error = [1.0, 2.0]", "multiplies the first error, which is missing"),
        ("noise = [0.1, nan]", "noise must be a standard deviation"),
        ("noise = [0.1, 0.2]\n[[axes.case]]\nnoise = 0.1\n[[axes.case]]\nnoise = 0.2", "in two axes"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 2.5}', "must be a whole number"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 1e9}', "whole number from 2 to 1000000; got 1000000000.0"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = nan}', "count of axes.start.q1 must be a finite .* got nan"),
        ('"start.q1" = {low = 0.0, high = inf, count = 3}', "high of axes.start.q1 must be a finite number; got inf"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 3, log = true}', "axes.start.q1: unknown key 'log'"),
        ('"start.q1" = {low = 1.0, high = 1.0, count = 3}', "low and high of axes.start.q1 are both 1.0"),
        ('"start.q1" = [1.0, 2, 1]', "axes.start.q1 has 1 twice"),
        ("[axes.case]\nname = ['a', 'b']\nnoise = [0.1, 0.1]", "axes.case has {'noise': 0.1} twice"),
        ("draw = 1000001", "axes.draw has 1000001 values; 1000000 are the most"),
        (f"noise = {SPAN}\nacceleration = {SPAN}\ndraw = 40000", "1600000000 cases are more than 1000000000"),
        ('"parameters.stiffness" = {low = 0.1, high = 0.2, count = 10001}', "10001 designs of an observer are more"),
        ('"star.v1" = [1.0, 2.0]', r"study.toml: axes.star.v1: Did you mean 'start'\? .*: unknown table or key"),
        ("[[axes.case]]\nnois = 0.1\n[[axes.case]]\nnoise = 0.2", "unknown table or key 'nois'"),
        ("[axes.case]\nnoise = [0.1, 0.2]\nrate = [50.0]", "need one length; got noise 2, rate 1"),
        ("[axes.case]\nnoise = [0.1]", "needs a list of two values"),
        ("[axes.case]\nnoise = [0.1, 0.2]\nrate = 50.0", "or lists by key"),
        ("draw = 2.5", "must be a number of draws"),
        ("draw = [1, 5]", "must be a number of draws"),
        ("[[axes.error]]\nnoise = 0.1\n[[axes.error]]\nnoise = 0.2", "it is taken"),
        ("[[axes.case]]\nerror = 1.0\n[[axes.case]]\nerror = 2.0", "as an axis alone"),
        ("[[axes.observer]]\nnoise = 0.1\n[[axes.observer]]\nnoise = 0.2", "it is taken"),
        ('"measurement.delay" = [0.0, 0.01]', "a sweep has no delays"),
    ],
)
def test_an_axis_that_makes_no_sense_is_refused(tmp_path, axes, message):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, axes)


@pytest.mark.parametrize(
    ("observers", "more", "axes", "message"),
    [
        ('"intrinsic", "intrinsic"', "", "noise = [0.1, 0.2]", "observers has 'intrinsic' twice"),
        ('"intrinsic"', "[error]\nq1 = 0.1\n", "error = [4.0, 2.0]", "multiples that grow"),
        ('"pll"', "", '"error.v1" = [0.0, 1.0]', "has no velocity to start with"),
    ],
)
def test_observers_and_first_errors_that_make_no_sense_are_refused(tmp_path, observers, more, axes, message):
    head = HEAD.replace('"intrinsic", "intrinsic-kalman"', observers)
    with pytest.raises(ValueError, match=message):
        run(tmp_path, axes, f"{head}rate = 50.0\n{more}")


@pytest.mark.core(1)
@pytest.mark.parametrize("path", sorted(STUDIES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_study_of_the_benchmarks_names_what_there_is(path):
    plan = read_study(path)
    for each in plan.designs:
        models.load(plan.model, plan.content.get("set", {}) | designed_with(each))
    assert plan.grid.size > 1
