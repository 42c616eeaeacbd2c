"""Names for the help of the commands, known here so that help does not load the modules that define them."""

import ast
from importlib.resources import files


def _registered() -> tuple[str, ...]:
    """The names in the registry of observers, read from its source text."""
    text = files("covariant").joinpath("observers", "_registry.py").read_text(encoding="utf-8")
    entries = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return tuple(ast.literal_eval(k.value) for entry in entries for k in entry.keywords if k.arg == "name")


ESTIMATORS = _registered()
CERTIFIED = ("intrinsic", "geodesic")
"""The observers of `covariant.cli._certify`."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""The papers of `covariant.cli._reproduce`."""
WRITTEN = (".csv", ".txt", ".tsv", ".parquet", ".mcap", ".rosbag2")
"""Those of `covariant.logs`."""
