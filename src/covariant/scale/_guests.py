"""The door for optional packages."""

import importlib
from typing import Any


def guest(module: str) -> Any:
    """Import an optional module, or raise `ImportError` with the line that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        raise ImportError(
            f"big grids need {package}, which is not installed: pip install 'covariant[scale]'"
        ) from missing
