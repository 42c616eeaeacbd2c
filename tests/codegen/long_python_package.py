"""What takes long of `test_python_package.py`."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_python_package import RATE, ROWS, log, needs_compiler, observer, package

import covariant
from covariant import models, observers
from covariant.engine import Stream, run_log
from scalargraph import compiler as _compile


@pytest.mark.exhaustive
@needs_compiler
def test_samples_are_those_of_the_log_and_of_a_stream(package):
    chosen, y, _ = observer("pendulum")
    made, record = package("pendulum"), log(y, 2)
    run = made.run(record.t, record.y, record.u)
    stepped, stream = made.Observer(), Stream(chosen, y, RATE, engine="jax")
    assert np.isnan(stepped.estimate().q).all()
    assert stepped.step([np.nan, 0.0], 0.1) is made.Result.COASTED
    assert stepped.start(record.y[0], record.t[0]) is made.Result.OK
    x, snapshot = stream.step(record.t[0], record.y[0], record.u[0]), stepped
    for k in range(1, ROWS):
        result = stepped.step(record.y[k], record.t[k] - record.t[k - 1], record.u[k - 1])
        x = stream.step(record.t[k], record.y[k], record.u[k - 1])
        assert result == run.result[k] == stream.result
        snapshot = stepped.copy() if k == 30 else snapshot
    estimate = stepped.estimate()
    np.testing.assert_array_equal(np.concatenate(estimate), np.concatenate([run.q[-1], run.v[-1]]))
    np.testing.assert_allclose(np.concatenate(estimate), x, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(stepped.state["last_innovation"], run.innovation[-1])
    np.testing.assert_array_equal(snapshot.estimate().v, run.v[30])
    # Numbers that are wrong are codes and never exceptions; they leave the estimate.
    before = stepped.estimate()
    codes = [stepped.step(record.y[0], dt) for dt in (0.0, -1.0, np.nan)]
    assert [code.name for code in codes] == ["REPEATED", "STEP_REFUSED", "STEP_REFUSED"]
    np.testing.assert_array_equal(stepped.estimate().v, before.v)
    assert stepped.step([np.nan] * 2, 0.004, [np.nan, 0.0]).name == "INPUT_HELD"


@pytest.mark.exhaustive
@needs_compiler
def test_numbers_may_be_changed(package):
    made = package("pendulum")
    record = log(np.zeros(2), 2)
    changed = {"alpha": 30.0, "viscous": [0.3, 0.1]}
    model = models.pendulum_chain(viscous=(0.3, 0.1))
    expected, _ = run_log(observers.Intrinsic(model, 30.0, 200.0, substeps=1), record, engine="jax")
    run = made.run(record.t, record.y, record.u, params=changed)
    np.testing.assert_allclose(run.v, expected.estimate[:, 2:], rtol=0, atol=1e-12)
    stepped = made.Observer(changed)
    stepped.params["viscous"][1] = 0.7
    assert stepped.params["viscous"].tolist() == [0.3, 0.7]
    assert made.Observer().params["viscous"].tolist() == [0.01, 0.02]
    assert stepped.copy().params["alpha"] == 30.0


@needs_compiler
def test_a_wheel_installs_without_an_index(package, tmp_path):
    (wheel,) = Path(package("slope").__file__ or "").parents[1].glob("*.whl")
    target = tmp_path / "installed"
    options = ["--no-index", "--no-deps", "--disable-pip-version-check", "--target", target]
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", *options, wheel], check=True)
    assert (target / "made_slope" / "made_slope.c").exists()
    assert "Requires-Dist: numpy" in next(target.glob("*.dist-info/METADATA")).read_text()
    code = "import made_slope as m; print(m.__file__, m.run([0, 0.004], [[0.1], [0.1]]).v[1, 0])"
    done = subprocess.run([sys.executable, "-c", code], cwd=target, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(str(target))


def test_the_command_writes_a_package_and_warns_where_there_is_no_compiler(tmp_path, monkeypatch):
    options = {"rate": 500.0, "alpha": 20.0, "beta": 200.0}
    monkeypatch.setattr(_compile, "compiler", lambda: None)
    monkeypatch.setattr(_compile, "zig", lambda: None)
    result = covariant.export("oscillator", tmp_path / "c", python=True, **options)
    assert result.warnings == (
        "the Python package holds sources and no library: there is no C compiler; set CC, install cc, or pip install "
        "ziglang",
    )
    names = {path.relative_to(tmp_path / "c").as_posix() for path in result.files if "python" in path.parts}
    files = ("__init__.py", "__main__.py", "oscillator.c", "oscillator.h", "oscillator_rows.c")
    assert names == {f"python/oscillator/{file}" for file in files}
    readme = (tmp_path / "c" / "README.md").read_text(encoding="utf-8")
    assert "| `python/oscillator` | a Python package that needs NumPy alone" in readme
    assert ".wasm" not in readme
    with pytest.raises(ValueError, match="python is for a folder"):
        covariant.export("oscillator", tmp_path / "c.fmu", python=True, **options)
    with pytest.raises(ValueError, match="'lambda' is a word of Python; take another name, such as 'my_lambda'"):
        covariant.export("oscillator", tmp_path / "d", python=True, name="lambda", **options)
