"""What is exported is what `estimate` ran: the same result codes, and the same estimates to rounding.

Each observer goes through logs with one fault each, by every target. `estimate` refuses a log whose stamps do not rise
or whose inputs are missing; the targets that take samples one by one are then compared with the steps of its observer.
"""

import ctypes
import functools
import importlib
import json
import platform
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import servo_machine

import covariant
from covariant.calibration import usual_speeds
from covariant.codegen import Program, _fmu, _wasm, fmu, write_fmu
from covariant.geometry.lie import SO3
from covariant.signals import Record, StepCode
from covariant.verbs._export import beyond_proof
from covariant.verbs.base.design import design
from covariant.verbs.base.inputs import Job, load, with_acting_inputs, with_sensor_delays

MODEL = """system = "pendulum_chain"
parameters = {mass = [1.0], length = [0.5], viscous = [0.4]}

[columns]
q = ["hip"]
u = ["motor"]

[measurement]
std = 1e-3

[uncertainty]
acceleration = 1.0
"""
MOTION = "motion_acceleration = 50.0\nmotion_time = 0.1\n"
FASTER = MOTION.replace("50", "100")
"""Of a motion as fast as that of the logs, so that a gate does not depend on the log."""
RATE, ROWS = 200.0, 600
AT = 100
"""Row at which a log has its fault."""
CLOSE = 1e-9
"""Largest difference of numbers, relative to those above 1."""
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
in_a_unit = pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="the folder of the binary is another one"
)


@functools.cache
def swing() -> Record:
    """A pendulum that turns over, so that its angle passes π."""
    h, rng, rows = 1 / RATE, np.random.default_rng(0), 2 * ROWS
    t = h * np.arange(rows)
    u = 0.3 * np.sin(3 * t)
    x, states = np.array([0.6, 8.0]), []
    for k in range(rows):
        states.append(x)
        for _ in range(20):
            v = x[1] + ((u[k] - 0.4 * x[1]) / 0.25 - 19.62 * np.sin(x[0])) * h / 20
            x = np.array([x[0] + v * h / 20, v])
    return Record(t, u[:, None], np.array(states)[:, :1] + 1e-3 * rng.normal(size=(rows, 1)))


@functools.cache
def turn() -> Record:
    """A top that spins, its attitude as matrices."""
    t, rng = np.arange(2 * ROWS) / RATE, np.random.default_rng(0)
    turned = jnp.stack([0.3 * np.sin(2 * t), 0.2 * np.cos(3 * t), 2 * t], axis=1)
    noise = jnp.asarray(1e-3 * rng.normal(size=(len(t), 3)))
    y = jax.vmap(lambda a, b: SO3.exp(a) @ SO3.exp(b))(turned, noise)
    return Record(t, 0.1 * np.sin(np.stack([t, 2 * t, 3 * t], axis=1)), np.asarray(y))


Fault = Callable[[Record], Record]


def moved(rows: Any, by: float) -> Fault:
    """Measurements of some rows are off by an angle."""

    def fault(log: Record) -> Record:
        y = log.y.copy()
        y[rows] = y[rows] @ np.asarray(SO3.exp(jnp.array([0.0, by, 0.0]))) if y.ndim == 3 else y[rows] + by
        return log._replace(y=y)

    return fault


def put(field: str, rows: Any, value: float, cells: Any = 0) -> Fault:
    """A number stands in place of those that some rows had, in their first cell or in all."""

    def fault(log: Record) -> Record:
        array = getattr(log, field).copy()
        array.reshape(len(array), -1)[rows, cells] = value
        return log._replace(**{field: array})

    return fault


def rows_lost(count: int) -> Fault:
    return lambda log: Record(*(np.delete(a, np.s_[AT : AT + count], axis=0) for a in log[:3]))


def whole_turn(log: Record) -> Record:
    """As a reading that is wrapped; a rotation has no such step, and gets half a turn."""
    return moved(np.s_[AT:], np.pi if log.y.ndim == 3 else -2 * np.pi)(log)


