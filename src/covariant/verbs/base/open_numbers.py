"""The numbers of a model that a log may show, where nobody names any."""

from typing import Any

from covariant import models
from covariant.models import Overrides


def open_numbers(spec: str, overrides: Overrides = ()) -> list[str]:
    """Names of the numbers: of a robot those of its servos, or its friction and rotors; of another machine all of
    [parameters] that are not zero."""
    content = models.document(spec, overrides)
    parameters = content.get("parameters", {})
    if content.get("system") == "robot":
        return ["servo"] if "servo" in content else [key for key in ("friction", "armature") if key in parameters]
    return [name for key, value in parameters.items() for name in _nonzero(key, value)]


def _nonzero(name: str, value: Any) -> list[str]:
    """Names of the numbers within a value of [parameters] that are not zero."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [inner for key, each in items for inner in _nonzero(f"{name}[{key}]", each)]
    return [name] if isinstance(value, int | float) and not isinstance(value, bool) and value else []
