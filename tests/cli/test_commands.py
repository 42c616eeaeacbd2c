"""The commands on good input: what they print and write."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import command

from covariant import logs
from covariant.models import load
from covariant.verbs.base.inputs import _in_ticks

MODEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
viscous = [0.05]
[columns]
q = ["angle"]
u = ["torque"]
[measurement]
quantum = 1e-3
[uncertainty]
acceleration = 1.0
"""
READ = logs.Columns(t="t", q=("q1",), u=(), truth=("v1",))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated log of a driven pendulum that swings over the top, with jitter and lost samples."""
    folder = tmp_path_factory.mktemp("commands")
    (folder / "model.toml").write_text(MODEL)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        simulate("log.csv")
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


def simulate(out: str, seed: int = 1) -> dict:
    return command(
        *("simulate", "model.toml", "-o", out, "--duration", "4", "--rate", "200", "--quantum", "1e-3"),
        *("--v0", "9.5", "--amplitude", "0.5", "--jitter", "2e-4", "--dropout", "0.02", "--seed", str(seed)),
    )


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("moved", "words"),
    [
        (lambda turn, noise: np.round(turn), ""),
        (lambda turn, noise: 10 * np.round(turn / 10), "are multiples of 10 ticks of 0.5 apart"),
        (lambda turn, noise: np.round(turn + 2 * noise), "go back and forth between ticks of 0.5 as noise does"),
        (lambda turn, noise: turn, "are not whole ticks of 0.5 apart"),
        (lambda turn, noise: 0 * turn, ""),
    ],
)
def test_positions_in_other_ticks_than_told_are_named_and_taken_as_noisy(moved, words):
    """A filter that believes finer ticks than the log's, or takes noise for edges, is wrong without a word."""
    turn, noise = 300 * np.sin(np.linspace(0, 9, 2000)), np.random.default_rng(1).normal(size=2000)
    file, told = _in_ticks(load("model.toml")._replace(quantum=0.5), 0.5 * moved(turn, noise)[:, None])
    assert (file.quantum is None) == bool(words)
    assert told == (f" Positions {words}: they are taken as noisy, not as ticks." if words else "")


def test_positions_of_different_units_are_compared_with_ticks_of_their_own():
    turn = 300 * np.sin(np.linspace(0, 9, 2000))
    file = load("ball_and_beam")._replace(quantum=(1e-4, 5e-3))
    y = np.round(np.stack([turn, 2 * turn], axis=1)) * [1e-4, 5e-3]
    assert _in_ticks(file, y) == (file, "")
    told = _in_ticks(file, y * [1.0, 10.0])[1]
    assert (
        told == " Positions of theta are multiples of 10 ticks of 0.005 apart: they are taken as noisy, not as ticks."
    )


def test_turns_in_a_log_do_not_spoil_the_score():
    log = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",)))
    wrapped = np.mod(log.record.y[:, 0], 2 * np.pi)
    assert (np.abs(np.diff(wrapped[log.record.t > 1.1])) > 3).any()
    logs.write("turns.csv", {"t": log.record.t, "angle": wrapped, "torque": log.record.u[:, 0]})
    plain, turned = (
        command("estimate", "model.toml", name, "--observer", "filtered-derivative", "--score")
        for name in ("log.csv", "turns.csv")
    )
    assert plain["scored_against"] == "zero-phase reference"
    assert plain["innovation_rms"] == pytest.approx(turned["innovation_rms"], rel=1e-4)
    assert turned["velocity_rmse"] == pytest.approx(plain["velocity_rmse"], rel=1e-4)


def test_some_rows_of_a_log():
    log = logs.read("log.csv", logs.Columns(q=("angle",)), every=4, until=2.0).record
    result = command("estimate", "model.toml", "log.csv", "--every", "4", "--until", "2", "-o", "some.csv", "--score")
    np.testing.assert_array_equal(logs.read("some.csv", READ).record.t, log.t)
    assert result["rows"] == len(log.t) == 101
    assert result["velocity_rmse"][0] < 0.2


def test_given_gains_replace_the_designed_ones():
    low = command("estimate", "model.toml", "log.csv", "--alpha", "2", "--beta", "1", "--truth", "true_v1")
    assert "alpha = 2" in low["design"]


def test_the_installed_command_runs():
    done = subprocess.run(
        [Path(sys.executable).with_name("covariant"), "estimate", "model.toml", "absent.csv"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "absent.csv" in done.stderr