FAULTS: dict[str, Fault] = {
    "an outlier": moved(AT, 0.5),
    "three outliers": lambda log: moved(AT, 0.4)(moved(AT + 1, -0.3)(moved(AT + 2, 0.5)(log))),
    "rows lost for a quarter of a second": rows_lost(50),
    "a cell missing": put("y", AT, np.nan),
    "readings missing for a quarter of a second": put("y", np.s_[AT : AT + 50], np.nan, cells=np.s_[:]),
    "a jump that stays": moved(np.s_[AT:], 0.8),
    "a wrapped angle": whole_turn,
    "a number too large": put("y", AT, 1e12),
    "rows lost for more than a second": rows_lost(250),
    "a repeated stamp": lambda log: put("t", AT, log.t[AT - 1])(log),
    "a stamp back in time": lambda log: put("t", AT, log.t[AT - 3])(log),
    "an input missing": put("u", np.s_[AT : AT + 3], np.nan),
    "an infinite input": put("u", AT + 1, np.inf),
}
INPUTS = MODEL + FASTER + "[inputs]\n"
REFUSED = "a repeated stamp", "a stamp back in time", "an infinite input"
"""Faults with which `estimate` refuses a log, and so does the Python module."""
DEAR = "an outlier", "rows lost for a quarter of a second", "a jump that stays"
"""Faults of the logs of a group or a robot that `estimate` reads: it compiles anew for each of them."""
HOLES = "rows lost for a quarter of a second", "rows lost for more than a second", "an input missing"
"""Faults by which inputs are missing: the filter takes from the log what they may have been; it is exported with it."""


class Member(NamedTuple):
    """An observer of the law, its model file, a log without fault, its suite, "" for every commit, and the fault of the
    log with which it is exported."""

    observer: str
    text: str = MODEL + FASTER
    log: Callable[[], Record] = swing
    suite: str = "long"
    hole: str = ""


TOP = Path(__file__).parents[2] / "examples" / "heavy_top.toml"
MEMBERS = {
    "speed": Member("filtered-derivative", suite=""),
    "joint": Member("joint-kalman", suite="exhaustive"),
    "kalman": Member("intrinsic-kalman"),
    "holes": Member("intrinsic-kalman", hole=HOLES[0]),
    "ekf": Member("ekf", suite="exhaustive"),
    "implicit": Member("lagrangian-metric", suite="exhaustive"),
    "geodesic": Member("geodesic", suite="exhaustive"),
    "late": Member("copy", (MODEL + FASTER).replace("std = 1e-3", "std = 1e-3\ndelay = 0.023"), suite="exhaustive"),
    "sent": Member("copy", INPUTS + "delay = 0.013\nlag = 0.02\nlead = 0.015"),
    "servos": Member(
        "intrinsic", servo_machine.TEXT, lambda: servo_machine.run(1 / RATE, 2 * ROWS)[0], suite="exhaustive"
    ),
    "between": Member(
        "copy", INPUTS + 'delay = 0.004\nlag = 0.01\nlead = 0.02\nbetween = "linear"', suite="exhaustive"
    ),
    "commands": Member("intrinsic-kalman", INPUTS + "delay = 0.037", suite="exhaustive", hole="an input missing"),
    "group": Member("intrinsic", TOP.read_text(encoding="utf-8"), turn),
}


def log_of(member: Member, fault: str) -> Record:
    log = FAULTS[fault](member.log())
    return Record(*(a[:ROWS] for a in log[:3]))


class Ran(NamedTuple):
    """A log, what `estimate` made of it, or its message, and what the steps of its observer do."""

    log: Record
    codes: list[str]
    x: np.ndarray
    refused: str = ""


class Exported(NamedTuple):
    """An observer with all its exports, and its runs by fault."""

    name: str
    member: Member
    folder: Path
    program: Program
    runs: dict[str, Ran]


def elapsed(t: np.ndarray) -> np.ndarray:
    """Times (T,) since the last stamp that was not refused; 1 for the first row, which is no step."""
    dt, last = np.ones(len(t)), t[0]
    for k in range(1, len(t)):
        dt[k], last = t[k] - last, max(t[k], last)
    return dt


def named(codes) -> list[str]:
    return [StepCode(int(code)).name for code in codes]


def flat(estimate: Any) -> np.ndarray:
    """Estimates (T, k): configuration, then velocity."""
    parts = [np.asarray(leaf) for leaf in jax.tree.leaves(estimate)]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


