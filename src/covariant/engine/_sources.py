"""Lists the files of the library on which a cached text depends: modules and templates, also of sub-rooms."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
LIBRARY = ("covariant", "scalargraph")
"""The packages whose files trace an observer and write its C."""


def source_files(*places: str, root: Path = ROOT) -> list[Path]:
    """Modules and templates below some folders, or single files, of the library.

    In an installed library pip also compiles templates that are Python; their `templates/__pycache__` is left out.
    """
    paths = [path for place in places for path in (root / place, *(root / place).rglob("*")) if path.is_file()]
    return sorted({path for path in paths if path.suffix == ".py" or path.parent.name == "templates"})
