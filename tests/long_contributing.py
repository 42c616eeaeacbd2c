"""What takes long of `test_contributing.py`."""

import re
from pathlib import Path

import pytest
from test_contributing import house, python


@pytest.mark.exhaustive
def test_an_observer_in_one_file_and_one_entry_is_run_and_compared(house):
    """On the log of a model that was added in one file and one line."""
    script = """
import json, sys
from covariant import calibration, models
from covariant.cli import main
from covariant.observers import OBSERVER_NAMES, run
from covariant.verbs.base import kinds as _kinds

def command(*arguments):
    sys.argv = ["covariant", *arguments]
    try:
        main()
    except SystemExit as done:
        assert not done.code

bead = models.load("bead_on_hoop").model
assert OBSERVER_NAMES == calibration.ESTIMATORS
assert calibration.estimators(bead)[-1] == "tracker"
made = calibration.tuned_estimators(bead, 1, calibration.DataSheet(1e-3, 1.0), 100.0)

command("simulate", "bead_on_hoop", "-o", "log.csv", "--duration", "3", "--rate", "100", "--q0", "0.5", "--v0", "0")
quick = ("copy", "tracker")  # all would take a while to compile
_kinds.tuned_estimators = lambda *a: {
    name: o for name, o in calibration.tuned_estimators(*a).items() if name in quick
}
sheet = ("--set", "measurement.std=1e-3", "--set", "uncertainty.acceleration=1", "--truth", "true_angle_dot")
command("compare", "bead_on_hoop", "log.csv", *sheet, "--json")
command("estimate", "bead_on_hoop", "log.csv", "--observer", "tracker", *sheet, "--json")
from covariant import logs
record = logs.read("log.csv", logs.Columns(q=("angle",), u=("u1",))).record
print("RUN", run(made["tracker"], record).estimate.shape)
"""
    said = python(house, "-c", script)
    assert "tracker" in said.split('"ranking"')[1].split("\n")[0]
    assert '"observer": "tracker"' in said
    assert "RUN (301, 2)" in said


@pytest.mark.exhaustive
def test_it_is_put_to_the_laws_and_a_law_to_every_observer(house):
    laws = "tests/laws/test_every_observer.py"
    done = python(house, "-m", "pytest", "-q", "-p", "no:xdist", "--no-header", "-rA", laws, "-k", "tracker and beam")
    passed = set(re.findall(r"PASSED \S+::(\w+)\[tracker-ball and beam\]", done))
    source = (house / laws).read_text(encoding="utf-8")
    assert passed == set(re.findall(r"^def (test_\w+)\(entry, name\)", source, re.MULTILINE))
    assert "test_what_is_measured_later_changes_nothing_before" in passed


@pytest.mark.exhaustive
def test_a_kind_of_claim_is_proved_written_read_and_checked(house):
    python(house, "-m", "pytest", "-q", "-p", "no:xdist", "--no-header", "tests/certificates/test_ceiling.py")


def laws_of_geometry(house: Path, chosen: str) -> set[str]:
    """Run laws on the space of the page; returns the names of those that passed."""
    files = ("tests/laws/test_geometry.py", "tests/geometry/test_spaces.py")
    done = python(house, "-m", "pytest", "-q", "-p", "no:xdist", "--no-header", "-rA", *files, "-k", chosen)
    return set(re.findall(r"PASSED \S+::(\w+)\[hills\]", done))


@pytest.mark.exhaustive
def test_a_space_is_put_to_the_laws_at_a_point(house):
    assert laws_of_geometry(
        house, "hills and (symmetric_positive or torsion or its_symmetries or christoffel_is or curvature_is_that)"
    ) >= {
        "test_metric_is_symmetric_positive_definite",
        "test_connection_is_torsion_free",
        "test_curvature_has_its_symmetries",
        "test_christoffel_is_that_of_the_matrix",
        "test_curvature_is_that_of_the_matrix",
    }


@pytest.mark.exhaustive
def test_a_space_is_put_to_the_laws_of_geodesics(house):
    assert laws_of_geometry(house, "hills and (there_and_back or geodesic_is_found)") >= {
        "test_transport_there_and_back_is_the_identity",
        "test_geodesic_is_found",
    }


@pytest.mark.exhaustive
def test_a_kind_of_sensor_is_simulated_read_and_checked(house):
    script = """
import doctest, pathlib
import numpy as np, pandas
import covariant
from covariant.observers.sensors import _sensor_kinds

assert not doctest.testmod(_sensor_kinds).failed
pathlib.Path("arm.toml").write_text('''
system = "robot"
[parameters]
path = "double_pendulum"
[measurement]
std = 1e-3
[sensors.tilt]
kind = "inclinometer"
link = "lower"
columns = ["tilt"]
units = "deg"
std = 0.01
''')
log = covariant.simulate("arm.toml", duration=3.0, rate=200.0, q0=[0.6, -0.4], amplitude=[0.3, 0.2], noise=1e-3)
frame = pandas.DataFrame(log.columns)
# Both joints turn about y.
off = np.deg2rad(frame["tilt"]) - frame["true_shoulder"] - frame["true_elbow"]
assert abs(off.mean()) < 2e-3 and 0.008 < off.std() < 0.012
assert not covariant.check("arm.toml", frame).wrong
frame["tilt"] = np.deg2rad(frame["tilt"])
print([(each.where, each.line) for each in covariant.check("arm.toml", frame).findings if each.wrong])
"""
    assert """('tilt', '[sensors.tilt] units = "rad"')""" in python(house, "-c", script)


@pytest.mark.exhaustive
def test_a_verb_is_a_function_and_a_command(house):
    script = """
import sys
from covariant.cli import main

def command(*arguments):
    sys.argv = ["covariant", *arguments]
    try:
        main()
    except SystemExit as done:
        assert not done.code

command("simulate", "oscillator", "-o", "gaps.csv", "--duration", "2", "--q0", "1", "--dropout", "0.1")
command("gaps", "oscillator", "gaps.csv")
command("gaps", "oscillator", "gaps.csv", "--json")
"""
    printed = python(house, "-c", script)
    line = re.search(r"^(\d+) of 1001 rows lack a measurement, for [\d.]+ s at most$", printed, re.MULTILINE)
    assert line
    assert 50 < int(line[1]) < 150
    assert f'"missing": {line[1]}' in printed
    python(house, "-m", "pytest", "-q", "-p", "no:xdist", "tests/verbs/test_gaps.py")


@pytest.mark.exhaustive
def test_a_suspicion_in_one_function_is_judged_with_the_others(house):
    test = "tests/calibration/test_absolute_angles.py"
    assert "1 passed" in python(house, "-m", "pytest", "-q", "-p", "no:xdist", "--no-header", test)


@pytest.mark.exhaustive
def test_examples_in_docstrings_of_the_page_run(house):
    script = """
import doctest, importlib
for name in ("covariant.geometry._surface", "covariant.verbs._gaps"):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted and not result.failed, name
"""
    python(house, "-c", script)


@pytest.mark.exhaustive
def test_the_code_of_the_page_keeps_the_house_rules(house):
    rules = "left or private or circle or opens_with or defined_once or agreed"
    python(house, "-m", "pytest", "-q", "-p", "no:xdist", "--noconftest", "tests/test_house.py", "-k", rules)


@pytest.mark.exhaustive
def test_it_is_in_the_table_of_the_docs(house):
    python(house, "tools/pages.py")
    row = "| `tracker` | `Tracker` | prediction by the model, correction along the error | as a first example |"
    assert row in (house / "docs" / "observers.md").read_text(encoding="utf-8")
