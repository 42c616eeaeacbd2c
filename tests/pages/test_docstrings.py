"""Every example of a docstring runs as it stands, in the place of a user, and shows what it computes."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import covariant

SOURCE = Path(covariant.__file__).parent
RUN = Path(__file__).with_name("run_docstrings.py")
WITH_EXAMPLES = [path for path in sorted(SOURCE.rglob("*.py")) if ">>>" in path.read_text(encoding="utf-8")]


def name_of(path: Path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


@pytest.mark.long
@pytest.mark.parametrize("room", sorted({room_of(path) for path in WITH_EXAMPLES}))
def test_examples_show_what_they_compute(room, tmp_path):
    names = [name_of(path) for path in WITH_EXAMPLES if room_of(path) == room]
    done = subprocess.run([sys.executable, str(RUN), *names], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


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
