"""A wrong name or path is refused before anything heavy is loaded, so that the answer comes at once."""

import subprocess
import sys
from pathlib import Path

import pytest
from commands import refused

from covariant import calibration, observers
from covariant.models import ModelError, check_spec, duffing, load
from covariant.models.files._source import system
from covariant.models.files._systems import SYSTEMS

SCRIPT = """
import sys
sys.argv = ["covariant", *sys.argv[1:]]
from covariant.cli import main
try:
    main()
except SystemExit as left:
    print(left.code, "jax" in sys.modules)
"""
LOG = "t,q1,u1\n0,0,0\n0.01,0.1,0\n"
REFUSED = {
    "no model file": ("estimate nofile.toml log.csv", "nofile.toml: No such file or directory; give the path"),
    "no robot file": ("model nofile.urdf", "nofile.urdf: No such file or directory; give the path of a URDF"),
    "no such system": ("simulate pendulum_chian -o out.csv", "unknown model 'pendulum_chian'. Did you mean"),
    "no log": ("estimate oscillator nolog.csv", "nolog.csv: no such file"),
    "no log to fit": ("fit oscillator log.csv nolog.csv --parameters mass", "nolog.csv: no such file"),
    "no log to tune by": ("tune oscillator nolog.csv", "nolog.csv: no such file"),
    "no log to draft from": ("init nolog.csv -o model.toml", "nolog.csv: no such file"),
    "no log to check": ("check oscillator nolog.csv", "nolog.csv: no such file"),
    "no observer": ("estimate oscillator log.csv --observer magic", "unknown observer 'magic'. Known: intrinsic,"),
    "no observer to export": ("export oscillator --rate 100 -o c --observer magic", "unknown observer 'magic'"),
    "no observer to certify": (
        "certify oscillator --observer ekf",
        "observer 'ekf' is not covered; use one of intrinsic",
    ),
    "no engine": ("estimate oscillator log.csv --engine fortran", "fortran"),
    "no paper": ("reproduce nobody", "unknown paper 'nobody'. Known: aghannan-rouchon"),
    "another kind of output": ("estimate oscillator log.csv -o v.xlsx", "must end in .csv"),
    "another kind of report": ("compare oscillator log.csv --report page.pdf", "must end in .html"),
    "a page of a saved certificate": ("certify --check a.json --report page.html", "leave --check out"),
    "an observer without a certificate": (
        "certify oscillator --observer lagrangian-metric",
        "observer 'lagrangian-metric' is not covered; use one of intrinsic, geodesic, measured-coefficients",
    ),
    "no observer of a certificate": ("certify oscillator --observer geodesc", "Did you mean 'geodesic'?"),
    "no folder": ("certify oscillator -o absent/proof.json", "there is no folder absent"),
    "no certificate": ("certify --check nofile.json", "nofile.json does not exist"),
    "no store": ("design metric lorenz --grid 5 -o metric.csv", "must end in .zarr"),
}


@pytest.mark.core(1)
@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_name_is_refused_without_jax(case, tmp_path):
    words, message = REFUSED[case]
    (tmp_path / "log.csv").write_text(LOG)
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, *words.split()], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert message in run.stderr
    assert run.stdout == "2 False\n"
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


def test_names_of_observers_are_those_of_the_registry():
    names = observers.OBSERVER_NAMES + observers.STATE_OBSERVER_NAMES
    assert tuple(entry.name for entry in observers.REGISTRY) == names
    assert observers.OBSERVER_NAMES == calibration.ESTIMATORS
    assert observers.STATE_OBSERVER_NAMES == calibration.STATE_ESTIMATORS
    assert (*calibration.estimators(duffing()), "legged-base") == observers.STATE_OBSERVER_NAMES


def test_what_is_refused_early_is_what_cannot_be_loaded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("model.toml").write_text('system = "oscillator"\n')
    for spec in ("oscillator", "double_pendulum", "model.toml", "absent_module:model"):
        check_spec(spec)
    for spec in ("absent.toml", "absent.urdf", "oscilator", ""):
        with pytest.raises(ValueError, match=r"absent|unknown model") as early:
            check_spec(spec)
        with pytest.raises(ModelError) as late:
            load(spec)
        assert str(early.value) == str(late.value)


def test_every_system_is_made_by_a_function_that_is_found_again():
    assert all(callable(system(name)) and system(name) is system(name) for name in SYSTEMS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("estimate log.csv arm.toml", "unknown model 'log.csv'. The model comes first and then the log: did you swap"),
        ("estimate oscillator log.csv --observer ekff", "unknown observer 'ekff'. Did you mean 'ekf'? Known: "),
        ("reproduce maithripla", "unknown paper 'maithripla'. Did you mean 'maithripala'?"),
        ("export oscillator --rate 100 -o c --real flaot", "; got 'flaot'. Did you mean 'float'?"),
    ],
)
def test_a_name_that_is_nearly_right_is_suggested(arguments, words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("t,q\n0,0\n")
    (tmp_path / "arm.toml").write_text('system = "oscillator"\n')
    refused(*arguments.split(), named=[words])
