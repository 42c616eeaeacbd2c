"""A first model file for a log, of turning joints, of sliding ones, and of both; it loads, and moves."""

import itertools
import re
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import covariant
from covariant import models
from covariant.cli import main

T = np.arange(400) * 2e-3
LENGTH = np.round(0.2 * np.sin(3 * T) / 1e-4) * 1e-4
ANGLE = np.round(np.cos(2 * T) / 1e-3) * 1e-3

MACHINES = [
    (names, inputs)
    for names in (["cart_m", "pole_deg"], ["pole_rad", "cart_mm"], ["x [m]"], ["x (mm)", "y (mm)", "turn_deg"])
    for inputs in {0, 1, len(names)}
]


def unit_of(name):
    return re.findall("[a-z]+", name)[-1]


def log(names, inputs):
    scale = {"m": 1.0, "mm": 1e3, "deg": 180 / np.pi, "rad": 1.0}
    table = {"time_ms": 1e3 * T}
    for name in names:
        table[name] = scale[unit_of(name)] * (LENGTH if unit_of(name).endswith("m") else ANGLE)
    return pd.DataFrame(table | {f"force{i}_N": np.cos(T + i) for i in range(inputs)})


@pytest.mark.long("names0", "names1", "names2", "names9")
@pytest.mark.parametrize(("names", "inputs"), MACHINES)
def test_a_machine_that_slides_is_drafted_with_its_equations(tmp_path, names, inputs):
    table = log(names, inputs)
    result = covariant.workflow.init(table)
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


def test_of_a_pole_on_a_cart_the_equations_are_those_of_the_textbook(tmp_path):
    path = covariant.workflow.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "textbook.toml")
    assert 'coordinates=("cart", "pole")' in path.with_name("textbook_model.py").read_text()
    model = models.load(path, {"parameters.coulomb": [0.0, 0.0], "parameters.viscous": [0.0, 0.0]}).model
    big, m, com, inertia, force = 1.0, 0.1, 0.15, 0.001, 0.7
    acceleration = jax.jit(partial(models.acceleration, model, jnp.zeros(())))
    for angle, rate in itertools.product((0.3, 2.0, -1.1), (0.0, 1.7)):
        q, v = np.array([0.1, angle]), np.array([-0.4, rate])
        found = np.asarray(acceleration(*map(jnp.asarray, (q, v, [force]))))
        # (M + m) x" + m l (theta" cos - theta'^2 sin) = F;  (I + m l^2) theta" + m l x" cos + m g l sin = 0
        matrix = [[big + m, m * com * np.cos(angle)], [m * com * np.cos(angle), inertia + m * com**2]]
        right = [force + m * com * rate**2 * np.sin(angle), -m * 9.81 * com * np.sin(angle)]
        np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-12)


def test_files_that_exist_are_kept(tmp_path):
    result = covariant.workflow.init(log(["cart_m", "pole_deg"], 1))
    (tmp_path / "a_model.py").write_text("mine = 1\n")
    with pytest.raises(ValueError, match=r"a_model.py: there is such a file already"):
        result.save(tmp_path / "a.toml")
    assert not (tmp_path / "a.toml").exists()
    assert (tmp_path / "a_model.py").read_text() == "mine = 1\n"


def printed_by_init(draft: str, monkeypatch, capsys) -> str:
    """What the command prints of a log of a cart-pole in the working folder."""
    log(["cart_m", "pole_deg"], 1).to_csv("run.csv", index=False)
    monkeypatch.setattr(sys, "argv", ["covariant", "init", "run.csv", "-o", draft])
    with pytest.raises(SystemExit, match="0"):
        main()
    return capsys.readouterr().out


def test_the_command_writes_both_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "into the Python file beside it" in printed_by_init("bench.toml", monkeypatch, capsys)
    assert (tmp_path / "bench_model.py").exists()
    assert 'system = "bench_model:make"' in (tmp_path / "bench.toml").read_text()


def test_a_model_file_gets_the_equations_of_its_own_folder(tmp_path):
    """In one process, from folders with files of the same names."""
    drafts = {"a": log(["cart_m", "pole_deg"], 1), "b": log(["x [m]"], 1), "c": log(["cart_m", "pole_deg"], 1)}
    for name, table in drafts.items():
        (tmp_path / name).mkdir()
        covariant.workflow.init(table).save(tmp_path / name / "draft.toml")
    equations = tmp_path / "c" / "draft_model.py"
    equations.write_text(equations.read_text().replace('"cart", "pole"', '"sledge", "arm"'))
    for _ in range(2):
        names = [models.load(tmp_path / name / "draft.toml").model.coordinates for name in "abc"]
        assert names == [("cart", "pole"), ("x",), ("sledge", "arm")]


def test_equations_that_were_edited_are_read_again(tmp_path):
    path = covariant.workflow.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "edited.toml")
    equations = tmp_path / "edited_model.py"
    for name in ("sledge", "wagon"):
        equations.write_text(re.sub(r'coordinates=\("\w+"', f'coordinates=("{name}"', equations.read_text()))
        assert models.load(path).model.coordinates == (name, "pole")


def test_forces_come_before_torques_as_lengths_before_angles():
    table = log(["pole_deg", "cart_m"], 0)
    table["pole_Nm"], table["cart_N"] = np.cos(T), np.sin(T)
    found = covariant.workflow.init(table).draft
    assert (found.q, found.u) == (("cart_m", "pole_deg"), ("cart_N", "pole_Nm"))
    assert covariant.workflow.init(table, columns={"u": ["pole_Nm", "cart_N"]}).draft.u == ("pole_Nm", "cart_N")


def test_angles_that_start_a_turn_anew_are_no_jumps(tmp_path):
    """As a wheel of an encoder that counts from 0 to 360°, beside two slides."""
    wheel = 2.0 * T + 20 * T**2 + np.random.default_rng(0).normal(0, 1e-3, T.size)
    table = log(["x [m]", "y [m]"], 0).assign(wheel_deg=np.degrees(wheel % (2 * np.pi)))
    assert np.abs(np.diff(table["wheel_deg"])).max() > 300
    result = covariant.workflow.init(table)
    assert result.draft.noise[-1] == pytest.approx(1e-3, rel=0.2)
    file = models.load(result.save(tmp_path / "wheel.toml"))
    assert file.model.circles == (2,)
    data = {"uncertainty.acceleration": 50.0, "uncertainty.correlation_time": 0.01}
    speed = covariant.estimate(file, table, overrides=data, anyway=True).velocity[150:, 2]
    np.testing.assert_allclose(speed, (2.0 + 40 * T)[150:], atol=4.0)


def test_the_marks_of_all_drafted_lines_can_be_taken_away_after_a_tuning(tmp_path):
    path = covariant.workflow.init(log(["a_deg", "b_deg"], 2)).save(tmp_path / "draft.toml")
    text, content = path.read_text(), models.document(str(path))
    content["uncertainty"] = {"acceleration": 3.5, "correlation_time": 0.02}
    tuned = models.rewrite(text, content)
    for each in (text, tuned):
        path.write_text(re.sub(r"^# (?=\[|\w+ = )", "", each, flags=re.MULTILINE))
        assert models.load(path).acceleration_std == (3.5 if each is tuned else 2.0)


def test_the_command_names_every_file_that_it_wrote(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "wrote 2nd.toml\nwrote _2nd_model.py" in printed_by_init("2nd.toml", monkeypatch, capsys)


def test_the_finding_of_friction_is_a_command_for_this_draft_and_log(tmp_path):
    path = covariant.workflow.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "my draft.toml")
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
