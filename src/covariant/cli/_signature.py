"""Arguments of a verb, read from its source, since an import would load JAX to show help.

The first sentence of each entry under `Args:` is the help of its option, and the annotation decides how it is read.
"""

import ast
import functools
import re
from pathlib import Path
from typing import Any, NamedTuple

from covariant import many, verbs

REQUIRED = object()
"""Stands for the default of an argument without one."""
ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)
"""An entry under `Args:`: its names, and its text."""


class Argument(NamedTuple):
    """An argument of a verb: its annotation without `| None`, its default or `REQUIRED`, and its docstring entry."""

    annotation: str
    default: Any
    text: str


class VerbSignature(NamedTuple):
    """The first paragraph of a verb's docstring, its arguments by name, and whether it reports its progress."""

    summary: str
    arguments: dict[str, Argument]
    progress: bool


@functools.cache
def signature(verb: str) -> VerbSignature:
    """Read the signature and the docstring of a verb."""
    source = _places()[verb][1].read_text(encoding="utf-8")
    head = re.search(rf'^def {verb}\(.*?""".*?"""', source, re.MULTILINE | re.DOTALL)
    assert head, f"{verb} has no docstring"
    definition: Any = ast.parse(head[0]).body[0]
    documentation = ast.get_docstring(definition) or ""
    summary, _, rest = documentation.partition("\n\n")
    entries = ENTRY.findall(rest.partition("Args:\n")[2].partition("\n\n")[0])
    texts = {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}
    parameters = definition.args
    defaults = [None] * (len(parameters.args) - len(parameters.defaults))
    defaults += parameters.defaults + parameters.kw_defaults
    nodes = {
        node.arg: (node, default)
        for node, default in zip(parameters.args + parameters.kwonlyargs, defaults, strict=True)
    }
    progress = nodes.pop("progress", None) is not None
    arguments = {
        name: Argument(
            ast.unparse(node.annotation).removesuffix(" | None"),
            REQUIRED if default is None else ast.literal_eval(default),
            _text(texts[name], name),
        )
        for name, (node, default) in nodes.items()
    }
    return VerbSignature(" ".join(summary.split()), arguments, progress)


def _text(text: str, name: str) -> str:
    """Text of an entry; "As for `estimate`" refers to the entry of the same name there."""
    other = re.match(r"As for `(\w+)`", text)
    return signature(other[1]).arguments[name].text if other else text


def function(verb: str) -> Any:
    """The function of a verb."""
    return getattr(_places()[verb][0], verb)


@functools.cache
def _places() -> dict[str, tuple[Any, Path]]:
    """The subpackage and the file of each name that `covariant.verbs` or `covariant.many` offers."""
    places = {}
    for room in (many, verbs):  # the verbs of one log come last, as they have the signatures
        folder = Path(room.__path__[0])
        stub = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8"))
        for node in (node for node in stub.body if isinstance(node, ast.ImportFrom)):
            path = folder.joinpath(*(node.module or "").split(".")).with_suffix(".py")
            places |= {alias.name: (room, path) for alias in node.names}
    return places
