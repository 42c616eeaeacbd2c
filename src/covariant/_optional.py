"""Import of optional packages."""

import importlib
from typing import Any

from scalargraph.errors import MissingPackageError


def load_optional(module: str, *, use: str, extra: str) -> Any:
    """Import a module of an optional package."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        raise MissingPackageError(
            f"{use} {package}, which is not installed: pip install 'covariant[{extra}]'"
        ) from missing
