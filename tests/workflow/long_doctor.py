"""What an installation consists of, and what in it is wrong: what takes long."""

import json
from importlib import metadata

import pytest
from test_doctor import part_of, problem
from typer.testing import CliRunner

from covariant.cli._app import app
from covariant.workflow import _doctor


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("COVARIANT_CACHE", "off", "cache folder"),
        ("OPENBLAS_NUM_THREADS", "4", "threads"),
    ],
)
def test_what_makes_it_slow_is_advised_against_and_no_problem(monkeypatch, name, value, part):
    assert part_of(part).advice == ""
    monkeypatch.setenv(name, value)
    assert name in part_of(part).advice
    assert part_of(part).problem == ""


def test_the_command_exits_with_1_where_something_is_wrong(monkeypatch):
    fine = CliRunner().invoke(app, ["doctor", "--json"])
    assert fine.exit_code == 0
    assert json.loads(fine.stdout)["covariant"] == {
        "found": metadata.version("covariant"),
        "problem": None,
        "advice": None,
    }
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    slow = CliRunner().invoke(app, ["doctor"])
    assert slow.exit_code == 0
    assert "advice: every process compiles anew; set COVARIANT_CACHE to a folder" in slow.stdout
    monkeypatch.setattr(_doctor, "_version", lambda name: None)
    wrong = CliRunner().invoke(app, ["doctor"])
    assert wrong.exit_code == 1
    assert "problem: pip install 'scipy" in wrong.stdout
