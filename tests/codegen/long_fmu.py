"""What takes long of `test_fmu.py`."""

import functools
import json
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import fmpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from test_fmu import needs_compiler
from units import Unit

from covariant import models, observers
from covariant.cli import main
from covariant.codegen import _fmu, fmu, of_family, program, write_fmu
from covariant.signals import StepCode

ROOT = Path(__file__).parents[2]


MODEL = ROOT / "examples" / "demo_double_pendulum.toml"


RATE, ROWS = 250.0, 40


@functools.cache
def family():
    return models.family(str(MODEL), ("mass", "coulomb"))


@functools.cache
def observer():
    """With friction, so that long steps take more substeps."""
    return observers.Intrinsic(family().file.model, 20.0, 200.0)


@functools.cache
def units() -> dict:
    """Both versions of one unit."""
    made = program(of_family(observer(), family()), np.zeros(2), 2, loops=True)
    return {v: fmu(made, "pend", 'A "pendulum" & <more>', RATE, np.zeros(2), v) for v in ("3.0", "2.0")}


@pytest.fixture(scope="module")
def paths(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("units of this and that")
    for version, unit in units().items():
        write_fmu(unit, folder / f"{version}.fmu")
    return {version: folder / f"{version}.fmu" for version in units()}


@functools.cache
def motion():
    """Stamps, measurements with faults, and inputs."""
    t = np.cumsum(np.random.default_rng(0).uniform(0.8, 1.2, ROWS)) / RATE
    t[25:] += 0.05
    y = np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(4 * t)], axis=1)
    y[10] = y[20, 1] = np.nan
    return t, y, 0.1 * np.sin(np.stack([t, 2 * t], axis=1))


@functools.cache
def with_mass(second: float):
    """The observer of a machine with another second mass."""
    recipe = of_family(observer(), family())
    numbers = {**recipe.numbers, "mass": np.array([0.6, second])}
    return recipe.make({key: jnp.asarray(value, float) for key, value in numbers.items()})


stepped = jax.jit(lambda o, *a: o.step(*a)[0])


@functools.cache
def expected() -> np.ndarray:
    """What Python predicts from each stamp to the next; the payload changes half-way."""
    t, y, u = motion()
    state, rows = with_mass(0.4).init(jnp.asarray(y[0]), jnp.asarray(t[0])), []
    for k in range(ROWS - 1):
        now = with_mass(0.7 if k >= 15 else 0.4)
        if k:
            state = stepped(now, state, jnp.asarray(u[k - 1]), jnp.asarray(y[k]), jnp.asarray(t[k] - t[k - 1]))
        ahead = stepped(now, state, jnp.asarray(u[k]), jnp.full(2, jnp.nan), jnp.asarray(t[k + 1] - t[k]))
        rows.append(np.asarray(now.estimate(ahead)))
    return np.array(rows)


@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_the_description_names_what_is_in_the_unit(version, paths):
    with zipfile.ZipFile(paths[version]) as packed:
        root = ElementTree.fromstring(packed.read("modelDescription.xml"))
        held = set(packed.namelist())
        source = packed.read("sources/pend_fmu.c").decode()
    token = root.attrib["instantiationToken" if version == "3.0" else "guid"]
    assert f'#define TOKEN "{token}"' in source
    assert root.attrib["description"] == 'A "pendulum" & <more>'
    built = "sources/buildDescription.xml"
    files = {"sources/pend.c", "sources/pend_fmu.c"}
    assert files | {"sources/pend.h"} <= held
    if version == "3.0":
        listed = ElementTree.fromstring(zipfile.ZipFile(paths[version]).read(built)).iter("SourceFile")
        variables = root.find("ModelVariables")
    else:
        listed = root.iter("File")
        variables = root.findall("ModelVariables/ScalarVariable")
    assert {f"sources/{file.attrib['name']}" for file in listed} == files
    assert variables is not None
    named = {v.attrib["name"]: v for v in variables}
    assert len(named) == len(list(variables)), "names are unique"
    mass = named["parameters.mass" if version == "3.0" else "parameters.mass[2]"]
    assert (mass.attrib["causality"], mass.attrib["variability"]) == ("parameter", "tunable")
    units = {unit.attrib["name"] for unit in root.findall("UnitDefinitions/Unit")}
    assert {"kg", "1/s", "1/s^2"} <= units
    stated = {v.attrib["name"]: (v if version == "3.0" else v[0]).attrib.get("unit") for v in named.values()}
    assert stated[mass.attrib["name"]] == "kg"
    assert stated["parameters.alpha"] == "1/s"
    assert set(stated.values()) - {None} == units


