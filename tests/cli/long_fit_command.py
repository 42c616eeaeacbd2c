"""`covariant fit` and `covariant init`: what they print, write and refuse: what takes long."""

import tomllib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from commands import command, leave, refused
from test_fit_command import folder, inside

from covariant import logs, models
from covariant.verbs import simulate


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
    code, said, _ = leave(*arguments)
    assert code == 1
    assert "predicts wrong.csv, which it has not seen, worse than before" in said
    assert "so it is not written" in said
    assert not Path("no.toml").exists()


FIRST = ("--set", "parameters.length=[0.4]", "--set", "parameters.gravity=9.0")


@pytest.mark.exhaustive
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
    refused(*arguments, "-o", "fitted.toml", named=["fitted_mid.urdf: there is such a file already"])
    Path("fitted_mid.urdf").unlink()
    refused(*arguments[:-1], "gravity", named=["each: unknown number in --parameters 'gravity'"])
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
