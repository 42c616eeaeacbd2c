"""Every example of a docstring runs, with the result that it shows, in a folder of its own."""

import doctest
import importlib
from pathlib import Path

import pytest

import covariant

SOURCE = Path(covariant.__file__).parent
HOW = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
WITH_EXAMPLES = [path for path in sorted(SOURCE.rglob("*.py")) if ">>>" in path.read_text(encoding="utf-8")]


def name_of(path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=name_of)
def test_examples_show_what_they_compute(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name_of(path))
    results = doctest.testmod(module, optionflags=HOW)
    assert results.attempted
    assert not results.failed, f"{results.failed} examples of {path} fail: see what was printed"


@pytest.mark.parametrize("room", sorted(p.parent.name for p in SOURCE.glob("*/__init__.pyi")))
def test_every_public_class_has_an_example(room):
    """Classes that a room offers, and verbs."""
    module = importlib.import_module(f"covariant.{room}")
    offered = {name: getattr(module, name) for name in dir(module) if not name.startswith("_")}
    classes = {name: thing for name, thing in offered.items() if isinstance(thing, type)}
    if room == "workflow":
        classes |= {name: thing for name, thing in offered.items() if callable(thing) and hasattr(covariant, name)}
    lacking = [name for name, thing in classes.items() if ">>>" not in (thing.__doc__ or "")]
    assert not lacking, f"no example: {', '.join(sorted(lacking))}"
