"""What is exported is what `estimate` ran: the same result codes, and the same estimates to rounding."""

import ctypes
import functools
import importlib
import json
import platform
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest

import covariant
from covariant.calibration import usual_speeds
from covariant.codegen import _wasm
from covariant.signals import Record, StepCode
from covariant.workflow._export import beyond_proof

MODEL = """system = "pendulum_chain"
parameters = {mass = [1.0], length = [0.5]}

[columns]
q = ["hip"]
u = ["motor"]

[measurement]
std = 1e-3

[uncertainty]
acceleration = 1.0
"""
MOTION = "motion_acceleration = 50.0\nmotion_time = 0.1\n"
RATE, ROWS = 200.0, 800
OBSERVERS = pytest.param("intrinsic", marks=pytest.mark.long), "filtered-derivative"
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
in_a_unit = pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="the folder of the binary is another one"
)


@functools.cache
def log() -> Record:
    """A swing with outliers, alone and as three in a row, missing readings, and a hole of a quarter of a second."""
    h, rng = 1 / RATE, np.random.default_rng(0)
    t = h * np.arange(ROWS)
    u = 0.3 * np.sin(3 * t)
    x, states = np.array([0.6, 0.0]), []
    for k in range(ROWS):
        states.append(x)
        for _ in range(20):
            v = x[1] + (u[k] / 0.25 - 19.62 * np.sin(x[0])) * h / 20
            x = np.array([x[0] + v * h / 20, v])
    y = np.array(states)[:, :1] + 1e-3 * rng.normal(size=(ROWS, 1))
    y[[40, 90]] += 0.5
    y[60:63] += [[0.4], [-0.3], [0.5]]
    y[[50, 91, 120]] = np.nan
    y[140:190] = np.nan  # u was logged there
    y[200] = 1e12  # in a log as any number
    return Record(t, u[:, None], y)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("what_ran")
    (folder / "pendulum.toml").write_text(MODEL + MOTION)
    return folder


@pytest.fixture(scope="module", params=OBSERVERS)
def ran(request, folder):
    """The run of `estimate`, and what exports the same observer."""
    name = request.param.partition("-")[0]
    model, chosen = folder / "pendulum.toml", {"observer": request.param, "rate": RATE, "audit": False, "name": name}
    result = covariant.estimate(model, log(), observer=request.param, engine="jax")

    def export(out, **options):
        covariant.export(model, folder / out, **chosen, **options)
        return folder / out

    return name, result, export


def same(result, codes, estimates, atol=1e-9):
    assert [StepCode(c).name for c in codes] == [StepCode(c).name for c in result.codes]
    np.testing.assert_allclose(estimates, np.asarray(result.run.estimate), rtol=0, atol=atol)


def test_the_log_has_what_the_law_is_about(ran):
    name, result, _ = ran
    codes = [StepCode(c).name for c in result.codes]
    assert codes[40] == codes[90] == "OUTLIER"
    assert codes[50] == codes[150] == codes[200] == "COASTED"
    assert codes[:40] == ["OK"] * 40
    assert name != "intrinsic" or np.abs(result.velocity).max() < 4


@needs_compiler
def test_c_does_what_ran(ran):
    name, result, export = ran
    source = export(f"{name}_c") / f"{name}.c"
    library = source.with_suffix(".so")
    subprocess.run(["cc", "-std=c99", "-O1", "-fPIC", "-shared", source, "-lm", "-o", library], check=True)
    code, numbers = ctypes.CDLL(str(library)), (ctypes.c_double * 1)
    params = ctypes.addressof(ctypes.c_double.in_dll(code, f"{name}_default"))
    state, output = ctypes.create_string_buffer(4096), (ctypes.c_double * 2)()
    init, step, estimate = (getattr(code, f"{name}_{f}") for f in ("init", "step", "estimate"))
    params, at = ctypes.c_void_p(params), log()
    codes, estimates = [init(state, params, numbers(*at.y[0]), ctypes.c_double(0.0))], []
    for k in range(ROWS):
        if k:
            dt = ctypes.c_double(at.t[k] - at.t[k - 1])
            codes.append(step(state, params, numbers(*at.u[k - 1]), numbers(*at.y[k]), None, dt))
        estimate(state, params, output)
        estimates.append(list(output))
    same(result, codes, estimates)


