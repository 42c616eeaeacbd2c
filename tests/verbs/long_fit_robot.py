"""What takes long of `test_fit_robot.py`."""

import tomllib

import jax.numpy as jnp
import numpy as np
import pytest
from test_fit_robot import LAW, MODEL, TRUTH, fitted, folder

from covariant import models
from covariant.signals import Record
from covariant.verbs import MisfitError, fit, simulate


@pytest.mark.exhaustive
def test_what_the_log_shows_is_the_truth_and_the_rest_is_named(fitted):
    rows = {row["name"]: row for row in fitted.summary["parameters"]}
    truth = {f"friction.elbow.{kind}": value for kind, value in LAW["elbow"].items()} | {"armature.elbow": 0.004}
    for name, value in truth.items():
        assert rows[name]["determined"], name
        assert abs(rows[name]["after"] - value) < max(4 * rows[name]["standard_error"], 1e-4), name
    assert not rows["inertia.upper.mass"]["determined"]
    assert "inertia.upper.mass" in fitted.warnings[0]
    assert fitted.summary["growth"] < 0.1
    assert fitted.summary["rank"] < len(rows)
    text = str(fitted)
    assert "Residual torques in windows of" in text
    assert "| armature.elbow" in text


@pytest.mark.exhaustive
def test_the_fitted_robot_is_written_with_a_urdf_file_beside_it(fitted, folder):
    (folder / "out").mkdir()
    path = fitted.save(folder / "out" / "fitted.toml")
    content = tomllib.loads(path.read_text())
    assert content["parameters"]["path"] == "fitted.urdf"
    assert set(content["parameters"]["friction"]) == {"elbow"}
    assert "# from the works" in path.read_text()
    written = models.load(str(path)).model
    q, v, u = np.random.default_rng(0).normal(size=(3, 2))
    robot = fitted.content["parameters"] | {"path": "double_pendulum"}
    expected = models.robots.load(**robot)
    t = np.zeros(())
    ours, theirs = (np.asarray(models.acceleration(m, *map(jnp.asarray, (t, q, v, u)))) for m in (written, expected))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    path.unlink()
    with pytest.raises(ValueError, match=r"fitted\.urdf: there is such a file already"):
        fitted.save(folder / "out" / "fitted.toml")
    machine = folder / "machine"
    before = (machine / "arm.urdf").read_bytes()
    with pytest.raises(ValueError, match=r"arm\.urdf: the robot is read from this file, which is never replaced"):
        fitted.save(machine / "arm.toml", overwrite=True)
    assert (machine / "arm.urdf").read_bytes() == before
    assert (machine / "arm.toml").read_text() == MODEL


@pytest.mark.exhaustive
def test_a_log_at_rest_or_in_degrees_is_refused():
    t = np.arange(2000) / 250.0
    rest = Record(t, np.zeros((2000, 2)), 1e-4 * np.random.default_rng(0).normal(size=(2000, 2)))
    with pytest.raises(MisfitError, match=r"too little or too short.* log a motion") as refused:
        fit("double_pendulum", rest, "friction")
    assert refused.value.exit_code == 1
    drive = {"duration": 8.0, "rate": 250.0, "amplitude": [2.2, 0.5], "frequency": 0.6, "noise": 1e-4}
    log = simulate("double_pendulum", **drive, overrides=TRUTH).record
    with pytest.raises(MisfitError, match=r'\[units\] q = "deg"; `anyway=True` goes on'):
        fit("double_pendulum", log._replace(y=np.degrees(log.y)), "friction")