@functools.cache
def has_wasm() -> bool:
    try:
        _wasm._compiled({"a.c": "int a;", "calls.c": "#include <math.h>\nint b;"})
    except ValueError:
        return False
    return shutil.which("node") is not None


def ran(model: Path, member: Member, steps: Callable, fault: str) -> Ran:
    log, refused = log_of(member, fault), ""
    codes, x = steps(log)
    if (log.y.ndim == 3 or "robot" in member.text) and fault not in (*DEAR, *REFUSED):
        return Ran(log, codes, x)
    own_design = member.observer == "intrinsic-kalman" and (fault in HOLES or member.hole) and fault != member.hole
    if own_design and fault not in REFUSED:
        return Ran(log, codes, x)
    try:
        run = covariant.estimate(model, log, observer=member.observer, engine="jax", anyway=True).run
    except ValueError as error:
        refused = str(error)
    else:
        assert named(run.info.result) == codes
        np.testing.assert_allclose(flat(run.estimate), x, rtol=CLOSE, atol=CLOSE)
    assert bool(refused) == (fault in REFUSED), refused
    return Ran(log, codes, x, refused)


def marked(name: str) -> Any:
    """The name of a member, marked by its suite."""
    suite = MEMBERS[name].suite
    return pytest.param(name, marks=[getattr(pytest.mark, suite)] if suite else [])


@pytest.fixture(scope="module", params=[marked(name) for name in MEMBERS])
def exported(request, tmp_path_factory) -> Exported:
    name, member = request.param, MEMBERS[request.param]
    folder = tmp_path_factory.mktemp(name)
    model = folder / "model.toml"
    model.write_text(member.text)
    chosen = {"observer": member.observer, "rate": RATE, "name": name}
    chosen |= {"log": log_of(member, member.hole)} if member.hole else {}
    result = covariant.export(model, folder / "c", python=True, wasm=has_wasm(), **chosen)
    known = log_of(member, member.hole) if member.hole else Record(*(a[:ROWS] for a in member.log()[:3]))
    loaded = load(Job(model, known, anyway=True), missing_inputs=True)
    observer = design(loaded.file, member.observer, None, loaded.rate, loaded).observer
    (observer,) = with_sensor_delays({member.observer: observer}, loaded).values()
    if member.observer != "filtered-derivative":
        observer = with_acting_inputs(observer, loaded.file, RATE)
    at_end = observer.input_at_end

    @jax.jit
    def stepped(t, u, y, dt):
        def step(state, row):
            state, info = observer.step(state, *row)
            return state, (observer.estimate(state), info.result)

        start = observer.init(y[0], t[0])
        if at_end:
            start, _ = observer.step(start, u[0], y[0], 0.0)
        return observer.estimate(start), jax.lax.scan(step, start, (u[1:] if at_end else u[:-1], y[1:], dt[1:]))[1]

    def steps(log: Record) -> tuple[list[str], np.ndarray]:
        first, (x, codes) = stepped(*(jnp.asarray(a) for a in (*log[:3], elapsed(log.t))))
        return ["OK", *named(codes)], np.concatenate([flat(jax.tree.map(lambda a: a[None], first)), flat(x)])

    return Exported(name, member, folder, result.program, {fault: ran(model, member, steps, fault) for fault in FAULTS})


def same(expected: Ran, codes, x) -> None:
    assert named(codes) == expected.codes
    np.testing.assert_allclose(x, expected.x, rtol=CLOSE, atol=CLOSE)


def test_the_logs_have_what_the_law_is_about(exported):
    codes = {fault: run.codes for fault, run in exported.runs.items()}
    for fault, each in codes.items():
        assert each[:AT] == ["OK"] * AT, fault
    assert codes["an outlier"][AT] == "OUTLIER"
    assert codes["readings missing for a quarter of a second"][AT] == codes["a number too large"][AT] == "COASTED"
    assert codes["a repeated stamp"][AT] in ("REPEATED", "OUTLIER")  # of two the larger one
    assert codes["a stamp back in time"][AT] == "STEP_REFUSED"