@pytest.mark.long
@needs_compiler
def test_the_python_module_does_what_ran(ran, monkeypatch):
    name, result, export = ran
    monkeypatch.syspath_prepend(export(f"{name}_module", python=True) / "python")
    run = importlib.import_module(name).run(log().t, log().y, log().u)
    same(result, run.result, np.concatenate([run.q, run.v], axis=1))


@pytest.mark.long
@needs_compiler
@in_a_unit
def test_a_unit_does_what_ran(ran, tmp_path):
    """Its outputs are predicted to the next stamp, where the innovations of the run are."""
    name, result, export = ran
    with zipfile.ZipFile(export(f"{name}.fmu", fmi="2.0")) as packed:
        packed.extractall(tmp_path)
    description = ElementTree.parse(tmp_path / "modelDescription.xml").getroot()
    code = ctypes.CDLL(str(tmp_path / "binaries" / "linux64" / f"{name}.so"))
    code.fmi2Instantiate.restype = ctypes.c_void_p
    unit = ctypes.c_void_p(code.fmi2Instantiate(b"a", 1, description.get("guid").encode(), b"", None, 0, 0))
    places = {v.get("name"): int(v.get("valueReference")) for v in description.iter("ScalarVariable")}

    def accessed(function, variable, value):
        place = (ctypes.c_uint32 * 1)(places[variable])
        assert function(unit, place, ctypes.c_size_t(1), ctypes.byref(value)) == 0
        return value.value

    at, codes, predicted = log(), [], []
    accessed(code.fmi2SetReal, "y[1]", ctypes.c_double(at.y[0, 0]))
    code.fmi2SetupExperiment(unit, 0, ctypes.c_double(0), ctypes.c_double(0), 0, ctypes.c_double(0))
    assert code.fmi2EnterInitializationMode(unit) == code.fmi2ExitInitializationMode(unit) == 0
    for k in range(ROWS - 1):
        accessed(code.fmi2SetReal, "y[1]", ctypes.c_double(at.y[k, 0]))
        accessed(code.fmi2SetReal, "u[1]", ctypes.c_double(at.u[k, 0]))
        assert code.fmi2DoStep(unit, ctypes.c_double(at.t[k]), ctypes.c_double(at.t[k + 1] - at.t[k]), 1) == 0
        codes.append(accessed(code.fmi2GetInteger, "outcome", ctypes.c_int()))
        predicted.append(accessed(code.fmi2GetReal, "q[1]", ctypes.c_double()))
    assert codes == result.codes[:-1].tolist()
    seen = np.isfinite(at.y[1:, 0]) & (np.abs(at.y[1:, 0]) < 10)
    expected = at.y[1:, 0] - np.asarray(result.run.info.innovation)[1:, 0]
    np.testing.assert_allclose(np.array(predicted)[seen], expected[seen], rtol=0, atol=1e-9)
    code.fmi2FreeInstance(unit)