def estimate(unit: Unit) -> np.ndarray:
    return np.concatenate([unit.read("q", 2), unit.read("v", 2)])


@pytest.mark.exhaustive
@needs_compiler
@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_the_binary_does_what_the_observer_does_in_python(version, paths, tmp_path):
    with pytest.raises(Exception, match="Failed to instantiate"):
        Unit(paths[version], tmp_path, token="{another}")
    unit, (t, y, u) = Unit(paths[version], tmp_path), motion()
    unit.write("y", y[0])
    unit.begin(t[0])
    np.testing.assert_array_equal(unit.read("q", 2), y[0])
    found, state = [], None
    for k in range(ROWS - 1):
        unit.write("y", y[k])
        unit.write("u", u[k])
        if k == 15:
            unit.write("parameters.mass", [0.6, 0.7])
        unit.step(t[k], t[k + 1] - t[k])
        found.append(estimate(unit))
        if k == 20:
            state = unit.calls.getFMUState()
    np.testing.assert_allclose(found, expected(), rtol=0, atol=1e-9)
    unit.calls.setFMUState(state)
    np.testing.assert_array_equal(estimate(unit), found[20])
    with pytest.raises(FMICallException):
        unit.write("q", np.zeros(2))  # an output is not set
    with pytest.raises(FMICallException):
        unit.step(t[20], -1.0)
    unit.calls.freeFMUState(state)
    unit.calls.terminate()
    unit.calls.freeInstance()


@needs_compiler
@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_no_odd_step_silences_a_unit(version, paths, tmp_path):
    """Times that are not finite are refused, others are named by the outcome; after each the unit follows as before."""

    def follow(unit: Unit, first: int, rows: int) -> int:
        for k in range(first, first + rows):
            at = k / RATE
            unit.write("y", [0.3 * np.sin(3 * at), 0.2 * np.cos(4 * at)])
            unit.step(at, 1 / RATE)
        return unit.outcome()

    t, nan, inf = 30 / RATE, np.nan, np.inf
    refused = [(nan, 0.1), (inf, 0.1), (-inf, 0.1), (t, nan), (t, inf), (t, -0.1), (1e308, 1.7e308)]
    named = {
        (t - 2 / RATE, 0.1): StepCode.STEP_REFUSED,
        (29 / RATE, 0.1): StepCode.REPEATED,  # the time of the last measurement
        (t, 0.0): StepCode.OK,
        (t, 5e-324): StepCode.OK,
        (t, 1e300): StepCode.NOT_FINITE,
        (1e300, 0.1): StepCode.NOT_FINITE,
    }
    unit = Unit(paths[version], tmp_path)
    unit.write("u", [0.0, 0.0])
    unit.begin(0.0)
    assert follow(unit, 0, 30) == StepCode.OK
    state, before = unit.calls.getFMUState(), estimate(unit)
    assert follow(unit, 30, 60) == StepCode.OK
    expected = estimate(unit)
    for step in [*refused, *named]:
        unit.calls.setFMUState(state)
        if step in refused:
            with pytest.raises(FMICallException) as caught:
                unit.step(*step)
            assert caught.value.status == 3, step
            np.testing.assert_array_equal(estimate(unit), before)
        else:
            unit.step(*step)
        assert unit.outcome() == named.get(step, StepCode.OK), step
        assert np.isfinite(estimate(unit)).all(), step
        assert follow(unit, 30, 60) == StepCode.OK, step
        # One that was not finite starts again at rest.
        tolerance = 0.5 if named.get(step) == StepCode.NOT_FINITE else 1e-3
        np.testing.assert_allclose(estimate(unit), expected, rtol=0, atol=tolerance, err_msg=str(step))
    unit.calls.freeFMUState(state)


