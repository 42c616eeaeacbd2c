"""`covariant tune`: what it prints, writes and refuses."""

import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import command, refused

from covariant import logs, models
from covariant.calibration import HeldOut, Tuning
from covariant.calibration.identification import NoiseLevels
from covariant.observers import Intrinsic
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.tune_to_logs import _Runs, _tables

MODEL = """system = "oscillator"
[columns]
q = ["place"]
[measurement]
std = 0.1          # far too much
[uncertainty]
acceleration = 9.0 # likewise
external_force = 3.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of an oscillator with noise of 0.2 mm, and a model file that says 0.1 m."""
    folder = tmp_path_factory.mktemp("tune")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("model.toml").write_text(MODEL)
        motion = ("--duration", "12", "--rate", "50", "--q0", "1", "--noise", "2e-4")
        command("simulate", "model.toml", "-o", "log.csv", *motion)
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.mark.exhaustive
def test_runs_by_both_engines_are_the_same():
    loaded = aligned(Job("model.toml", Path("log.csv"))).loaded
    some = [Intrinsic(loaded.model, a, a**2) for a in (5.0, 10.0, 20.0)]
    by = {engine: _Runs(engine) for engine in ("c", "jax")}
    for observers in (some, some[2:]):
        pairs = [runs(observers, [loaded.record]) for runs in by.values()]
        for ours, theirs in zip(*pairs, strict=True):
            np.testing.assert_allclose(ours.info.innovation, theirs.info.innovation, rtol=1e-9, atol=1e-12)
    assert by["jax"].description == "jax: as asked"
    assert by["c"].description == "c" or shutil.which("cc") is None


@pytest.mark.exhaustive
def test_the_file_that_is_written_has_the_noise_of_the_log_and_its_comments():
    result = command("tune", "model.toml", "log.csv", "-o", "tuned.toml", "--engine", "c")
    assert result["engine"] == "c" or shutil.which("cc") is None
    before, after = result["held_out"]["before"], result["held_out"]["after"]
    assert after["likelihood"][0] > before["likelihood"][0] + 2
    assert after["gains_error"][0] < before["gains_error"][0]
    assert result["warning"] is None
    file, estimated = models.load("tuned.toml"), command("estimate", "tuned.toml", "log.csv", "-o", "estimate.csv")
    assert result["without_model"]["high"] < 1
    assert estimated["observer"] == file.observer == result["lines"]["design"]["observer"]
    assert estimated["without_model"]["filter"] == result["without_model"]["filter"]
    assert file.measurement_std == pytest.approx(2e-4, rel=0.15)
    assert file.external_force is None, "there is none, so it is taken out"
    assert file.natural_frequency == result["lines"]["design"]["natural_frequency"]
    text = Path("tuned.toml").read_text()
    assert text.startswith("# Tuned by covariant tune to log.csv.")
    assert "# far too much" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "model.toml"), "this is the model file itself; write to another file, or say --overwrite"),
        (("-o", "log.csv"), "the file to write must end in .toml"),
        (("-o", "other.toml"), "there is such a file already; write to another file, or say --overwrite"),
        (("--until", "1.5"), "is too short to tune on"),
    ],
)
def test_what_is_refused_is_told_in_one_line(arguments, message):
    Path("other.toml").write_text("")
    refused("tune", "model.toml", "log.csv", *arguments, named=[message])
    assert Path("other.toml").read_text() == ""


def test_joints_that_are_late_by_different_times_are_read_together():
    t = 0.005 * np.arange(400)
    q = np.stack([np.sin(3 * (t - 0.012)), np.cos(2 * (t - 0.002))], axis=1)
    logs.write(Path("late.csv"), {"t": t, "q1": q[:, 0], "q2": q[:, 1], "u1": t, "u2": 0 * t})
    Path("arm.toml").write_text('system = "pendulum_chain"\n[measurement]\ndelay = [0.012, 0.002]\nstd = 1e-3\n')
    loaded = aligned(Job("arm.toml", Path("late.csv"), anyway=True)).loaded
    true = loaded.record.t - 0.012
    assert len(true) == 398
    np.testing.assert_allclose(loaded.record.y, np.stack([np.sin(3 * true), np.cos(2 * true)], axis=1), atol=1e-6)
    np.testing.assert_allclose(loaded.reference.v[20:-20, 1], -2 * np.sin(2 * true)[20:-20], atol=1e-3)
    np.testing.assert_allclose(loaded.record.u[10:-1, 0], true[10:-1] + 0.0025, atol=0.006)


def test_every_joint_gets_the_noise_that_was_found(tmp_path):
    """Of two joints the file tells two numbers."""
    (tmp_path / "two.toml").write_text('system = "pendulum_chain"\n[columns]\nq = ["q1", "q2"]\n')
    noise = NoiseLevels(jnp.array(2.0), jnp.array([1e-3, 3e-3]), jnp.array(0.0))
    held_out = HeldOut(*[1.0] * len(HeldOut._fields))
    found = Tuning(20.0, 0.7, noise, None, held_out, 100)
    file = models.load(str(tmp_path / "two.toml"))
    assert _tables(file, found, 200.0)["measurement"] == {"std": [0.001, 0.003]}