@needs_compiler
def test_c_does_what_ran(exported):
    source, y, u = exported.folder / "c" / f"{exported.name}.c", exported.program.measurements, exported.program.u
    library = source.with_suffix(".so")
    subprocess.run(["cc", "-std=c99", "-O1", "-fPIC", "-shared", source, "-lm", "-o", library], check=True)
    code = ctypes.CDLL(str(library))
    params = ctypes.addressof(ctypes.c_double.in_dll(code, f"{exported.name}_default"))
    size = sum(leaf.size for leaf in exported.program.output)
    state, output = ctypes.create_string_buffer(1 << 16), (ctypes.c_double * size)()
    init, step, estimate = (getattr(code, f"{exported.name}_{f}") for f in ("init", "step", "estimate"))
    init.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double]
    step.argtypes = [*[ctypes.c_void_p] * 5, ctypes.c_double]
    estimate.argtypes = [ctypes.c_void_p] * 3
    for expected in exported.runs.values():
        log, codes, estimates, dt = expected.log, [], [], elapsed(expected.log.t)
        measured, acting = (np.ascontiguousarray(a.reshape(ROWS, k)) for a, k in ((log.y, y), (log.u, -1)))
        for k in range(ROWS):
            if k:
                at_u = acting[k - 1 + exported.program.input_at_end].ctypes.data if u else None
                codes.append(step(state, params, at_u, measured[k].ctypes.data, None, dt[k]))
            else:
                codes.append(init(state, params, measured[0].ctypes.data, log.t[0]))
                if exported.program.input_at_end:
                    step(state, params, acting[0].ctypes.data, measured[0].ctypes.data, None, 0.0)
            estimate(state, params, output)
            estimates.append(list(output))
        same(expected, codes, np.array(estimates)[:, : expected.x.shape[1]])


def module_of(exported: Exported, monkeypatch) -> Any:
    monkeypatch.syspath_prepend(exported.folder / "c" / "python")
    return importlib.import_module(exported.name)


@needs_compiler
def test_the_python_module_does_what_ran(exported, monkeypatch):
    """And it refuses a log as `estimate` does."""
    module = module_of(exported, monkeypatch)
    for expected in exported.runs.values():
        log = expected.log
        inputs = log.u if exported.program.u else None
        if expected.refused:
            with pytest.raises(ValueError, match=r"row") as error:
                module.run(log.t, log.y, log.u)
            assert str(error.value) in expected.refused
        else:
            run = module.run(log.t, log.y, inputs)
            same(expected, run.result, flat((run.q, run.v)))


@needs_compiler
def test_the_python_module_does_it_sample_by_sample(exported, monkeypatch):
    module = module_of(exported, monkeypatch)
    for expected in exported.runs.values():
        log, observer, codes, estimates = expected.log, module.Observer(), [], []
        dt = elapsed(log.t)
        for k in range(ROWS):
            inputs = (log.u[k - 1 + module.INPUT_AT_END],) if k + module.INPUT_AT_END and exported.program.u else ()
            codes.append(observer.step(log.y[k], dt[k], *inputs))
            q, v, *_ = observer.estimate()
            estimates.append(np.concatenate([q.ravel(), v]))
        same(expected, codes, np.array(estimates))


@needs_compiler
def test_nothing_starts_where_estimate_refuses_to_start(exported, monkeypatch):
    """As at a number too large, or at a matrix that is no rotation; the next measurement starts."""
    module, log = module_of(exported, monkeypatch), exported.runs["a jump that stays"].log
    for wrong in (1e12, -1e12, np.inf):
        y = log.y.copy()
        y[0].flat[0] = wrong
        with pytest.raises(ValueError, match="row 1"):
            covariant.estimate(exported.folder / "model.toml", log._replace(y=y), anyway=True)
        with pytest.raises(ValueError, match="row 1: "):
            module.run(log.t, y, log.u if exported.program.u else None)
        observer = module.Observer()
        assert observer.step(y[0], 1.0).name == "COASTED"
        assert observer.step(y[1], 1.0).name == "OK"


