"""Docstrings of this library for mkdocstrings: `mkdocs.yml` names this file as an extension of griffe.

Examples stand under "Example:" here, for which griffe knows no section: it would show the code as a quotation.
"""

import re

import griffe


class ExampleSections(griffe.Extension):
    """Reads "Example:" as the section "Examples:", whose code is shown as code."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
