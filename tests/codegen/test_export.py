"""Exported observers compile without a warning and follow Python; they need no memory management and share no names."""

import errno
import functools
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import models, observers
from covariant.cli import main
from covariant.codegen import (
    ROWS,
    Facts,
    Program,
    Recipe,
    _data_sheet,
    check_export_name,
    export_name,
    export_texts,
    fmu,
    of_family,
    program,
    vectors,
    with_open_numbers,
    write_folder,
)
from covariant.codegen._vectors import Vectors
from covariant.geometry import Budget, Interpolated
from covariant.models import robots

ROOT = Path(__file__).parents[2]
FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Werror"]
RATE = 250.0
K = np.arange(ROWS + 1.0)
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


class Case(NamedTuple):
    recipe: object
    measured: np.ndarray
    inputs: int | None = None
    real: str = "double"


def swing(*centres: float) -> np.ndarray:
    return np.stack([c + 0.2 * np.sin(K / (4 + i)) for i, c in enumerate(centres)], axis=1)


def on_group(group) -> np.ndarray:
    return np.stack([np.asarray(group.exp(jnp.array([0.1 * np.sin(k / 4), 0.2, 0.05 * k]))) for k in K])


@functools.cache
def family():
    """The double pendulum with friction, its numbers open."""
    return models.family(str(ROOT / "examples" / "demo_double_pendulum.toml"), ("mass", "length", "com", "coulomb"))


def springs(n: int):
    """A row of masses that no input acts on."""

    def potential(q):
        return 2.0 * jnp.sum(jnp.sin(q) ** 2) + jnp.sum((q[1:] - q[:-1]) ** 2)

    return models.Lagrangian(
        lambda q: jnp.eye(n, dtype=q.dtype), potential, force=lambda t, q, u: jnp.zeros_like(q), inputs=0
    )


def case(name: str) -> Case:
    pendulum, one = family().file.model, jnp.eye(2)
    match name:
        case "pendulum":  # its second angle goes through π
            return Case(of_family(observers.Intrinsic(pendulum, 20.0, 200.0, substeps=1), family()), swing(0.0, np.pi))
        case "pendulum_float":
            return case("pendulum")._replace(real="float")
        case "kalman":
            filter_ = observers.IntrinsicKalman(pendulum, one, 1e-4 * one, one, substeps=1)
            return Case(with_open_numbers(filter_, ("*[!v]",)), swing(0.0, 0.5))
        case "sensors":  # which are not read at the start
            speed = observers.tachometer([0], 0.1, bias_std=0.1, name="speed")
            beam = models.ball_and_beam()
            filter_ = observers.IntrinsicKalman(beam, one, 1e-4 * one, one, sensors=speed, substeps=1)
            read = np.where(K > 0, 0.05 * np.cos(K / 4), np.nan)
            return Case(with_open_numbers(filter_, ("*",)), np.column_stack([swing(0.3, 0.1), read]), 1)
        case "exact":  # a fixed budget for its geodesics, behind a gate
            exact = observers.Geodesic(models.ball_and_beam(), 4.0, 8.0, Budget(1, 2), substeps=1)
            gated = observers.Gated(exact, exact.model, jnp.asarray(1e-3), jnp.array([1.0, 1.0]))
            return Case(with_open_numbers(gated), swing(0.3, 0.1), 1)
        case "top":
            top = models.heavy_top()
            return Case(with_open_numbers(observers.Intrinsic(top, 20.0, 200.0, substeps=1)), on_group(top.group))
        case "ship":
            ship = models.marine.cybership()
            observer = observers.craft_observer(ship, jnp.eye(3), jnp.diag(jnp.diag(ship.mass)))
            return Case(with_open_numbers(observer), swing(0.0, 1.0, np.pi), 3)
        case "scara":
            robot = robots.load("scara")
            recipe = with_open_numbers(observers.Intrinsic(robot, 20.0, 200.0, substeps=1), ("[!abfm]*", "motors"))
            return Case(recipe, swing(0.3, 0.4, 0.1, 0.0), 4, "float")
        case "frequency":  # its metric is a table, which the estimate leaves
            axes = [np.linspace(low, high, 5) for low, high in ((-1.0, 1.0), (-0.5, 1.5), (0.5, 2.0))]
            spread = np.random.default_rng(0).normal(size=(5, 5, 5, 3, 3))
            field = Interpolated(tuple(axes), np.eye(3) + 0.1 * np.einsum("...ij,...kj->...ik", spread, spread))
            observer = observers.Riccati(models.unknown_frequency(), field, jnp.array([0.5, 0.5, 1.0]), 0.5)
            return Case(with_open_numbers(observer, ("low", "high", "spacing", "factors")), swing(0.8), 0)
        case "duffing":
            filter_ = observers.StateEKF(models.duffing(), one, 1e-4 * jnp.eye(1), jnp.array([0.3, 0.1]), one, 2)
            return Case(with_open_numbers(filter_), swing(0.3), 1, "float")
        case "one" | "thirty":  # coordinates of springs, without an input
            n = {"one": 1, "thirty": 30}[name]
            recipe = with_open_numbers(observers.Intrinsic(springs(n), 8.0, 30.0, substeps=1))
            return Case(recipe, swing(*np.linspace(-1, 1, n)), real="float" if n > 1 else "double")
        case "late":  # each position by its own time, readings in a buffer, and fields called as arguments are
            late = observers.Delayed(observers.Intrinsic(pendulum, 20.0, 200.0, substeps=1), [0.01, 0.004], RATE)
            return Case(with_open_numbers(late, ("delay", "lateness")), swing(0.0, 0.5))
        case "smoothed":  # buffers of the states of a filter, and a loop back through them
            rod = models.pendulum_chain((1.0,), (0.5,), viscous=(0.05,))
            filter_ = observers.IntrinsicKalman(rod, jnp.eye(1), 1e-4 * jnp.eye(1), jnp.eye(1), substeps=1)
            return Case(with_open_numbers(observers.FixedLag(filter_, 4)), swing(0.5))
        case "slope":  # one coordinate, no input, no model
            return Case(with_open_numbers(observers.FilteredDerivative(20.0)), swing(0.4))
        case _:
            raise KeyError(name)


