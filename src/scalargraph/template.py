"""Fills in templates of generated files; each template is a valid file of its own language.

A placeholder `xNAMEx` is an identifier in C, Python and JavaScript, so that compilers and linters accept a template.
A placeholder for whole lines is a comment on its own line: `/* xLINESx */`, `#: xLINESx` or `<!-- xLINESx -->`.
"""

import functools
import importlib.resources
import re
from typing import Any

Words = dict[str, Any]
"""Texts or numbers by the names of placeholders; a placeholder for whole lines has a sequence of lines."""

_NAME = "x([A-Z](?:[A-Z_]*[A-Z])?)x"
PLACEHOLDER = re.compile(rf"^ *(?:/\* {_NAME} \*/|#: {_NAME}|<!-- {_NAME} -->)\n|{_NAME}", re.MULTILINE)


def fill(package: str, file: str, words: Words) -> str:
    """Fill in the placeholders of a template."""

    def text(match: re.Match[str]) -> str:
        name = match[match.lastindex or 0]
        # Group 4 matches a placeholder within a line, the other groups match one for whole lines.
        return str(words[name]) if match[4] else "".join(f"{line}\n" for line in words[name])

    return PLACEHOLDER.sub(text, template(package, file))


@functools.cache
def template(package: str, file: str) -> str:
    """The text of a template with its placeholders."""
    return (importlib.resources.files(package) / "templates" / file).read_text(encoding="utf-8")
