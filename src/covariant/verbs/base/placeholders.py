"""Numbers of a drafted model file that nobody has replaced yet: `init` marks each with its first value."""

import re
from collections.abc import Mapping, Sequence
from os import PathLike

from covariant import models
from covariant.verbs.base.arguments import Overrides
from covariant.verbs.base.model_text import model_text

MARK = "placeholder"
"""Word in the comment of a parameter, before the numbers that `init` wrote."""
_LINE = re.compile(
    rf"^\s*(?:\[(?P<table>[^\[\]#\n]+)\]|(?P<key>\w+)\s*=[^#\n]*#\s*{MARK} (?P<numbers>[-+.\deE]+(?:, [-+.\deE]+)*))",
    re.MULTILINE,
)
"""A marked line, or the head of a table."""
_SERVO = re.compile(r"""servo\s*\.\s*(?P<quote>["']?)(?P<joint>.*)(?P=quote)""")


def marked(values: Sequence[float]) -> str:
    """The beginning of the comment of a parameter whose values are guesses."""
    return f"# {MARK} {', '.join(map(str, values))}"


def placeholders(model: object, overrides: Overrides) -> dict[str, float]:
    """Parameters by name, such as `mass[0]`, that still have the value with which `init` marked them."""
    if not isinstance(model, str | PathLike) or not str(model).endswith(".toml"):
        return {}
    document, place = models.document(str(model), overrides), ""
    table = document.get("parameters", {})
    unchanged = {}
    for line in _LINE.finditer(model_text(model)):
        if line["table"]:
            servo = _SERVO.fullmatch(line["table"].strip())
            place = f"servo.{servo['joint']}." if servo else ""
            table = document.get("servo", {}).get(servo["joint"], {}) if servo else document.get("parameters", {})
            continue
        key, value = place + line["key"], table.get(line["key"])
        named = {f"{key}[{i}]": one for i, one in enumerate(value)} if isinstance(value, list) else {key: value}
        drafted = map(float, line["numbers"].split(", "))
        unchanged |= {name: one for (name, one), first in zip(named.items(), drafted, strict=False) if one == first}
    return unchanged


def drafted_names(model: str | PathLike[str]) -> list[str]:
    """Parameters that `init` marked in a model file, whatever their values are now."""
    table, names = "", []
    for line in _LINE.finditer(model_text(model)):
        table = line["table"] or table
        names += [line["key"]] if line["key"] and table == "parameters" else []
    return names


def placeholder_sentence(values: Mapping[str, float]) -> str:
    """A sentence that names them, with what to do; "" where there are none."""
    if not values:
        return ""
    named = ", ".join(f"{name} = {value:g}" for name, value in values.items())
    return (
        f"Still placeholders of the draft: {named}. Put the numbers of your machine there, or fit them to "
        f"a log that shows them; where one is right, take the word {MARK} out of its comment."
    )
