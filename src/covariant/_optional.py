"""The door for optional packages."""

import importlib
from typing import Any


def load_optional(module: str, *, use: str, extra: str) -> Any:
    """Import an optional module, or raise `ImportError` saying what needs it and with the line that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        raise ImportError(f"{use} {package}, which is not installed: pip install 'covariant[{extra}]'") from missing
