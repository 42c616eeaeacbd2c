"""Every example of a docstring runs as it stands, in the place of a user, and shows what it computes."""

import importlib
from pathlib import Path

import pytest

import covariant

SOURCE = Path(covariant.__file__).parent


ROOMS = sorted(f"covariant.{p.parent.name}" for p in SOURCE.glob("*/__init__.pyi"))


@pytest.mark.parametrize("room", [*ROOMS, "scalargraph", "scalargraph.proofs"])
def test_every_public_class_has_an_example(room):
    """Classes that a room offers, and verbs."""
    module = importlib.import_module(room)
    offered = {name: getattr(module, name) for name in dir(module) if not name.startswith("_")}
    classes = {name: thing for name, thing in offered.items() if isinstance(thing, type)}
    if room in ("covariant.verbs", "covariant.many"):
        classes |= {name: thing for name, thing in offered.items() if callable(thing) and hasattr(covariant, name)}
    lacking = [name for name, thing in classes.items() if ">>>" not in (thing.__doc__ or "")]
    assert not lacking, f"no example: {', '.join(sorted(lacking))}"