@needs_compiler
@in_a_unit
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_unit_does_what_ran(exported, version, tmp_path):
    """In steps of length zero, whose outputs are for the time of the measurement; then as simulators step."""
    units = pytest.importorskip("units", reason="it needs FMPy")
    path, start = tmp_path / "unit.fmu", exported.member.log().y[0]
    write_fmu(fmu(exported.program, exported.name, "The unit.", RATE, start, version), path)
    unit, sizes = units.Unit(path, tmp_path), {leaf.name: leaf.size for leaf in exported.program.x}
    for expected in exported.runs.values():
        log, codes, estimates = expected.log, [], []
        for k in range(ROWS):
            unit.write("y", log.y[k])
            if "u" in unit.places:
                unit.write("u", log.u[k])
            if k == 0:
                unit.begin(log.t[0])
            unit.step(log.t[k], 0.0)
            codes.append(unit.outcome())
            estimates.append(np.concatenate([unit.read(name, sizes[name]) for name in ("q", "v")]))
        same(expected, codes, np.array(estimates))
        unit.calls.reset()
    unit.calls.freeInstance()


def test_webassembly_does_what_ran(exported):
    if not has_wasm():
        pytest.skip("there is no compiler for WebAssembly, or no node")
    logs = [run.log for run in exported.runs.values()]
    rows = [[a.reshape(ROWS, -1).tolist() for a in (elapsed(log.t), log.y, log.u)] for log in logs]
    script = """const logs = ROWS;
require("./c/NAME.js").load().then(({ Observer }) => {
    console.log(JSON.stringify(logs.map(([dt, y, u]) => {
        const observer = new Observer();
        return dt.map(([step], k) => {
            const code = observer.step(y[k], step, k + END && INPUTS ? u[k - 1 + END] : undefined);
            const x = observer.estimate();
            return [code, ...x.q, ...x.v];
        });
    })));
});
"""
    for word, text in (
        ("ROWS", json.dumps(rows)),
        ("NAME", exported.name),
        ("INPUTS", str(exported.program.u)),
        ("END", str(int(exported.program.input_at_end))),
    ):
        script = script.replace(word, text)
    (exported.folder / "use.js").write_text(script)
    done = subprocess.run(["node", "use.js"], cwd=exported.folder, capture_output=True, text=True, check=True)
    for expected, table in zip(exported.runs.values(), json.loads(done.stdout), strict=True):
        same(expected, [row[0] for row in table], np.array([row[1:] for row in table], float))


# What the texts say, without a line of C compiled.


def written(folder, text=MODEL + MOTION, name="speed", **options):
    """An export of a filter without a model, the quickest to write."""
    (folder / "pendulum.toml").write_text(text)
    chosen = {"observer": "filtered-derivative", "rate": RATE, "name": name} | options
    return covariant.export(folder / "pendulum.toml", folder / "c", **chosen)


def texts(folder) -> list[str]:
    """Header, data sheet and README on one line each, without the breaks of lines."""
    files = ("speed.h", "DATASHEET.md", "README.md")
    return [" ".join((folder / "c" / file).read_text(encoding="utf-8").split()) for file in files]


OWN = """import jax.numpy as jnp
from covariant.models import Lagrangian

def make():
    return Lagrangian(lambda q: jnp.eye(1, dtype=q.dtype), lambda q: 2.0 * q[0] ** 2, inputs=1)
"""


def test_an_input_of_a_model_in_python_has_the_unit_of_its_kind(tmp_path):
    (tmp_path / "own_model.py").write_text(OWN)
    model = 'system = "own_model:make"\n' + MODEL.split("\n\n", 1)[1].replace(
        "[measurement]", '[units]\nu = "0.05 N m"\n\n[measurement]'
    )
    written(tmp_path, model + MOTION)
    header, sheet, _ = texts(tmp_path)
    assert "u: motor [N m]" in header
    assert "- u: motor [N m]" in sheet


def test_header_data_sheet_and_readme_tell_the_gate_the_units_and_each_code(tmp_path):
    result = written(tmp_path)
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


