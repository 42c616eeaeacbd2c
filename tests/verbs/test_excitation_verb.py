"""`covariant.design_excitation` and its command: the table, the file, what they say and what they refuse."""

from pathlib import Path

import numpy as np
import pytest
from commands import refused

from covariant import logs
from covariant.verbs._excitation import ExcitationResult

MODEL = """system = "robot"

[parameters]
path = "double_pendulum"

[columns]
q = ["s", "e"]
u = ["ts", "te"]

[units]
q = "deg"

[measurement]
quantum = 1e-3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("excitation")
    (folder / "arm.toml").write_text(MODEL)
    return folder


def test_it_is_written_once(tmp_path):
    layout = logs.Columns(q=("s", "e"), u=("ts", "te"), units={"q": ("deg", "deg")})
    columns = {name: np.array([0.1, 0.2]) * k for k, name in enumerate(("t", "s", "e", "ts", "te"), 1)}
    result = ExcitationResult(layout, columns, {"t": "s", "s": "rad", "e": "rad"}, {"model": "arm.toml"})
    path = result.save(tmp_path / "motion.csv")
    read = logs.read(path, logs.Columns(q=("s", "e"), u=("ts", "te"))).record
    np.testing.assert_array_equal(np.asarray(read.y)[:, 1], result.columns["e"])
    with pytest.raises(ValueError, match="there is such a file already"):
        result.save(path)
    with pytest.raises(ValueError, match="must end in"):
        result.save(tmp_path / "motion.mcap")


ARM = ("arm.toml", "--parameters", "armature", "-o", "new.csv")
BOX = ("--box", "shoulder=-1:1,elbow=-1:1")


@pytest.mark.core(2)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (ARM, ["arm.toml", "joint 'shoulder' has no ends", "elbow", "--region shoulder=LOW:HIGH,elbow=LOW:HIGH"]),
        ((*ARM, "--box", "wrist=-1:1"), ["region", "'wrist'", "shoulder, elbow"]),
        ((*ARM, *BOX, "--velocity", "1,2,3"), ["velocity", "2 positive numbers"]),
        ((*ARM, *BOX, "--effort", "-1"), ["effort", "positive"]),
        ((*ARM, *BOX, "--duration", "7"), ["duration", "whole number of periods of 5 s", "5 or 10"]),
        ((*ARM, *BOX, "--harmonics", "1"), ["harmonics", "2 or more"]),
        ((*ARM, *BOX, "--margin", "1.5"), ["margin", "fraction"]),
        ((*ARM, *BOX, "--starts", "0"), ["starts", "1 or more"]),
        ((*ARM, *BOX, "--rate", "5"), ["rate", "10 Hz or more"]),
        (("double_pendulum", *ARM[1:], *BOX), ["noise of the encoders", "--set measurement.std=NUMBER"]),
        (("oscillator", *ARM[1:]), ["numbers of a robot"]),
        ((*ARM[:2], "mass", *ARM[3:], *BOX), ["unknown group of numbers 'mass'"]),
        ((*ARM[:4], "there.csv", *BOX), ["there.csv", "such a file already"]),
        ((*ARM[:4], "new.mcap", *BOX), ["new.mcap", "must end in .csv"]),
    ],
)
def test_bad_input_gives_one_line(folder, monkeypatch, arguments, named):
    monkeypatch.chdir(folder)
    Path("there.csv").write_text("t\n")
    refused("design", "excitation", *arguments, named=named)
