"""The room stands alone: it imports JAX, NumPy and itself, so that it can be read and used without the others."""

import ast
import sys
from pathlib import Path

from covariant import lowering

FILES = sorted(Path(lowering.__file__).parent.rglob("*.py"))
PACKAGES = {"jax", "lazy_loader", "numpy"}
OTHERS = {
    "__init__.py": {"covariant._rooms"},
    "_c_intervals.py": {"covariant._compile", "covariant._templates"},
    "_c_rows.py": {"covariant._templates"},
}
"""Modules of the library outside the room that a file may import, which all rooms share: how a room loads, the cache of
compiled C, and templates; and every file the errors."""


def imported(path: Path) -> set[str]:
    """The modules that a file imports anywhere, with dots as in the absolute form."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level < 2, f"{path.name} imports from a folder above its own"
            module = node.module or ""
            names.add(f"covariant.lowering.{module}".rstrip(".") if node.level else module)
            # A name of the package itself may be one of its rooms.
            names |= {f"covariant.{alias.name}" for alias in node.names} - names if module == "covariant" else set()
    return names - {"covariant"}


def outside(path: Path) -> set[str]:
    """The modules that are neither of the room, nor of Python, nor of the packages that it needs."""
    allowed = {*sys.stdlib_module_names, *PACKAGES}
    names = {name for name in imported(path) if name.partition(".")[0] not in allowed}
    own = {name for name in names if name == "covariant.lowering" or name.startswith("covariant.lowering.")}
    return names - own - {"covariant._errors"}


def test_files_of_the_room_import_nothing_of_the_other_rooms():
    assert len(FILES) > 20
    assert {path.name: names for path in FILES if (names := outside(path))} == OTHERS


def test_an_import_of_another_room_would_be_seen(tmp_path):
    path = tmp_path / "file.py"
    path.write_text(
        "import numpy\ndef f():\n    from covariant import models\n    import covariant._typing\n    import scipy"
    )
    assert outside(path) == {"covariant.models", "covariant._typing", "scipy"}
