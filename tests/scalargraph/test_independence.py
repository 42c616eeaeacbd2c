"""The package stands alone: it imports JAX, NumPy and itself, so that it can be read and used without covariant."""

import ast
import sys
from pathlib import Path

import scalargraph

FILES = sorted(Path(scalargraph.__file__).parent.rglob("*.py"))
PACKAGES = {"jax", "jaxtyping", "lazy_loader", "numpy", "platformdirs", "scalargraph"}


def outside(path: Path) -> set[str]:
    """The packages that a file imports anywhere, and that are neither Python's nor those that it needs."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports from its own folder"
            names.add(node.module or "")
    return {name.partition(".")[0] for name in names} - {*sys.stdlib_module_names, *PACKAGES}


def test_files_import_nothing_of_covariant():
    assert len(FILES) > 50
    assert {path.name: names for path in FILES if (names := outside(path))} == {}


def test_an_import_of_another_package_would_be_seen(tmp_path):
    path = tmp_path / "file.py"
    path.write_text("import numpy\ndef f():\n    from covariant import models\n    import scipy")
    assert outside(path) == {"covariant", "scipy"}