@pytest.mark.exhaustive
@needs_compiler
@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_a_simulator_takes_it(version, paths):
    """In another program that knows FMI: no fault is found, and its simulation is that of Python."""
    assert validate_fmu(str(paths[version])) == []
    h, rows = 1 / RATE, 50
    t = np.arange(rows + 1) * h
    y, u = np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(4 * t)], axis=1), np.zeros((rows + 1, 2))
    if version == "3.0":
        rows_of, types = zip(t, y, u, strict=True), [("time", "f8"), ("y", "f8", 2), ("u", "f8", 2)]
        names, heavy = ["q", "v"], {"parameters.mass": [0.6, 0.7]}
    else:
        rows_of, types = np.column_stack([t, y]), [(name, "f8") for name in ("time", "y[1]", "y[2]")]
        names, heavy = ["q[1]", "q[2]", "v[1]", "v[2]"], {"parameters.mass[2]": 0.7}
    timing = {"stop_time": t[-1], "step_size": h, "output_interval": h}
    signals = np.array([tuple(row) for row in rows_of], dtype=types)
    told = fmpy.simulate_fmu(str(paths[version]), **timing, input=signals, output=names, start_values=heavy)
    heavier = with_mass(0.7)
    state = heavier.init(jnp.asarray(y[0]), jnp.asarray(0.0))
    for k in range(rows):
        if k:
            state = stepped(heavier, state, jnp.asarray(u[k]), jnp.asarray(y[k]), jnp.asarray(t[k] - t[k - 1]))
    ahead = stepped(heavier, state, jnp.zeros(2), jnp.full(2, jnp.nan), jnp.asarray(h))
    last = np.concatenate([np.ravel(told[name][-1]) for name in names])
    np.testing.assert_allclose(last, heavier.estimate(ahead), rtol=0, atol=1e-9)


def test_equal_units_are_equal_files_and_a_file_that_is_there_stays(tmp_path, paths):
    write_fmu(units()["3.0"], tmp_path / "again.fmu")
    assert (tmp_path / "again.fmu").read_bytes() == paths["3.0"].read_bytes()
    with pytest.raises(ValueError, match="there is one already"):
        write_fmu(units()["2.0"], tmp_path / "again.fmu")
    with pytest.raises(ValueError, match="there is no folder"):
        write_fmu(units()["2.0"], tmp_path / "no" / "again.fmu")


def test_without_a_compiler_the_command_writes_sources_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_fmu, "compiler_command", lambda: None)
    words = ["export", str(MODEL), "--rate", "500", "--json"]

    def told(*more: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["covariant", *words, *more])
        with pytest.raises(SystemExit) as left:
            main()
        return int(left.value.code or 0), *capsys.readouterr()

    code, out, error = told("-o", str(tmp_path / "a.fmu"), "--name", "arm")
    assert code == 0
    assert "holds sources and no binary: there is no C compiler" in error
    assert "no binary" in json.loads(out)["warning"]
    with zipfile.ZipFile(tmp_path / "a.fmu") as packed:
        assert not [name for name in packed.namelist() if name.startswith("binaries")]
    for wrong, said in (
        (("-o", str(tmp_path / "b.fmu"), "--fmi", "1.0"), "fmi must be one of 3.0, 2.0"),
        (("-o", str(tmp_path / "b"), "--fmi", "2.0"), "ends in .fmu"),
    ):
        code, _, error = told(*wrong)
        assert code == 2
        assert said in error
