"""Loads the names of a room (subpackage) lazily from its stub; users see the names in the stub's `__all__`."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lazy_loader


def attach(package: str, filename: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` for a room, from the stub `__init__.pyi` beside its `__init__.py`.

    The stub imports the names that the rest of the library may use; its `__all__` lists the names for users, which are
    documented and change only with notice.
    """
    getter, listing, _ = lazy_loader.attach_stub(package, filename)
    stub = ast.parse(Path(filename).with_suffix(".pyi").read_text(encoding="utf-8"))
    values = [node.value for node in stub.body if isinstance(node, ast.Assign)]
    return getter, listing, ast.literal_eval(values[0])
