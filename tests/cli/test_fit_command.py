"""`covariant fit` and `covariant init`: what they print, write and refuse."""

import sys
import tomllib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from commands import command

from covariant import logs, models
from covariant.cli import main
from covariant.workflow import simulate

MODEL = """system = "pendulum_chain"
[parameters]
mass = [1.0]     # from a scale
length = [0.5]
source = "a drawing"
[columns]
q = ["angle"]
u = []
[measurement]
quantum = 1e-3
"""
"""A point mass on a rod: only gravity and length give its frequency."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of a pendulum of 0.4 m that swings by up to 1.2 rad: its motion is that of an elliptic sine."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "model.toml").write_text(MODEL.replace("[columns]", "actuated = []\n[columns]"))
    t = np.arange(0, 12, 0.02)
    q, v, path = 1.2, 0.0, []
    for _ in t:
        path.append(q)
        for _ in range(20):  # leapfrog
            v -= 0.5e-3 * 9.81 / 0.4 * np.sin(q)
            q += 1e-3 * v
            v -= 0.5e-3 * 9.81 / 0.4 * np.sin(q)
    y = np.round(np.array(path) / 1e-3) * 1e-3
    logs.write(folder / "log.csv", {"t": t, "angle": y})
    logs.write(folder / "wrong.csv", {"t": t, "angle": np.where(t < 8, y, 0.5 * t**2)})
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


def refused(code: int, *arguments: str) -> str:
    """What a command says on standard error, or prints, when it leaves with this code."""
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtins.print", lambda *text, **_: said.append(str(text[0])))
        patch.setattr(sys, "argv", ["covariant", *arguments])
        with pytest.raises(SystemExit) as left:
            main()
    assert left.value.code == code, said
    return said[-1]


@pytest.mark.exhaustive
def test_fit_writes_a_model_file_that_keeps_its_comments():
    result = command("fit", "model.toml", "log.csv", "--parameters", "length,mass", "-o", "calibrated.toml")
    length, mass = result["parameters"]
    assert length["after"] == pytest.approx(0.4, rel=2e-3)
    assert abs(length["after"] - 0.4) < 4 * length["standard_error"]
    assert (mass["after"], mass["determined"], mass["standard_error"]) == (1.0, False, None)
    assert result["undetermined"] == ["mass[0] cannot be told from this log; it keeps its first value"]
    assert result["growth"] < 0.1
    text = Path("calibrated.toml").read_text()
    assert "mass = [1.0]     # from a scale\n" in text
    assert tomllib.loads(text)["parameters"]["source"] == "fitted to log.csv from first values of: a drawing"
    assert models.load("calibrated.toml").model.parameters["length"].value[0] == pytest.approx(length["after"])


@pytest.mark.exhaustive
def test_a_fit_that_is_worse_on_what_it_has_not_seen_is_not_written():
    arguments = ("fit", "model.toml", "log.csv", "wrong.csv", "--parameters", "length", "-o", "no.toml", *FIRST)
    assert "wrong.csv: the model leaves" in refused(1, *arguments)
    said = refused(1, *arguments, "--anyway")
    assert "predicts wrong.csv, which it has not seen, worse than before" in said
    assert "so it is not written" in said
    assert not Path("no.toml").exists()


FIRST = ("--set", "parameters.length=[0.4]", "--set", "parameters.gravity=9.0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parameters", "lenght"), "unknown number 'lenght'. Did you mean"),
        (
            ("--parameters", "length", "-o", "model.toml"),
            "this is the model file itself; write to another file",
        ),
        (
            ("--parameters", "length", "--horizon", "5"),
            "windows of 5 s with at least 12 rows and no gap, and 8 are",
        ),
        (("--parameters", "length", "--horizon", "-1"), "horizon must be a positive number of seconds; got -1"),
    ],
)
def test_wrong_arguments_of_fit_are_told_in_one_line(arguments, message):
    assert message in refused(2, "fit", "model.toml", "log.csv", *arguments)


@pytest.mark.long
def test_robots_of_one_make_have_their_friction_and_files_of_their_own(tmp_path, monkeypatch):
    """Three arms from a URDF file: one unknown link, each with its friction; the last log of each is held out."""
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(models.robots.located("double_pendulum").read_text())
    armature = "[parameters.armature]\nelbow = 0.004"
    Path("arm.toml").write_text(
        f'system = "robot"\n[parameters]\npath = "arm.urdf"\n{armature}\n[inputs]\nbetween = "held"\n'
    )
    friction = {"left": 0.02, "mid": 0.06, "right": 0.1}
    motion = {"duration": 8.0, "rate": 200.0, "amplitude": [2.2, 0.5], "noise": 1e-4}
    for seed, (arm, viscous) in enumerate(friction.items()):
        Path(arm).mkdir()
        truth = {"parameters.friction": {"elbow": {"viscous": viscous, "coulomb": 0.05}}}
        for k in range(2):
            log = simulate("arm.toml", **motion, frequency=0.6 + 0.2 * k, seed=2 * seed + k, overrides=truth)
            log.save(f"{arm}/log{k}.csv")
    paths = [f"{arm}/log{k}.csv" for arm in friction for k in range(2)]
    arguments = ("fit", "arm.toml", *paths, "--parameters", "friction.elbow,inertia.lower", "--each", "friction")
    Path("fitted_mid.urdf").write_text("mine")
    assert "fitted_mid.urdf: there is such a file already" in refused(2, *arguments, "-o", "fitted.toml")
    Path("fitted_mid.urdf").unlink()
    assert "each: unknown number in --parameters 'gravity'" in refused(2, *arguments[:-1], "gravity")
    result = command(*arguments, "-o", "fitted.toml")
    assert {path.name for path in Path().glob("fitted*")} == {
        f"fitted_{arm}.{kind}" for arm in friction for kind in ("toml", "urdf")
    }
    assert result["held_out"] == "the last logs of 3 machines"
    assert result["growth"] < 0.5
    assert not result["unlike"]
    rows = {row["name"]: row for row in result["parameters"]}
    for arm, viscous in friction.items():
        row = rows[f"friction.elbow.viscous@{arm}"]
        assert abs(row["after"] - viscous) < 4 * row["standard_error"] < 0.02
        written = tomllib.loads(Path(f"fitted_{arm}.toml").read_text())["parameters"]
        assert written["path"] == f"fitted_{arm}.urdf"
        assert written["friction"]["elbow"]["viscous"] == row["after"]
        assert written["armature"] == {"elbow": 0.004}
    arms: list[Any] = [models.load(f"fitted_{arm}.toml").model for arm in friction]
    np.testing.assert_array_equal(*(arm.space(jnp.zeros(2)) for arm in arms[:2]))


def test_init_drafts_a_file_that_loads():
    result = command("init", "log.csv", "-o", "draft.toml")
    assert result["columns"] == {"t": "t", "q": ["angle"], "u": [], "v": []}
    file = models.load("draft.toml")
    assert file.quantum == pytest.approx(1e-3, rel=1e-3)
    assert file.model.inputs == 0
    assert "there is such a file already" in refused(2, "init", "log.csv", "-o", "draft.toml")
    logs.write("odd.csv", {"t": np.arange(9.0) / 100, "a": np.ones(9)})
    said = refused(2, "init", "odd.csv", "-o", "odd.toml")
    assert "odd.csv: no column is named like a position" in said
    assert "the columns of numbers are t, a" in said
