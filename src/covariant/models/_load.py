"""Loads models: from files, from modules, or by name."""

from collections.abc import Sequence
from typing import Any

from covariant.models import _source
from covariant.models._family import family
from covariant.models._file import ModelError, ModelFile, document, finish


def load(spec: str, overrides: Sequence[str] = ()) -> ModelFile:
    """Load a model.

    - `spec`: a `.toml` file; the `.urdf` or `.xml` file of a robot, or the name of one that comes with the library (see
      `models.robots.load`); `module:attribute` (a `Lagrangian`, a `GroupSystem`, a `StateSpace`, a `ModelFile`, or a
      function that makes one; the module is also looked for in the current folder); or the name of a system with its
      default parameters.
    - `overrides`: applied last. Each is `table.key=value`, with the tables of the file and values as in TOML, such as
      `parameters.mass=[1.0, 2.0]`.

    Raises `ModelError`, one line that names the spec and the first thing wrong.
    """
    try:
        file = finish(spec, document(spec, overrides))
    except ValueError as error:
        line = _source.first_line(error)  # of a robot's file it names the path already
        raise ModelError(line if line.startswith(f"{spec}: ") else f"{spec}: {line}") from error
    return file._replace(family=family(spec, tuple(file.uncertain), overrides)) if file.uncertain else file


def recipe(spec: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The recipe of the model that `load(spec, overrides)` gives: just what is needed to make it again later.

    It holds a system with its parameters, or `module:attribute` with parameters. Raises `ModelError` as `load` does.
    """
    load(spec, overrides)
    content = document(spec, overrides)
    kept = {"parameters": content.get("parameters", {})}
    named = content.get("system", spec)
    return {"attribute" if ":" in named else "system": named, **kept}
