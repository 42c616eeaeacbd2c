"""A first model file for a log, of turning joints, of sliding ones, and of both; it loads, and moves."""

import itertools
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import leave

import covariant
from covariant import models

T = np.arange(400) * 2e-3
LENGTH = np.round(0.2 * np.sin(3 * T) / 1e-4) * 1e-4
ANGLE = np.round(np.cos(2 * T) / 1e-3) * 1e-3


def unit_of(name):
    return re.findall("[a-z]+", name)[-1]


def log(names, inputs):
    scale = {"m": 1.0, "mm": 1e3, "deg": 180 / np.pi, "rad": 1.0}
    table = {"time_ms": 1e3 * T}
    for name in names:
        table[name] = scale[unit_of(name)] * (LENGTH if unit_of(name).endswith("m") else ANGLE)
    return pd.DataFrame(table | {f"force{i}_N": np.cos(T + i) for i in range(inputs)})


def test_of_a_pole_on_a_cart_the_equations_are_those_of_the_textbook(tmp_path):
    path = covariant.verbs.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "textbook.toml")
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
    result = covariant.verbs.init(log(["cart_m", "pole_deg"], 1))
    (tmp_path / "a_model.py").write_text("mine = 1\n")
    with pytest.raises(ValueError, match=r"a_model.py: there is such a file already"):
        result.save(tmp_path / "a.toml")
    assert not (tmp_path / "a.toml").exists()
    assert (tmp_path / "a_model.py").read_text() == "mine = 1\n"


@pytest.mark.parametrize(
    ("draft", "message"),
    [("bench", "into the Python file beside it"), ("2nd", "wrote 2nd.toml\nwrote _2nd_model.py")],
)
def test_the_command_writes_both_files_and_names_them(tmp_path, monkeypatch, draft, message):
    monkeypatch.chdir(tmp_path)
    log(["cart_m", "pole_deg"], 1).to_csv("run.csv", index=False)
    code, out, _ = leave("init", "run.csv", "-o", f"{draft}.toml")
    assert (code, message in out) == (0, True), out
    (module,) = (path.stem for path in tmp_path.glob("*.py"))
    assert f'system = "{module}:make"' in (tmp_path / f"{draft}.toml").read_text()
    assert module == ("bench_model" if draft == "bench" else "_2nd_model")


def test_a_model_file_gets_the_equations_of_its_own_folder(tmp_path):
    """In one process, from folders with files of the same names."""
    drafts = {"a": log(["cart_m", "pole_deg"], 1), "b": log(["x [m]"], 1), "c": log(["cart_m", "pole_deg"], 1)}
    for name, table in drafts.items():
        (tmp_path / name).mkdir()
        covariant.verbs.init(table).save(tmp_path / name / "draft.toml")
    equations = tmp_path / "c" / "draft_model.py"
    equations.write_text(equations.read_text().replace('"cart", "pole"', '"sledge", "arm"'))
    for _ in range(2):
        names = [models.load(tmp_path / name / "draft.toml").model.coordinates for name in "abc"]
        assert names == [("cart", "pole"), ("x",), ("sledge", "arm")]


def test_equations_that_were_edited_are_read_again(tmp_path):
    path = covariant.verbs.init(log(["cart_m", "pole_deg"], 1)).save(tmp_path / "edited.toml")
    equations = tmp_path / "edited_model.py"
    for name in ("sledge", "wagon"):
        equations.write_text(re.sub(r'coordinates=\("\w+"', f'coordinates=("{name}"', equations.read_text()))
        assert models.load(path).model.coordinates == (name, "pole")


def test_forces_come_before_torques_as_lengths_before_angles():
    table = log(["pole_deg", "cart_m"], 0)
    table["pole_Nm"], table["cart_N"] = np.cos(T), np.sin(T)
    found = covariant.verbs.init(table).draft
    assert (found.q, found.u) == (("cart_m", "pole_deg"), ("cart_N", "pole_Nm"))
    assert covariant.verbs.init(table, columns={"u": ["pole_Nm", "cart_N"]}).draft.u == ("pole_Nm", "cart_N")


def test_the_marks_of_all_drafted_lines_can_be_taken_away_after_a_tuning(tmp_path):
    path = covariant.verbs.init(log(["a_deg", "b_deg"], 2)).save(tmp_path / "draft.toml")
    text, content = path.read_text(), models.document(str(path))
    content["uncertainty"] = {"acceleration": 3.5, "correlation_time": 0.02}
    tuned = models.rewrite(text, content)
    for each in (text, tuned):
        path.write_text(re.sub(r"^# (?=\[|\w+ = )", "", each, flags=re.MULTILINE))
        assert models.load(path).acceleration_std == (3.5 if each is tuned else 2.0)
