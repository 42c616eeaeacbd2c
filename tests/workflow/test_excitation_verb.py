"""`covariant.design_excitation` and its command: the table, the file, what they say and what they refuse."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from covariant import logs
from covariant.cli import main
from covariant.workflow import ExcitationResult, design_excitation

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
REGION = {"shoulder": (-1.0, 1.0), "elbow": (-1.5, 1.5)}
SHORT = {"duration": 5.0, "rate": 100.0, "harmonics": 3, "starts": 1, "region": REGION, "velocity": [4.0, 5.0]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("excitation")
    (folder / "arm.toml").write_text(MODEL)
    return folder


@pytest.fixture(scope="module")
def found(folder) -> ExcitationResult:
    steps = []
    result = design_excitation(
        folder / "arm.toml",
        ["armature"],
        **SHORT,
        progress=lambda text, fraction=None: steps.append(fraction),
    )
    done = [fraction for fraction in steps if fraction is not None]
    assert done == sorted(done)
    assert 0 <= done[0] < done[-1] <= 1
    return result


@pytest.mark.exhaustive
def test_the_table_is_a_motion_within_the_limits(found):
    assert list(found.columns) == ["t", "s", "e", "v1", "v2", "a1", "a2", "ts", "te"]
    t, *columns = found.si_columns.values()
    q, v, a, u = (np.stack(columns[i : i + 2], axis=1) for i in (0, 2, 4, 6))
    assert len(t) == 501
    np.testing.assert_allclose(t[-1], 5.0)
    for each, limit in ((q, (1.0, 1.5)), (v, (4.0, 5.0)), (u, (2.0, 1.0))):
        assert (np.abs(each).max(axis=0) <= 0.9 * np.array(limit) + 1e-9).all()
    np.testing.assert_allclose([v[0], v[-1], a[0], a[-1]], 0, atol=1e-9)
    np.testing.assert_allclose(q[0], q[-1], atol=1e-12)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[5:-5], v[5:-5], atol=0.02)
    np.testing.assert_allclose(found.columns["s"], np.degrees(q[:, 0]))
    assert found.units["s"] == "deg"
    assert found.units["a2"] == "rad/s^2"
    assert found.to_pandas().attrs["units"] == found.units


@pytest.mark.exhaustive
def test_it_says_what_to_expect_and_what_it_does_not_look_at(found):
    text = str(found)
    assert "501 rows over 5 s: 1 period of 5 s, 3 harmonics" in text
    assert "| armature.shoulder [kg m^2] | 0" in text
    assert re.search(r"largest torque .* of 2 N m", text, re.DOTALL)
    assert "Collisions are not looked at" in text
    assert found.standard_errors.prod() < found.reference_errors.prod()
    noise = found.summary["joints"][1]
    assert noise["noise"] == pytest.approx(1e-3 / np.sqrt(12))
    assert noise["torque"]["noise"] == pytest.approx(0.01)
    assert found.warnings == ()


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


@pytest.mark.exhaustive
def test_it_is_drawn_with_its_limits(found, folder):
    figure = found.plot(folder / "motion.png")
    assert len(figure.axes) == 6
    assert (folder / "motion.png").stat().st_size > 10_000


ARM = ("arm.toml", "--parameters", "armature", "-o", "new.csv")
BOX = ("--box", "shoulder=-1:1,elbow=-1:1")


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
def test_bad_input_gives_one_line(folder, monkeypatch, capsys, arguments, named):
    monkeypatch.chdir(folder)
    Path("there.csv").write_text("t\n")
    monkeypatch.setattr(sys, "argv", ["covariant", "design", "excitation", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    out, error = capsys.readouterr()
    assert (left.value.code, out) == (2, "")
    assert error.count("\n") == 1
    assert all(part in error for part in named), error
    assert not Path("new.csv").exists()
