"""The Python package of an export does what the library does, without it, and says what is wrong with a log."""

import functools
import importlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.codegen import program, python_files, with_open_numbers, write_folder, write_source
from covariant.engine import run_log
from covariant.signals import Record, StepCode

RATE, ROWS = 250.0, 60
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


def observer(name: str):
    """An observer, a shape of its measurement, its inputs, and its type."""
    pendulum, one = models.pendulum_chain(viscous=(0.01, 0.02)), jnp.eye(2)
    match name:
        case "pendulum":
            return observers.Intrinsic(pendulum, 20.0, 200.0, substeps=1), np.zeros(2), "double"
        case "single":
            return observers.Intrinsic(pendulum, 20.0, 200.0, substeps=1), np.zeros(2), "float"
        case "kalman":
            return observers.IntrinsicKalman(pendulum, one, 1e-4 * one, one, substeps=1), np.zeros(2), "double"
        case "sensors":
            speed = observers.tachometer([0], 0.1, bias_std=0.1, name="speed")
            beam = models.ball_and_beam()
            filter_ = observers.IntrinsicKalman(beam, one, 1e-4 * one, one, sensors=speed, substeps=1)
            return filter_, np.zeros(3), "double"
        case "top":
            return observers.Intrinsic(models.heavy_top(), 20.0, 200.0, substeps=1), np.eye(3), "double"
        case _:  # no model, no input, one coordinate
            return observers.FilteredDerivative(20.0), np.zeros(1), "double"


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Packages by name, each written and imported once."""
    folder = tmp_path_factory.mktemp("packages")

    @functools.cache
    def imported(name: str) -> ModuleType:
        chosen, y, real = observer(name)
        graphs = program(with_open_numbers(chosen), y, real=real)
        source = write_source(graphs, f"made_{name}", "A test.")
        texts = {f"made_{name}.h": source.header, f"made_{name}.c": source.source}
        write_folder(python_files(graphs, texts, f"made_{name}", 'Of "quotes" \\ and more', RATE), folder / name)
        patch.syspath_prepend(folder / name / "python")
        return importlib.import_module(f"made_{name}")

    patch = pytest.MonkeyPatch()
    yield imported
    patch.undo()


def log(y: np.ndarray, inputs: int) -> Record:
    """A log with irregular stamps, missing measurements, and inputs."""
    t = 3.0 + np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, ROWS)) / RATE
    t[40:] += 0.02
    k = np.arange(ROWS)[:, None]
    u = 0.2 * np.sin(k / 7 + np.arange(inputs))
    if y.ndim == 2:
        turns = [models.heavy_top().group.exp(jnp.array([0.1 * np.sin(i / 4), 0.2, 0.03 * i])) for i in range(ROWS)]
        measured = np.stack([np.asarray(turn) for turn in turns])
        measured[10] = np.nan
    else:
        measured = 0.3 * np.sin(k / (9.0 + np.arange(y.size)))
        measured[0, 2:] = measured[10] = measured[20, 0] = np.nan
    return Record(t, u, measured)


@pytest.mark.exhaustive("kalman", "sensors", "top")
@pytest.mark.long("pendulum", "single")
@needs_compiler
@pytest.mark.parametrize("name", ["pendulum", "top", "slope", "kalman", "sensors", "single"])
def test_a_log_is_what_the_library_makes_of_it(name, package):
    chosen, y, real = observer(name)
    made = package(name)
    record = log(y, made.INPUTS)
    expected, _ = run_log(chosen, record, engine="jax")
    run = made.run(record.t, record.y, record.u if made.INPUTS else None)
    tolerance = {"double": 1e-12, "float": 2e-4}[real]
    q, v = np.split(expected.estimate, 2, axis=1) if isinstance(expected.estimate, np.ndarray) else expected.estimate
    assert run[1].dtype == made.REAL == np.dtype({"double": "f8", "float": "f4"}[real])
    np.testing.assert_allclose(run[1], q, rtol=0, atol=tolerance * max(1, np.nanmax(np.abs(q))))
    np.testing.assert_allclose(run.v, v, rtol=0, atol=tolerance * max(1, np.nanmax(np.abs(v))))
    np.testing.assert_array_equal(run.result, expected.info.result)
    np.testing.assert_allclose(run.innovation, expected.info.innovation, rtol=0, atol=tolerance)
    if name == "kalman":
        np.testing.assert_allclose(run.velocity_std, expected.info.velocity_std, rtol=1e-11)


@needs_compiler
def test_arrays_of_any_layout_reach_c_in_its_own(package):
    """Also those between the words of memory, as of a packed record, which some processors cannot read."""
    made, record = package("slope"), log(np.zeros(1), 0)
    packed = np.zeros(ROWS, [("flag", "i1"), ("y", "f8", (1,))])
    packed["y"] = record.y
    shifted = np.frombuffer(bytes(1) + record.y.tobytes(), np.float64, offset=1).reshape(-1, 1)
    assert not shifted.flags.aligned
    _, measured, _ = made._checked(record.t, shifted, None)
    assert measured.flags.aligned
    expected = made.run(record.t, record.y)
    for y in (
        shifted,
        packed["y"],
        record.y.astype(">f8"),
        np.asfortranarray(record.y),
        np.repeat(record.y, 2, 0)[::2],
    ):
        np.testing.assert_array_equal(made.run(record.t, y).v, expected.v)


def test_codes_and_messages_are_those_of_the_library(package):
    made = package("pendulum")
    assert {r.name: (int(r), r.message) for r in made.Result} == {r.name: (int(r), r.message) for r in StepCode}


T, Y = np.arange(5) / RATE, np.zeros((5, 2))
BAD = {
    r"row 3: time goes back from 1 s to 0.5 s; sort or split the log": ([0, 1, 0.5, 2, 3], Y),
    r"rows 2 and 3 have the same stamp 1 s; keep one": ([0, 1, 1, 2, 3], Y),
    r"row 2: t is not a finite number": ([0, np.nan, 1, 2, 3], Y),
    r"stamps reach 1.7e\+12 s, after the year 2200; they must be in seconds": (1.7e12 + T, Y),
    r"stamps in float32 near 16000 s are whole multiples": (np.float32(16000 + T * 2), Y),
    r"t has dates; give seconds": ((T * 1e9).astype("datetime64[ns]"), Y),
    r"y has the shape \(5,\); made_pendulum needs \(T, 2\), time first": (T, Y[:, 0]),
    r"rows differ: 5 of t, 4 of y": (T, Y[1:]),
    r"y has the type complex128; it must be real numbers, which become float64": (T, Y * 1j),
    r"u has the type bool": (T, Y, Y > 0),
    r"row 4: u is not a finite number; mark a missing one by NaN": (T, Y, np.where(T[:, None] == T[3], np.inf, Y)),
    r"row 1 lacks a measurement, so no estimate can start there": (T, np.where(T[:, None] == 0, np.nan, Y)),
    r"row 2: a measurement is infinite; mark a missing one by NaN": (T, np.where(T[:, None] == T[1], np.inf, Y)),
    r"a log needs at least two rows; this one has 1": (T[:1], Y[:1]),
}


@needs_compiler
def test_a_wrong_log_is_an_error_that_says_what_to_do(package):
    run, made = package("pendulum").run, package("pendulum")
    for message, arguments in BAD.items():
        with pytest.raises(ValueError, match=message):
            run(*arguments)
    with pytest.raises(ValueError, match=r"y has the shape \(5,\).*; y\[:, None\] is a column"):
        package("slope").run(T, Y[:, 0])
    with pytest.raises(ValueError, match=r"y has the shape \(3,\); one sample has \(2,\)"):
        made.Observer().step(np.zeros(3), 0.1)
    with pytest.raises(ValueError, match=r"viscous has the shape \(\); it must be \(2,\)"):
        made.Observer({"viscous": 1.0})
    with pytest.raises(KeyError, match=r"no number 'weight'; there are: absolute, alpha, beta, "):
        made.Observer({"weight": 1.0})
    with pytest.warns(UserWarning, match=r"rows are 0.04 s apart, and made_pendulum is made for 250 Hz: .*--rate 25"):
        run(T * 10, Y)
    masked = np.ma.masked_array(Y, np.arange(10).reshape(5, 2) == 4)
    np.testing.assert_array_equal(run(T, masked).result, [0, 0, 1, 0, 0])


@needs_compiler
def test_it_starts_without_jax_and_without_this_library(package):
    """Of the packages that are installed it loads NumPy alone."""
    place = Path(package("pendulum").__file__ or "").parents[1]
    code = (
        "import sys, json; sys.path.insert(0, sys.argv[1]); import made_pendulum as m\n"
        "m.Observer().step([0.1, 0.2], 0.01)\n"
        "print(json.dumps([n for n, v in sys.modules.items() if 'site-packages' in (getattr(v, '__file__', 0) or '')]))"
    )
    done = subprocess.run([sys.executable, "-c", code, place], capture_output=True, text=True, check=True)
    assert {name.partition(".")[0] for name in json.loads(done.stdout)} <= {"numpy", "_distutils_hack"}


@needs_compiler
def test_a_library_that_is_missing_or_of_another_export_is_built_by_the_package(package, tmp_path, monkeypatch):
    place = Path(package("slope").__file__ or "").parent
    copy = shutil.copytree(place, tmp_path / place.name)
    ends = "import made_slope as m; m.Observer()"

    def ran(*words: str, **settings: str):
        command = [sys.executable, *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=os.environ | settings)

    (library,) = copy.glob("lib*")
    library.unlink()
    missing = ran("-c", ends)
    assert re.search(r"libmade_slope\.\w+ is missing; build it by `.* -m made_slope`, which needs", missing.stderr)
    without = ran("-m", "made_slope", CC="no-such-compiler")
    if importlib.util.find_spec("ziglang") is None:
        assert "made_slope needs a C compiler: set CC, install `cc`, or `pip install ziglang`" in without.stderr
    assert ran("-m", "made_slope").stdout.strip() == str(library)
    assert ran("-c", ends).returncode == 0
    library.write_bytes(library.read_bytes().replace(package("slope")._TOKEN.encode(), b"0" * 32))
    assert "is of another export; build it by" in ran("-c", ends).stderr


@needs_compiler
def test_a_wheel_records_its_files_and_equal_exports_are_equal_wheels(package):
    (wheel,) = Path(package("slope").__file__ or "").parents[1].glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        (record,) = (name for name in packed.namelist() if name.endswith("RECORD"))
        assert [line.partition(",")[0] for line in packed.read(record).decode().splitlines()] == packed.namelist()
        (tag,) = re.findall(rb"Tag: (.*)", packed.read(record.replace("RECORD", "WHEEL")))
        assert wheel.stem.endswith(tag.decode())
