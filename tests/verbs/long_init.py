"""What takes long of `test_init.py`."""

import re

import numpy as np
import pytest
from test_init import T, log, unit_of

import covariant
from covariant import models

MACHINES = [
    (names, inputs)
    for names in (["cart_m", "pole_deg"], ["pole_rad", "cart_mm"], ["x [m]"], ["x (mm)", "y (mm)", "turn_deg"])
    for inputs in {0, 1, len(names)}
]


@pytest.mark.exhaustive("names1-1")
@pytest.mark.parametrize(("names", "inputs"), MACHINES)
def test_a_machine_that_slides_is_drafted_with_its_equations(tmp_path, names, inputs):
    table = log(names, inputs)
    result = covariant.verbs.init(table)
    path = result.save(tmp_path / f"{len(names)}-{'-'.join(name[:2] for name in names)}{inputs}.toml")
    assert sorted(file.suffix for file in tmp_path.iterdir() if file.is_file()) == [".py", ".toml"]
    file = models.load(path)
    n = len(names)
    sliding = sum(unit_of(name).endswith("m") for name in names)
    assert file.model.units == ("m",) * sliding + ("rad",) * (n - sliding)
    assert len(file.columns.u) == inputs
    quantum = np.broadcast_to(np.asarray(file.quantum), n)
    np.testing.assert_allclose(quantum, [1e-4 if unit == "m" else 1e-3 for unit in file.model.units], rtol=1e-3)
    record = covariant.estimate(
        path, table, anyway=True, overrides={"uncertainty.acceleration": 2.0, "uncertainty.correlation_time": 0.01}
    )
    assert np.isfinite(record.velocity).all()


def test_angles_that_start_a_turn_anew_are_no_jumps(tmp_path):
    """As a wheel of an encoder that counts from 0 to 360°, beside two slides."""
    wheel = 2.0 * T + 20 * T**2 + np.random.default_rng(0).normal(0, 1e-3, T.size)
    table = log(["x [m]", "y [m]"], 0).assign(wheel_deg=np.degrees(wheel % (2 * np.pi)))
    assert np.abs(np.diff(table["wheel_deg"])).max() > 300
    result = covariant.verbs.init(table)
    assert result.draft.noise[-1] == pytest.approx(1e-3, rel=0.2)
    file = models.load(result.save(tmp_path / "wheel.toml"))
    assert file.model.circles == (2,)
    data = {"uncertainty.acceleration": 50.0, "uncertainty.correlation_time": 0.01}
    speed = covariant.estimate(file, table, overrides=data, anyway=True).velocity[150:, 2]
    np.testing.assert_allclose(speed, (2.0 + 40 * T)[150:], atol=4.0)


@pytest.mark.exhaustive
def test_the_finding_of_friction_is_a_command_for_this_draft_and_log(tmp_path):
    path = covariant.verbs.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "my draft.toml")
    truth = {"parameters.viscous": [1.0, 0.02], "parameters.coulomb": [0.0, 0.0]}
    settings = {"duration": 8.0, "rate": 200.0, "q0": [0.0, 0.5], "amplitude": [3.0], "frequency": 0.9, "noise": 1e-4}
    run = covariant.simulate(path, overrides=truth, **settings).save(tmp_path / "run.csv")
    result = covariant.check(path, run)
    (line,) = (each.line for each in result.findings if "friction" in each.what)
    begin, _, names = line.partition(" --parameters ")
    assert begin == f"covariant fit '{path}' {run}"
    assert "viscous" in names.split(",")
    assert models.family(str(path), names.split(",")).names[0] == "viscous[0]"
    # Of a model file without the number there is nothing to fit.
    path.write_text(re.sub("^viscous", "# viscous", path.read_text(), flags=re.MULTILINE))
    (line,) = (each.line for each in covariant.check(path, run).findings if "friction" in each.what)
    assert line == "give the model friction"