def test_header_data_sheet_and_readme_tell_how_far_apart_samples_are(tmp_path):
    written(tmp_path)
    header, sheet, readme = texts(tmp_path)
    assert all("for samples 0.005 s apart" in text for text in (header, sheet, readme))
    assert "other steps are predicted as exactly" in sheet
    assert "dt: the time since the last stamp that was used" in header


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_each_number_of_a_unit_has_its_unit(version, tmp_path, monkeypatch):
    monkeypatch.setattr(_fmu, "compiler_command", lambda: None)
    noise = {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0}
    chosen = {"observer": "joint-kalman", "rate": RATE, "overrides": noise, "name": "beam"}
    beam = covariant.export("ball_and_beam", tmp_path / "beam", **chosen).program
    arm = covariant.export("pendulum_chain", tmp_path / "arm", **chosen).program
    units = {}
    for name, made in (("beam", beam), ("arm", arm)):
        packed = fmu(made, "beam", "The unit.", RATE, np.zeros(2), version)
        root = ElementTree.fromstring(packed.files["modelDescription.xml"])
        defined = {unit.attrib["name"] for unit in root.findall("UnitDefinitions/Unit")}
        variables = root.findall("ModelVariables/*")
        stated = {v.attrib["name"]: (v if version == "3.0" else v[0]).attrib.get("unit") for v in variables}
        assert set(stated.values()) - {None} == defined
        units[name] = stated
    if version == "2.0":
        expected = {"y[1]": "m", "y[2]": "rad", "q[2]": "rad", "v[1]": "m/s", "velocity_std[2]": "rad/s"}
        assert expected.items() <= units["beam"].items()
    else:  # numbers of an array have one unit, or none that FMI can say
        assert units["beam"]["y"] is None
        assert units["beam"]["time"] == "s"
        expected = {"y": "rad", "q": "rad", "v": "rad/s", "velocity_std": "rad/s"}
        assert expected.items() <= units["arm"].items()


@pytest.mark.parametrize(
    ("lines", "told", "use"),
    [
        (
            "delay = 0.01",
            "to the step that begins at its stamp; the step has their delay 10 ms.",
            "the input since then",
        ),
        (
            'lag = 0.02\nbetween = "linear"',
            "to the step that ends at its stamp, .*; the step has their lag 20 ms.",
            "the input at the stamp of y",
        ),
    ],
)
def test_the_texts_say_how_inputs_are_passed(lines, told, use, tmp_path):
    text = f"{MODEL}{MOTION}[inputs]\n{lines}\n"
    written(tmp_path, text, observer="copy", alpha=20.0, beta=200.0)
    header, *others = texts(tmp_path)
    assert all(re.search(f"Inputs are passed as they are sent, each {told}", each) for each in (header, *others))
    assert f"u: {use}" in header
    written(tmp_path, text, overwrite=True)  # a filter that looks at no input
    assert "as they are sent" not in texts(tmp_path)[0]


def test_without_noise_a_gate_is_missed_in_every_text(tmp_path):
    result = written(tmp_path, MODEL[: MODEL.index("[measurement]")], observer="copy", alpha=20.0, beta=200.0)
    assert result.gate.startswith("It has no gate and refuses no measurement, since the model file tells no noise")
    assert "add `std` to [measurement] and `acceleration` to [uncertainty]" in result.gate
    assert all(result.gate in text for text in (*texts(tmp_path), str(result)))
    assert "speed" not in result.program.numbers


def test_a_speed_that_nobody_told_is_a_warning_and_a_log_tells_it(tmp_path):
    result = written(tmp_path, MODEL)
    assert "The speed is assumed" in result.gate
    assert "Give `log`" in result.warnings[0]
    assert result.program.numbers["speed"].tolist() == [1.0]
    table = swing()._replace(y=swing().y)
    told = written(tmp_path, MODEL, log=table, overwrite=True)
    model = covariant.models.load(tmp_path / "pendulum.toml").model
    assert told.warnings == ()
    assert told.program.numbers["speed"].tolist() == pytest.approx(usual_speeds(model, table))


def test_a_gate_can_be_left_out(tmp_path):
    result = written(tmp_path, gate=False)
    assert "It has no gate and refuses no measurement, as asked." in texts(tmp_path)[0]
    assert "noise" not in result.program.numbers


@pytest.mark.parametrize("lost", [0, 2])
def test_a_certificate_says_what_the_gate_does_to_it(lost):
    text = beyond_proof(lost)
    assert ("covers up to 2 in a row" if lost else "does not cover") in text
    assert "Where a step returns OK it changed nothing" in text
