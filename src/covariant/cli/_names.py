"""What the help of the commands names, found or written down here so that it is shown without loading what it names."""

import ast
from importlib.resources import files


def _registered() -> tuple[str, ...]:
    """The names of the entries in the registry of observers, read from its text."""
    text = files("covariant").joinpath("observers", "_registry.py").read_text(encoding="utf-8")
    entries = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return tuple(ast.literal_eval(k.value) for entry in entries for k in entry.keywords if k.arg == "name")


ESTIMATORS = _registered()
CERTIFIED = ("intrinsic", "geodesic")
"""As the observers of `covariant.cli._certify`."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""As those of `covariant.cli._reproduce`."""
