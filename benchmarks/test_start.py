"""Time to the first result, each in a fresh process: what a user waits for."""

import os
import subprocess
import sys
import tempfile
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


@pytest.fixture
def arm(tmp_path):
    """A Panda that sways for a minute, with the torques of its motors, and a model file that says how these go."""
    model = tmp_path / "panda.toml"
    model.write_text('system = "robot"\nparameters = {path = "panda"}\ninputs = {between = "held"}\n', encoding="utf-8")
    program = Path(sys.executable).with_name("covariant")
    words = ("--duration", 60, "--rate", 1000, "--noise", 1e-5, "--amplitude", "1,20,1,8,0.3,0.8,0.1", "-o", "log.csv")
    subprocess.run([program, "simulate", model, *map(str, words)], cwd=tmp_path, check=True, capture_output=True)
    return model


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


@pytest.mark.benchmark(group="start: an arm of seven joints")
@pytest.mark.parametrize("verb", ["fit", "estimate"])
def test_arm(benchmark, arm, verb, monkeypatch):
    """A fit to 60 000 rows, and the first estimate with a force by a Kalman filter in C, both with an empty cache."""
    program, log = Path(sys.executable).with_name("covariant"), arm.with_name("log.csv")
    force = ("--set", "uncertainty.external_force_std=1.0", "--set", "uncertainty.external_force_time=0.3")
    words = {
        "fit": ("--parameters", "friction,armature", "--anyway"),
        "estimate": ("--observer", "intrinsic-kalman", *force, "--until", 1, "--engine", "c", "--anyway"),
    }[verb]

    def empty() -> None:
        monkeypatch.setenv("COVARIANT_CACHE", tempfile.mkdtemp(dir=arm.parent))

    benchmark.pedantic(call, (program, verb, arm, log, *words), setup=empty, rounds=1)
