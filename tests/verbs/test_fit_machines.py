"""`fit(..., each=...)`: logs of several machines fitted together, with shared numbers and numbers of their own."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration.identification import held_out_logs
from covariant.verbs import check_machine_files, fit
from covariant.verbs._fit import FitResult
from covariant.verbs.base.inputs import Job

FRICTION = {"arm1": 0.05, "arm2": 0.12, "arm3": 0.3}
KNOWN = {"parameters.mass": [1.0], "parameters.length": [0.5], "parameters.com": [0.25], "inputs.between": "held"}
FIRST = KNOWN | {"parameters.inertia": [0.02], "parameters.viscous": [0.1]}
INERTIA = 0.03
NOISE = {"arm1": 1e-3, "arm2": 1e-3, "arm3": 5e-3}


def swings(viscous: float, noise: float, seed: int) -> list[Any]:
    truth = KNOWN | {"parameters.inertia": [INERTIA], "parameters.viscous": [viscous]}
    motion: dict[str, Any] = {"duration": 10.0, "rate": 50.0, "amplitude": 0.6, "noise": noise}
    return [
        covariant.simulate("pendulum_chain", q0=q0, frequency=f, seed=seed + k, overrides=truth, **motion).record
        for k, (q0, f) in enumerate([(0.6, 0.5), (-0.4, 0.7)])
    ]


@pytest.fixture(scope="module")
def arms() -> dict[str, list[Any]]:
    return {arm: swings(viscous, NOISE[arm], 10 * k) for k, (arm, viscous) in enumerate(FRICTION.items())}


def fitted(arms: dict[str, list[Any]] | list[Any], each: str | None) -> dict[str, tuple[float, float]]:
    result = fit("pendulum_chain", arms, "inertia,viscous", each=each, overrides=FIRST)
    rows = zip(result.columns["parameter"], result.values, result.standard_errors, strict=True)
    return {name: (value, error) for name, value, error in rows}


def test_the_last_log_of_each_machine_is_held_out():
    stamps = [np.arange(0.0, 10.0, 0.01)] * 6
    assert held_out_logs(stamps, 0.5, [0, 0, 1, 2, 1, 0]).tolist() == [False, False, False, False, True, True]
    assert held_out_logs(stamps[:3], 0.5, [2, 0, 1]).tolist() == [False] * 3
    # Of short logs two are held out, if there are as many more.
    assert held_out_logs(stamps, 2.0, [0] * 5 + [1]).tolist() == [False] * 3 + [True] * 2 + [False]


def test_each_machine_has_a_file_with_its_numbers(tmp_path):
    rows = [
        {"name": name, "before": 1.0, "after": value, "standard_error": 0.1, "determined": True}
        for name, value in (("mass", 2.0), ("viscous@arm1", 3.0), ("viscous@arm2", 4.0))
    ]
    contents = {arm: {"system": "oscillator", "parameters": {"stiffness": k}} for arm, k in (("arm1", 3), ("arm2", 4))}
    details = {"parameters": rows, "undetermined": [], "fitted_to": "a.csv", "better": True}
    result = FitResult([Job("oscillator", None)], {}, details, None, contents)
    assert result.save(tmp_path / "fitted.toml") == tmp_path / "fitted_arm1.toml"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fitted_arm1.toml", "fitted_arm2.toml"]
    text = (tmp_path / "fitted_arm2.toml").read_text()
    assert "stiffness = 4" in text
    assert "viscous@arm2 = 4 ±" in text
    assert "arm1" not in text
    (tmp_path / "fitted_arm1.toml").unlink()
    with pytest.raises(ValueError, match=r"fitted_arm2\.toml: there is such a file already"):
        result.save(tmp_path / "fitted.toml")
    assert not (tmp_path / "fitted_arm1.toml").exists()


def test_a_urdf_file_in_the_way_of_one_machine_leaves_no_file_of_another(tmp_path):
    inertia = {"lower": [0.6, 0.0, 0.0, -0.1, 0.02, 0.02, 0.001, 0.0, 0.0, 0.0]}
    robot = {"system": "robot", "parameters": {"path": "double_pendulum", "inertia": inertia}}
    details = {"parameters": [], "undetermined": [], "fitted_to": "a.csv", "better": True}
    result = FitResult([Job("double_pendulum", None)], {}, details, None, dict.fromkeys(("arm1", "arm2"), robot))
    (tmp_path / "fitted_arm2.urdf").write_text("mine\n")
    with pytest.raises(ValueError, match=r"fitted_arm2\.urdf: there is such a file already"):
        result.save(tmp_path / "fitted.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["fitted_arm2.urdf"]
    result.save(tmp_path / "fitted.toml", overwrite=True)
    written: Any = models.load(str(tmp_path / "fitted_arm2.toml")).model
    expected = models.robots.load("double_pendulum", inertia=inertia)
    q = jnp.array([0.3, -0.8])
    np.testing.assert_allclose(written.space(q), expected.space(q), rtol=1e-9)
    names = [path.name for path in result.written_files(tmp_path / "fitted.toml")]
    assert names == ["fitted_arm1.toml", "fitted_arm1.urdf", "fitted_arm2.toml", "fitted_arm2.urdf"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_a_file_of_a_machine_that_exists_is_refused_before_the_fit(tmp_path):
    (tmp_path / "fitted_right.toml").write_text("mine\n")
    logs = [tmp_path / machine / "log.csv" for machine in ("left", "right")]
    with pytest.raises(ValueError, match=r"fitted_right\.toml: there is such a file already"):
        check_machine_files("oscillator", tmp_path / "fitted.toml", logs)
    check_machine_files("oscillator", tmp_path / "fitted.toml", logs[:1])
