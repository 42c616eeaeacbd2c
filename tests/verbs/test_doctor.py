"""What an installation consists of, and what in it is wrong."""

from importlib import metadata

import jax

from covariant import verbs
from covariant.verbs import _doctor


def part_of(name):
    return next(part for part in verbs.doctor().parts if part.name == name)


def problem(name):
    return part_of(name).problem


def test_every_package_and_extra_that_is_stated_is_listed():
    parts = {part.name: part.found for part in verbs.doctor().parts}
    assert parts["jax"] == metadata.version("jax")
    provided = set(metadata.metadata("covariant").get_all("Provides-Extra"))
    listed = {name.removeprefix("extra ") for name in parts if name.startswith("extra ")}
    assert listed == provided - {"all", "dev", "docs"}


def test_a_version_that_was_not_tried_is_a_problem(monkeypatch):
    version = _doctor._version
    monkeypatch.setattr(_doctor, "_version", lambda name: "0.10.2" if name == "jax" else version(name))
    assert "tried with" in problem("jax")
    assert "jax" in problem("jax")
    monkeypatch.setattr(_doctor, "_version", lambda name: None if name == "scipy" else version(name))
    assert problem("scipy").startswith("pip install 'scipy")


def test_a_compiler_that_does_not_work_is_a_problem(monkeypatch, tmp_path):
    assert problem("compiler of C") == ""
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho no such thing >&2\nexit 1\n")
    broken.chmod(0o755)

    def fails(*arguments):
        raise OSError(f"{broken} does not compile a source of C: no such thing")

    monkeypatch.setattr(_doctor, "compiler", lambda: str(broken))
    monkeypatch.setattr(_doctor, "compiled", fails)
    assert "no such thing" in problem("compiler of C")


def test_without_a_compiler_nothing_is_wrong(monkeypatch):
    monkeypatch.setattr(_doctor, "compiler", lambda: None)
    monkeypatch.delenv("CC", raising=False)
    assert "install one" in part_of("compiler of C").advice
    assert problem("compiler of C") == ""


def test_a_cache_that_cannot_be_written_is_not_called_off(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    place = str(tmp_path / "file" / "cache")
    monkeypatch.setenv("COVARIANT_CACHE", place)
    part = part_of("cache folder")
    assert place in part.found
    assert part.problem


def test_a_compiler_that_cc_names_and_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(_doctor, "compiler", lambda: None)
    monkeypatch.setenv("CC", "no-such-cc")
    part = part_of("compiler of C")
    assert "CC=no-such-cc" in part.found
    assert "install one" in part.problem


def test_single_precision_is_a_problem(monkeypatch):
    assert problem("JAX computes on") == ""
    with jax.enable_x64(False):
        assert "double precision is off" in problem("JAX computes on")