CASES = (
    "pendulum",
    "pendulum_float",
    "kalman",
    "sensors",
    "exact",
    "top",
    "ship",
    "scara",
    "late",
    "smoothed",
    "slope",
    "one",
    "thirty",
    "frequency",
    "duffing",
)
each = pytest.mark.parametrize("name", CASES)


class Export(NamedTuple):
    case: Case
    program: Program
    folder: Path

    @property
    def vectors(self) -> Vectors:
        return vectors(self.program, self.case.measured, RATE)


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """Exports by name, each written once."""
    folder = tmp_path_factory.mktemp("exports")

    @functools.cache
    def made(name: str) -> Export:
        chosen = case(name)
        graphs = program(chosen.recipe, chosen.measured[0], chosen.inputs, chosen.real, alone=name == "sensors")
        patch.setattr(_data_sheet, "COMPILERS", ())  # the command is asked for sizes once, below
        texts = export_texts(graphs, name, f"The case */ {name}", chosen.measured, Facts(RATE, 1))
        write_folder(texts, folder / name)
        patch.undo()
        return Export(chosen, graphs, folder / name)

    patch = pytest.MonkeyPatch()
    return made


def ran(command: list, folder: Path) -> str:
    done = subprocess.run([str(part) for part in command], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.exhaustive("exact", "kalman", "late", "scara", "sensors", "smoothed", "thirty")
@pytest.mark.long("duffing", "frequency", "pendulum", "pendulum_float", "ship", "top")
@each
@needs_compiler
def test_it_compiles_without_a_warning_and_passes_its_own_test(name, exported):
    folder = exported(name).folder
    for compiler in ("gcc", "clang") if name in ("pendulum", "pendulum_float", "slope") else ("cc",):
        if shutil.which(compiler) is None:
            continue  # one of them is there: `needs_compiler`
        ran([compiler, *FLAGS, "-O1", "-I.", f"{name}.c", f"test/{name}_test.c", "-lm", "-o", "self_test"], folder)
        assert f"{name}: ok, {ROWS} steps" in ran(["./self_test"], folder)


@pytest.mark.parametrize("flags", ["-ffast-math", "-Ofast", "-ffinite-math-only", "-std=c90", "-std=gnu90"])
@needs_compiler
def test_flags_by_which_it_is_wrong_are_refused(flags, exported, tmp_path):
    words = ["cc", "-std=c99", flags, "-c", exported("slope").folder / "slope.c"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert re.search(r"#error .*compile (this file without|it with)", done.stderr)


@pytest.mark.core(1)
@pytest.mark.parametrize("name", ["slope", "pendulum"])
@pytest.mark.parametrize(("blind", "seeing"), [("observer", "test"), ("test", "observer"), ("both", "")])
@needs_compiler
def test_where_a_compiler_hides_that_it_drops_nan_the_self_test_says_so(blind, seeing, name, exported, tmp_path):
    """As one that has no macro for such a flag, or a pragma after the guard."""
    folder = exported(name).folder
    hidden = ["-O2", "-ffinite-math-only", "-U__FINITE_MATH_ONLY__"]
    for part, path in (("observer", f"{name}.c"), ("test", f"test/{name}_test.c")):
        flags = hidden if part != seeing else []
        ran(["cc", "-std=c99", *flags, "-I.", "-c", path, "-o", tmp_path / f"{part}.o"], folder)
    ran(["cc", "observer.o", "test.o", "-lm", "-o", "self_test"], tmp_path)
    done = subprocess.run(["./self_test"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.startswith(f"{name}: WRONG, NaN is not seen as NaN: compile {name}.c and this file without")


@needs_compiler
def test_an_estimate_that_is_nan_is_no_deviation_of_zero(exported, tmp_path):
    folder = exported("slope").folder
    text = (folder / "slope.c").read_text()
    broken = text.replace("slope_core_estimate(params, state, output);", "*output = (slope_output){{NAN}, {NAN}};")
    assert broken != text
    (tmp_path / "slope.c").write_text(broken)
    ran(["cc", "-std=c99", f"-I{folder}", "slope.c", folder / "test" / "slope_test.c", "-lm", "-o", "a"], tmp_path)
    done = subprocess.run(["./a"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.search(r"slope: WRONG, 40 steps, largest deviation -?nan of", done.stdout)


@pytest.mark.core(2)
@pytest.mark.parametrize("name", ["slope", "pendulum"])
@pytest.mark.parametrize("standard", ["c++98", "c++20"])
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_it_compiles_as_cpp_too(standard, name, exported, tmp_path):
    folder = exported(name).folder
    flags = [f"-std={standard}", *(flag for flag in FLAGS if flag != "-std=c99"), "-I.", "-x", "c++"]
    ran(["g++", *flags, f"{name}.c", f"test/{name}_test.c", "-o", tmp_path / "self_test"], folder)
    assert f"{name}: ok" in ran([tmp_path / "self_test"], tmp_path)


@needs_compiler
def test_numbers_named_as_macros_are_members_of_c(tmp_path):
    names = ("NAN", "INFINITY", "errno", "NULL", "linux", "class")
    make = lambda numbers: observers.FilteredDerivative(sum(numbers[name] for name in names))  # noqa: E731
    recipe = Recipe(make, {name: np.array(3.0) for name in names})
    texts = export_texts(program(recipe, np.zeros(1)), "slope", "", case("slope").measured, Facts(RATE, None))
    write_folder(texts, tmp_path / "c")
    for compiler in (["cc", "-std=gnu99"], ["c++", "-x", "c++"]):
        ran([*compiler, "-include", "errno.h", "-I.", "slope.c", "test/slope_test.c", "-lm", "-o", "a"], tmp_path / "c")
        assert "slope: ok" in ran(["./a"], tmp_path / "c")


@needs_compiler
def test_two_exports_and_their_wrappers_link_into_one_program_in_cpp(exported, tmp_path):
    names = ("pendulum", "slope")
    folders = [exported(name).folder for name in names]
    includes = [f"-I{folder}" for folder in folders]
    (tmp_path / "main.cpp").write_text(
        '#include "pendulum.hpp"\n#include "slope.hpp"\n#include <cmath>\n'
        "int main() {\n"
        "    pendulum::Observer a; slope::Observer b;\n"
        "    const double y[2] = {0.1, 0.2}, u[2] = {0, 0};\n"
        "    a.params.mass[0] = 0.7;\n"
        "    for (int i = 0; i < 5; ++i) { a.step(y, 0.004, u); b.step(y, 0.004); }\n"
        "    pendulum::Observer copy = a;\n"
        "    a.step(y, 0.004, u); copy.step(y, 0.004, u);\n"
        "    const bool same = a.estimate().v[0] == copy.estimate().v[0];\n"
        "    return same && std::isfinite(a.estimate().v[1]) && b.estimate().q[0] == y[0] ? 0 : 1;\n}\n"
    )
    for name, folder in zip(names, folders, strict=True):
        ran(["cc", *FLAGS, "-c", folder / f"{name}.c", "-o", f"{name}.o"], tmp_path)
    flags = [flag for flag in FLAGS if flag != "-std=c99"]
    ran(["c++", "-std=c++11", *flags, *includes, "main.cpp", "pendulum.o", "slope.o", "-lm", "-o", "both"], tmp_path)
    ran(["./both"], tmp_path)
    lines = ran(["nm", "pendulum.o", "slope.o"], tmp_path).splitlines()
    symbols = [line.split()[-2:] for line in lines if len(line.split()) > 1]
    defined = {name for kind, name in symbols if kind in "TDBR"}
    assert all(name.startswith(("pendulum_", "slope_")) for name in defined)
    assert not any(kind in "DBdbC" for kind, _ in symbols), "there is a variable"
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {"sin", "cos", "sincos", "sqrt", "exp", "expm1", "atan", "rint", "fabs", "memcpy", "round"}


CONSUMER = """cmake_minimum_required(VERSION 3.13)
project(consumer LANGUAGES C CXX)
find_package(slope REQUIRED)
add_executable(consumer main.cpp)
target_link_libraries(consumer PRIVATE slope::slope)
"""


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not installed")
def test_cmake_tests_installs_and_finds_an_export(exported, tmp_path):
    """With a space in the path."""
    folder, there = exported("slope").folder, tmp_path / "put there"
    ran(["cmake", "-S", folder, "-B", "built", f"-DCMAKE_INSTALL_PREFIX={there}"], tmp_path)
    ran(["cmake", "--build", "built"], tmp_path)
    ran(["ctest", "--test-dir", "built"], tmp_path)
    ran(["cmake", "--install", "built"], tmp_path)
    consumer = tmp_path / "consumer"
    consumer.mkdir()
    (consumer / "CMakeLists.txt").write_text(CONSUMER)
    (consumer / "main.cpp").write_text(
        "#include <slope.hpp>\nint main() { slope::Observer o; const double y = 1; return o.start(&y); }\n"
    )
    ran(["cmake", "-S", "consumer", "-B", "used", f"-DCMAKE_PREFIX_PATH={there}"], tmp_path)
    ran(["cmake", "--build", "used"], tmp_path)
    ran([tmp_path / "used" / "consumer"], tmp_path)


def test_the_wiring_example_of_the_readme_compiles(exported, tmp_path):
    folder = exported("pendulum").folder
    readme = (folder / "README.md").read_text()
    (tmp_path / "use.c").write_text(readme.partition("```c\n")[2].partition("```")[0])
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler, `cc`")
    ran(["cc", *FLAGS, f"-I{folder}", "-c", "use.c"], tmp_path)


def test_numbers_of_one_name_and_value_are_one_and_others_are_told_apart():
    scara = with_open_numbers(observers.Intrinsic(robots.load("scara"), 20.0, 200.0))
    assert scara.numbers["mass"].shape == (4,)  # of the inertia and of the potential
    pendulum = with_open_numbers(observers.Intrinsic(family().file.model, 20.0, 200.0)).numbers
    assert {"matrix_constant", "constant"} & set(pendulum)
    assert len(pendulum) == len(set(pendulum))


def test_an_observer_of_another_model_has_no_numbers_of_the_family():
    with pytest.raises(ValueError, match=r"not one of family\.file\.model"):
        of_family(observers.Intrinsic(models.ball_and_beam(), 1.0, 1.0), family())


NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observer": "intrinsic", "lag": 0.1}, "lag is for filters with a covariance: .*; intrinsic is none"),
        ({"observer": "intrinsic-kalman", "lag": 0.001}, r"lag 0\.001 is less than half a sample of 0\.01 s"),
        ({"observer": "intrinsic-kalman", "lag": -1.0}, "lag must be a positive number"),
        (
            {"observer": "intrinsic-kalman", "lag": 0.1, "overrides": NOISE | {"measurement.delay": 0.02}},
            "not for late ones",
        ),
    ],
)
def test_a_lag_that_no_export_has_is_refused(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        covariant.export("oscillator", tmp_path / "c", rate=100.0, **({"overrides": NOISE} | options))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        *((name, "is no name in C") for name in ("", "2nd", "a-b", "a.b", "a b", "a\n", "_a", "__a", "größe", "../a")),
        *((name, "is a keyword of C or C++") for name in ("for", "virtual", "int", "double", "restrict", "bool")),
        *((name, "is a name of the C library") for name in ("main", "printf", "y0", "j1", "gamma", "NULL", "errno")),
        *((name, "is a name of the C library") for name in ("I", "size_t", "INT_MAX", "linux", "va_list", "csinf")),
        *((name, "is a header of the system") for name in ("string", "stdio", "unistd")),
        *((name, "is a name of POSIX") for name in ("std", "link", "timezone", "sem")),
        *((name, "is a target of CMake") for name in ("test", "m", "all")),
        *((name, "is a word of JavaScript") for name in ("let", "function", "arguments")),
        *((name, "is a word of Python") for name in ("lambda", "None", "def")),
        *((name, "is a device of Windows") for name in ("con", "CON", "nul", "com1", "Lpt9")),
        *((name, "two underscores in a row") for name in ("a__b", "arm_")),
        ("a" * 300, "has 300 letters"),
    ],
)
def test_a_name_that_something_else_has_is_refused(exported, name, reason):
    graphs = exported("slope").program
    with pytest.raises(ValueError, match=re.escape(reason)) as refused:
        export_texts(graphs, name, "", case("slope").measured, Facts(RATE, None))
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=re.escape(reason)):
        fmu(graphs, name, "", RATE, case("slope").measured[0])


def test_a_name_is_refused_before_any_work_and_a_model_of_such_a_name_gets_another(tmp_path):
    for name, options in (("printf", {}), ("", {}), ("queue", {"python": True}), ("location", {"wasm": True})):
        with pytest.raises(ValueError, match=r"'my_|no name in C"):
            covariant.export("no such model", tmp_path / "c", rate=100.0, name=name, **options)
    assert export_name("My Robot!") == "my_robot"
    assert export_name("top") == "top"
    assert export_name("top", wasm=True) == "observer_top"
    for name in ("2 link", "test", "random", "con", "größe", "a" * 300, "_", ""):
        check_export_name(export_name(name, python=True, wasm=True), python=True, wasm=True)


def test_too_few_measurements_for_the_faults_of_a_self_test_are_refused(exported):
    with pytest.raises(ValueError, match="at least 27 measurements; got 10"):
        export_texts(exported("slope").program, "slope", "", case("slope").measured[:10], Facts(RATE, None))


def test_a_folder_with_files_is_left_alone_unless_told(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="not empty"):
        write_folder({"a.c": "x"}, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    write_folder({"a.c": "x"}, tmp_path, overwrite=True)
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (tmp_path / "a.c").read_text() == "x"
    with pytest.raises(ValueError, match="there is no folder"):
        write_folder({"a.c": "x"}, tmp_path / "not" / "there")


def test_files_of_a_folder_are_replaced_only_where_all_can_be_written(tmp_path, monkeypatch):
    """A header must not meet the source of another export."""
    files = {"a.h": "old", "a.c": "old", "test/a_test.c": "old"}
    write_folder(files, tmp_path / "e")
    synced = iter([None, None])

    def full(_):
        if next(synced, full) is full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*a_test\.c"):
        write_folder(dict.fromkeys(files, "new"), tmp_path / "e", overwrite=True)
    found = {
        path.relative_to(tmp_path / "e").as_posix(): path for path in (tmp_path / "e").rglob("*") if path.is_file()
    }
    assert {name: path.read_text() for name, path in found.items()} == files


def command(monkeypatch, capsys, *words) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["covariant", "export", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        main()
    told = capsys.readouterr()
    return int(left.value.code or 0), told.out, told.err


def commands_of_the_page() -> list[str]:
    page = (ROOT / "docs" / "firmware.md").read_text().replace("\\\n", " ")
    return re.findall(r"```bash\ncovariant export (.*?)\n```", page)


STATES = tuple(shlex.split(next(line for line in commands_of_the_page() if line.startswith("unknown_frequency")))[:-2])


ARM = (ROOT / "examples" / "demo_double_pendulum.toml", "--rate")


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ((*ARM, 0), "rate must be a positive number"),
        ((*ARM, 100, "--real", "half"), "real must be one of"),
        ((*ARM, 100, "--observer", "nobody"), "unknown observer 'nobody'"),
        ((*ARM, 100, "--alpha", 1), "belong together"),
        ((*ARM, 100, "--parameters", "weight"), "weight"),
        (
            (*STATES, "--observer", "intrinsic"),
            "observer intrinsic does not fit unknown_frequency; these do: covariance",
        ),
        ((*STATES, "--alpha", "1", "--beta", "1"), "--alpha and --beta are for mechanical models"),
        ((*STATES, "--certificate", "c.json"), "certificate is for mechanical models"),
        ((*STATES, "--metric", "m.zarr"), "metric is for the observer riccati; covariance-ekf has no metric"),
        ((*STATES, "--observer", "riccati", "--metric", "m.zarr"), "m.zarr is not a map made by map_grid"),
        (STATES[:3], "its observers need measurement.std"),
        (("ball_and_beam", "--rate", "200", "--metric", "m.zarr"), "metric is for the observer riccati"),
    ],
)
def test_what_cannot_be_exported_is_one_line(options, fault, tmp_path, monkeypatch, capsys):
    code, _, told = command(monkeypatch, capsys, *options, "-o", tmp_path / "out")
    assert code == 2
    assert fault in told
    assert len(told.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
