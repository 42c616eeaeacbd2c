"""Loads models from files, from modules, or by name."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from os import PathLike, fspath
from typing import Any

from covariant.models.files import _toml
from covariant.models.files._family import family
from covariant.models.files._file import document, finish, finish_object, from_recipe, parameters_of
from covariant.models.files._model_file import ModelFile, named
from covariant.models.files._source import Model
from covariant.models.files._toml import Overrides
from scalargraph.errors import InputError

_KEPT: ContextVar[dict[tuple[str, str], ModelFile] | None] = ContextVar("models that are loaded once", default=None)

MOST_KEPT = 8
"""Largest number of models in a cache, since a caller may try other numbers on each log."""


@contextlib.contextmanager
def loaded_once(kept: dict[tuple[str, str], ModelFile]) -> Iterator[None]:
    """Context in which models in `kept` are not loaded again, so that their compiled programs are reused.

    Use it to load one model for each of many logs, while its files do not change.

    Args:
        kept: Models loaded in such a context before; the first few further models are added.

    Example:
        >>> from covariant import models
        >>> with models.loaded_once({}):
        ...     models.load("oscillator") is models.load("oscillator")
        True
    """
    token = _KEPT.set(kept)
    try:
        yield
    finally:
        _KEPT.reset(token)


def load(spec: str | PathLike[str] | Model | ModelFile, overrides: Overrides = ()) -> ModelFile:
    """Load a model: the system, the columns of its logs, and the numbers from which a design starts.

    Use it to work with the system in Python, as `load(spec).model`. The verbs, such as `estimate`, accept the same
    specifications and call it themselves. Loading `module:attribute` runs the code of that module, so load only code
    that you trust. Use `models.robots.load` for a robot with further options, and `family` to fit numbers.

    Args:
        spec: A `.toml` file; the `.urdf` or `.xml` file of a robot, or the name of one that comes with the library (see
            `models.robots.load`); `module:attribute` (a `Lagrangian`, a `GroupSystem`, a `StateSpace`, a `ModelFile`,
            or a function that returns one; the current folder is searched for the module too); the name of a system,
            with its default parameters; or a system or a `ModelFile` itself.
        overrides: Applied last. Each is `table.key=value`, with the tables of the file and values as in TOML, such as
            `parameters.mass=[1.0, 2.0]`; or all are a mapping, such as `{"parameters.mass": [1.0, 2.0]}`.

    Returns:
        The model with the columns of its logs and its numbers.

    Raises:
        ModelError: One line that names the spec and the first fault.

    Example:
        >>> from covariant import models
        >>> models.load("oscillator", {"measurement.std": 1e-3}).measurement_std
        0.001
    """
    is_object = isinstance(spec, Model | ModelFile)
    name = spec_name(spec)
    with named(name):
        if is_object:
            content = _toml.override({}, overrides)
            _toml.check_layout(content)
            return finish_object(spec, content)
        if not isinstance(spec, str | PathLike):
            raise InputError("a model is a file, a name, module:attribute, a system or a ModelFile")
        kept = _KEPT.get()
        key = name, repr(overrides)
        if kept is not None and key in kept:
            return kept[key]
        file = finish(name, document(name, overrides))
    if file.uncertain:
        file.need_mechanical(name, "uncertain parameters are those of")
        file = file._replace(family=family(name, tuple(file.uncertain), overrides))
    if kept is not None and len(kept) < MOST_KEPT:
        kept[key] = file
    return file


def spec_name(spec: object) -> str:
    """Name of a model in messages and titles.

    Args:
        spec: As for `load`.

    Returns:
        Its path or name, or the type of a system without a name.

    Example:
        >>> from covariant import models
        >>> models.spec_name(models.oscillator())
        'Lagrangian'
    """
    if isinstance(spec, str | PathLike):
        return str(fspath(spec))
    return spec.name if isinstance(spec, ModelFile) else type(spec).__name__


class _Loaded(dict[str, Any]):
    """A recipe whose code has been run in this process, unlike a recipe read from a file."""


def recipe(spec: str, overrides: Overrides = ()) -> dict[str, Any]:
    """Recipe of the model that `load(spec, overrides)` returns: the data needed to build it again.

    Args:
        spec: A path, the name of a system, or `module:attribute`.
        overrides: As for `load`.

    Returns:
        `system` or `attribute`, and `parameters`, for `from_recipe`.

    Raises:
        ModelError: As for `load`.

    Example:
        >>> from covariant import models
        >>> models.recipe("oscillator", {"parameters.stiffness": 2.0})
        {'system': 'oscillator', 'parameters': {'stiffness': 2.0}}
    """
    load(spec, overrides)
    content = document(spec, overrides)
    parameters = {"parameters": parameters_of(content)}
    system = content.get("system", spec)
    return _Loaded({"attribute" if ":" in system else "system": system, **parameters})


def rebuild(made: dict[str, Any]) -> Model | None:
    """Build the model of a recipe again, to compare it with another.

    Args:
        made: The recipe.

    Returns:
        The model; None if the recipe names code and was not returned by `recipe`, which has run that code in this
        process.

    Raises:
        ModelError: As for `from_recipe`.

    Example:
        >>> from covariant import models
        >>> models.rebuild(models.recipe("oscillator")).coordinates
        ('q',)
        >>> print(models.rebuild({"attribute": "os:system", "parameters": {"command": "exit 1"}}))
        None
    """
    if "attribute" in made and not isinstance(made, _Loaded):
        return None
    return from_recipe(made, made.get("attribute"))
