"""Time to the first result, each in a fresh process: what a user waits for."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
ROUNDS = 3


def call(*words: object) -> None:
    subprocess.run([str(word) for word in words], cwd=ROOT, env=dict(os.environ), check=True, capture_output=True)


@pytest.fixture
def log(tmp_path):
    """A hundred samples of the demonstration's pendulum, at rest."""
    path = tmp_path / "log.csv"
    columns = np.column_stack([0.002 * np.arange(100), np.zeros((100, 4))])
    np.savetxt(path, columns, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")
    return path


@pytest.mark.benchmark(group="start")
def test_python(benchmark):
    """An empty interpreter, as the reference."""
    benchmark.pedantic(call, (sys.executable, "-c", "pass"), rounds=ROUNDS)


@pytest.mark.benchmark(group="start")
def test_import_jax(benchmark):
    benchmark.pedantic(call, (sys.executable, "-c", "import jax.numpy"), rounds=ROUNDS)


@pytest.mark.benchmark(group="start")
def test_import(benchmark):
    benchmark.pedantic(call, (sys.executable, "-c", "import covariant"), rounds=ROUNDS)


@pytest.mark.benchmark(group="start")
def test_import_observers(benchmark):
    benchmark.pedantic(call, (sys.executable, "-c", "from covariant.observers import Intrinsic, run"), rounds=ROUNDS)


@pytest.mark.benchmark(group="start")
def test_help(benchmark):
    benchmark.pedantic(call, (Path(sys.executable).with_name("covariant"), "--help"), rounds=ROUNDS)


@pytest.mark.benchmark(group="start")
def test_first_estimate(benchmark, log):
    """From the shell to velocities on disk, compilation included."""
    program = Path(sys.executable).with_name("covariant")
    words = (program, "estimate", "examples/demo_double_pendulum.toml", log, "-o", log.with_name("velocities.csv"))
    benchmark.pedantic(call, words, rounds=ROUNDS)
