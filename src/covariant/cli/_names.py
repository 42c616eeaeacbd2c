"""Names for the help of the commands, known here so that help does not load the modules that define them."""

import ast
from importlib.resources import files
from typing import Literal


def _registered(file: str) -> tuple[str, ...]:
    """The names in a registry of observers, read from its source text."""
    text = files("covariant").joinpath("observers", file).read_text(encoding="utf-8")
    entries = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return tuple(ast.literal_eval(k.value) for entry in entries for k in entry.keywords if k.arg == "name")


ESTIMATORS, STATE_ESTIMATORS = _registered("_registry.py"), _registered("_state_registry.py")
CERTIFIED = ("intrinsic", "geodesic")
"""The observers that there are certificates for."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""The papers that are reproduced."""
Engine = Literal["auto", "c", "jax"]
"""Those of `covariant.engine`."""
WRITTEN = (".csv", ".txt", ".tsv", ".parquet", ".mcap", ".rosbag2")
"""Those of `covariant.logs`."""
