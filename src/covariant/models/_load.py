"""Loads models: from files, from modules, or by name."""

from os import PathLike, fspath
from typing import Any

from covariant.models import _source, _toml
from covariant.models._family import family
from covariant.models._file import ModelError, ModelFile, document, finish, finish_object
from covariant.models._source import Model
from covariant.models._toml import Overrides


def load(spec: str | PathLike[str] | Model | ModelFile, overrides: Overrides = ()) -> ModelFile:
    """Load a model.

    Args:
        spec: A `.toml` file; the `.urdf` or `.xml` file of a robot, or the name of one that comes with the library (see
            `models.robots.load`); `module:attribute` (a `Lagrangian`, a `GroupSystem`, a `StateSpace`, a `ModelFile`,
            or a function that makes one; the module is also looked for in the current folder); the name of a system
            with its default parameters; or a system or a `ModelFile` itself.
        overrides: Applied last. Each is `table.key=value`, with the tables of the file and values as in TOML, such as
            `parameters.mass=[1.0, 2.0]`; or all are a mapping, such as `{"parameters.mass": [1.0, 2.0]}`.

    Returns:
        The model with the columns of its logs and its numbers.

    Raises:
        ModelError: One line that names the spec and the first thing wrong.

    Example:
        >>> from covariant import models
        >>> models.load("oscillator", {"measurement.std": 1e-3}).measurement_std
        0.001
    """
    given = isinstance(spec, Model | ModelFile)
    name = spec_name(spec)
    try:
        if given:
            content = _toml.override({}, overrides)
            _toml.check_layout(content)
            return finish_object(spec, content)
        if not isinstance(spec, str | PathLike):
            raise ValueError("a model is a file, a name, module:attribute, a system or a ModelFile")
        file = finish(name, document(name, overrides))
    except ValueError as error:
        line = _source.first_line(error)  # of a robot's file it names the path already
        raise ModelError(line if line.startswith(f"{name}: ") else f"{name}: {line}") from error
    return file._replace(family=family(name, tuple(file.uncertain), overrides)) if file.uncertain else file


def spec_name(spec: Any) -> str:
    """What messages and titles call a model: its path or name, or the kind of a system that has none."""
    if isinstance(spec, str | PathLike):
        return str(fspath(spec))
    return spec.name if isinstance(spec, ModelFile) else type(spec).__name__


def recipe(spec: str, overrides: Overrides = ()) -> dict[str, Any]:
    """The recipe of the model that `load(spec, overrides)` gives: just what is needed to make it again later.

    It holds a system with its parameters, or `module:attribute` with parameters. Raises `ModelError` as `load` does.
    """
    load(spec, overrides)
    content = document(spec, overrides)
    kept = {"parameters": content.get("parameters", {})}
    named = content.get("system", spec)
    return {"attribute" if ":" in named else "system": named, **kept}
