"""What an installation consists of, and what in it is wrong: what takes long."""

from importlib import metadata

import pytest
from commands import command, leave
from test_doctor import part_of, problem

from covariant.verbs import _doctor


@pytest.mark.parametrize(
    ("name", "value", "part"), [("COVARIANT_CACHE", "off", "cache folder"), ("OPENBLAS_NUM_THREADS", "4", "threads")]
)
def test_what_makes_it_slow_is_advised_against_and_no_problem(monkeypatch, name, value, part):
    assert part_of(part).advice == ""
    monkeypatch.setenv(name, value)
    assert name in part_of(part).advice
    assert part_of(part).problem == ""


def test_the_command_exits_with_1_where_something_is_wrong(monkeypatch):
    version = metadata.version("covariant")
    assert command("doctor")["covariant"] == {"found": version, "problem": None, "advice": None}
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    code, out, _ = leave("doctor")
    assert (code, "advice: every process compiles anew; set COVARIANT_CACHE to a folder" in out) == (0, True)
    monkeypatch.setattr(_doctor, "_version", lambda name: None)
    code, out, _ = leave("doctor")
    assert (code, "problem: pip install 'scipy" in out) == (1, True)