@pytest.mark.long
@needs_compiler
def test_webassembly_does_what_ran(folder, tmp_path):
    try:
        _wasm._compiled({"a.c": "int a;", "calls.c": "#include <math.h>\nint b;"})
    except ValueError:
        pytest.skip("there is no compiler for WebAssembly")
    if shutil.which("node") is None:
        pytest.skip("there is no node")
    model, at = folder / "pendulum.toml", log()
    result = covariant.estimate(model, at, engine="jax")
    covariant.export(model, tmp_path / "c", rate=RATE, audit=False, name="web", wasm=True)
    rows = json.dumps([[y, u] for y, u in zip(at.y[:, 0].tolist(), at.u[:, 0].tolist(), strict=True)])
    (tmp_path / "use.js").write_text(
        f"""const rows = {rows};
require("./c/web.js").load().then(({{ Observer }}) => {{
    const observer = new Observer();
    console.log(JSON.stringify(rows.map(([y, u], k) => {{
        const code = observer.step([y], {1 / RATE}, k ? [rows[k - 1][1]] : [0]);
        const x = observer.estimate();
        return [code, x.q[0], x.v[0]];
    }})));
}});
"""
    )
    done = subprocess.run(["node", "use.js"], cwd=tmp_path, capture_output=True, text=True, check=True)
    rows = np.array(json.loads(done.stdout))
    same(result, rows[:, 0].astype(int), rows[:, 1:])


# What the texts say, without a line of C compiled.


def exported(folder, text=MODEL + MOTION, name="speed", **options):
    """An export of a filter without a model, the quickest to write."""
    (folder / "pendulum.toml").write_text(text)
    chosen = {"observer": "filtered-derivative", "rate": RATE, "audit": False, "name": name} | options
    return covariant.export(folder / "pendulum.toml", folder / "c", **chosen)


def texts(folder) -> list[str]:
    """Header, data sheet and README on one line each, without the breaks of lines."""
    files = ("speed.h", "DATASHEET.md", "README.md")
    return [" ".join((folder / "c" / file).read_text(encoding="utf-8").split()) for file in files]


def test_header_data_sheet_and_readme_tell_the_gate_the_units_and_each_code(tmp_path):
    result = exported(tmp_path)
    assert result.warnings == ()
    assert "by the noise 0.001 rad and the usual speed 5 rad/s" in result.gate
    assert result.summary["gate"] == result.gate
    assert all(result.gate in text for text in (*texts(tmp_path), str(result)))
    header, sheet, _ = texts(tmp_path)
    assert "y: hip [rad]" in header
    assert "- u: motor [N m]" in sheet
    assert "- v: v1 [rad/s]" in sheet
    for code in StepCode:
        assert f"SPEED_{code.name} = {int(code)}" in header
        assert f"/* {code.message} */" in header
        assert f"| {int(code)} | `SPEED_{code.name}` | {code.message} |" in sheet


def test_without_noise_a_gate_is_missed_in_every_text(tmp_path):
    result = exported(tmp_path, MODEL[: MODEL.index("[measurement]")], observer="copy", alpha=20.0, beta=200.0)
    assert result.gate.startswith("It has no gate and refuses no measurement, since the model file tells no noise")
    assert "add `std` to [measurement] and `acceleration` to [uncertainty]" in result.gate
    assert all(result.gate in text for text in (*texts(tmp_path), str(result)))
    assert "speed" not in result.program.numbers


def test_a_speed_that_nobody_told_is_a_warning_and_a_log_tells_it(tmp_path):
    result = exported(tmp_path, MODEL)
    assert "The speed is assumed" in result.gate
    assert "Give `log`" in result.warnings[0]
    assert result.program.numbers["speed"].tolist() == [1.0]
    table = log()._replace(y=3 * log().y)
    told = exported(tmp_path, MODEL, log=table, overwrite=True)
    model = covariant.models.load(tmp_path / "pendulum.toml").model
    assert told.warnings == ()
    assert told.program.numbers["speed"].tolist() == pytest.approx(usual_speeds(model, table))


def test_a_gate_can_be_left_out(tmp_path):
    result = exported(tmp_path, gate=False)
    assert "It has no gate and refuses no measurement, as asked." in texts(tmp_path)[0]
    assert "noise" not in result.program.numbers


@pytest.mark.parametrize("lost", [0, 2])
def test_a_certificate_says_what_the_gate_does_to_it(lost):
    text = beyond_proof(lost)
    assert ("covers up to 2 in a row" if lost else "does not cover") in text
    assert "Where a step returns OK it changed nothing" in text
