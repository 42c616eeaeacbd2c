"""The tests on other versions of Python: which are found, what is left out, and that a failure is one."""

import subprocess
import sys
import tomllib
from itertools import chain

import matrix
import pytest
from packaging.requirements import Requirement


def script(path, line):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine without any Python of these versions."""
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    monkeypatch.setattr(matrix, "ROOT", tmp_path)
    (tmp_path / "pyproject.toml").touch()
    return tmp_path


def test_a_version_that_is_not_here_is_left_out_and_said(machine, capsys):
    assert matrix.main([]) == 0
    missing = [f"Python {version} is not here: nothing was run on it\n" for version in ("3.11", "3.12", "3.13")]
    assert capsys.readouterr().out == "".join(missing)
    assert matrix.main(["--short"]) == 0
    assert capsys.readouterr().out == missing[2]


def test_a_name_on_the_path_that_does_not_run_is_passed_over_for_the_newest_of_pyenv(machine):
    """As of pyenv, which has a name for each version that it could run."""
    script(machine / "bin/python3.12", "exit 127")
    for patch in ("3.12.9", "3.12.10", "3.12-dev"):
        script(machine / "pyenv/versions" / patch / "bin/python", "exit 0")
    script(machine / "pyenv/versions/3.13.1/bin/python", "exit 1")
    assert matrix.interpreter("3.12") == str(machine / "pyenv/versions/3.12.10/bin/python")
    assert matrix.interpreter("3.13") is None
    script(machine / "bin/python3.12", "exit 0")
    assert matrix.interpreter("3.12") == "python3.12"


def test_a_command_that_fails_is_named_and_the_others_run(machine, monkeypatch, capfd):
    monkeypatch.setattr(matrix, "interpreter", {"3.12": sys.executable}.get)
    monkeypatch.setattr(matrix, "INSTALL", ("-c", "print('installed')"))
    monkeypatch.setattr(
        matrix, "ALL", ("python -c print(1+1)", "python -c raise(SystemExit(3))", "python -c print(2+3)")
    )
    monkeypatch.setattr(matrix, "environment", lambda version, python: machine / "environment")
    script(machine / "environment/bin/python", f'exec {sys.executable} "$@"')
    assert matrix.main([]) == 1
    printed = capfd.readouterr().out
    assert "FAILED Python 3.12: python -c raise(SystemExit(3))" in printed
    assert printed.count("FAILED") == 1
    assert [line for line in printed.splitlines() if line.isdigit()] == ["2", "5"]


def test_an_environment_is_made_once_and_again_when_the_requirements_change(machine, monkeypatch):
    calls = []

    def run(command, **_):
        calls.append([str(word) for word in command])
        (machine / ".venv-3.12").mkdir(exist_ok=True)

    monkeypatch.setattr(subprocess, "run", run)
    folder = matrix.environment("3.12", "python3.12")
    install = [str(folder / "bin/python"), *matrix.INSTALL, "-c", str(folder / "floors.txt")]
    assert calls == [["python3.12", "-m", "venv", str(folder)], install]
    assert not (folder / "floors.txt").read_text()
    matrix.environment("3.12", "python3.12")
    assert len(calls) == 2
    (folder / "ready").unlink()
    matrix.environment("3.12", "python3.12")
    assert len(calls) == 4


def test_the_lowest_environment_pins_each_requirement_to_its_lowest_version(machine, monkeypatch):
    (machine / "pyproject.toml").write_text(
        '[project]\ndependencies = ["jax>=0.7,!=0.10.*,<2", "plain"]\n'
        '[project.optional-dependencies]\nlogs = ["dask[distributed]>=2024.8"]\nall = ["covariant[logs]"]\n'
    )
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: (machine / ".venv-3.11-lowest").mkdir(exist_ok=True))
    folder = matrix.environment(matrix.LOWEST, "python3.11")
    assert (folder / "floors.txt").read_text() == "dask==2024.8\njax==0.7\n"


def test_every_requirement_of_a_user_has_a_lowest_version_that_is_tested():
    pinned = {line.partition("==")[0] for line in matrix.floors().splitlines()}
    project = tomllib.loads((matrix.ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: each for name, each in project["optional-dependencies"].items() if name not in ("dev", "docs")}
    needed = {Requirement(text).name for text in chain(project["dependencies"], *extras.values())}
    assert needed - {"covariant"} == pinned
