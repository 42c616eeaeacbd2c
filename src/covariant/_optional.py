"""Import of optional packages."""

import importlib
from typing import Any


def load_optional(module: str, *, use: str, extra: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: Full name of the module.
        use: What needs it, the beginning of the message, as "reading data frames needs".
        extra: Extra of `covariant` that installs it.

    Returns:
        The module.

    Raises:
        ImportError: The package is not installed; the message has the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        raise ImportError(f"{use} {package}, which is not installed: pip install 'covariant[{extra}]'") from missing
