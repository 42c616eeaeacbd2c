"""Finds the source of a model: a system of this library by name, or an attribute of a module."""

import contextlib
import functools
import importlib
import inspect
import os
import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import PathFinder
from importlib.metadata import entry_points
from inspect import Parameter as Argument
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import jax
import numpy as np

from covariant._door import MOST_COORDINATES
from covariant._names import refuse_unknown
from covariant._typing import Number
from covariant.models._mechanical import MechanicalSystem
from covariant.models._state_space import StateSpace, state_space
from covariant.models.files._systems import SYSTEMS
from scalargraph.errors import InputError

Model = MechanicalSystem | StateSpace
"""The kinds of models, `MechanicalSystem` and `StateSpace`."""


CRAFT = ("cybership", "odin", "supply_vessel")
"""Systems whose functions return a craft; a model file uses their state-space form."""


def _states_of(factory: Callable[..., Any]) -> Callable[..., StateSpace]:
    """Wrap a function that returns a craft: the result returns its state-space model, with the same parameters."""

    @functools.wraps(factory)
    def build(*arguments: Any, **parameters: Any) -> StateSpace:
        return state_space(factory(*arguments, **parameters))

    return build


def system(name: object) -> Callable[..., Model]:
    """The function that builds a system of this library; the same object each time."""
    if not isinstance(name, str):
        raise InputError(f'system must be a name, as in system = "oscillator"; got {name!r}')
    refuse_unknown("system", name, SYSTEMS)
    return _function(name)


@functools.cache  # compiled programs are cached by the function object, so it must stay the same
def _function(name: str) -> Callable[..., Model]:
    module, _, attribute = SYSTEMS[name].partition(":")
    factory = getattr(importlib.import_module(f"covariant.models.{module}"), attribute)
    return _states_of(factory) if name in CRAFT else factory


def attribute(spec: str, folder: Path | None = None) -> Any:
    """Import the object that `module:attribute` names.

    If a file names it, `folder` is the file's folder; the module must then be in that folder, or be declared by the
    entry point of a package. Otherwise a user typed the name, and any module is allowed, also in the current folder.
    """
    where, _, name = spec.partition(":")
    if folder is not None and not _lies_in(where, folder):
        if not _declared(spec):
            raise InputError(
                f"module {where!r} is not in the folder of the file that names it, and no installed package declares "
                f"it by an entry point of {ENTRY_POINTS!r}; put it there, under a name that no other module has"
            )
        folder = None
    beside = os.getcwd() if folder is None else str(folder.resolve())
    if ("" not in sys.path or folder is not None) and beside not in sys.path:
        sys.path.insert(0, beside)  # as `python -m` does; it stays, since the module may import others later
    if folder is not None:
        _prefer(where, Path(beside))
    try:
        module = importlib.import_module(where)
    except Exception as error:  # importing a module may raise any exception
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise InputError(f"module {where!r} cannot be imported: {reason}") from error
    if name not in vars(module):
        refuse_unknown(f"attribute of module {where!r}", name, [key for key in vars(module) if key[0] != "_"])
    return vars(module)[name]


ENTRY_POINTS = "covariant.models"
"""Group of entry points by which an installed package declares models: `module:attribute`, or a module for all in it.
"""


def _declared(spec: str) -> bool:
    """Whether an installed package declares a `module:attribute` as a model."""
    return any(each.value in (spec, spec.partition(":")[0]) for each in entry_points(group=ENTRY_POINTS))


def _lies_in(where: str, folder: Path) -> bool:
    """Whether a module is in a folder, and no other code would be imported under its name."""
    top = where.partition(".")[0]
    found = PathFinder.find_spec(top, [str(folder.resolve())]) if top.isidentifier() else None
    # A folder without `__init__.py`, or a standard-library name, could denote installed code that is loaded already.
    if found is None or found.origin is None or top in sys.stdlib_module_names:
        return False
    loaded = getattr(sys.modules.get(top), "__file__", None)
    return loaded is None or not found.submodule_search_locations or Path(loaded).resolve() == Path(found.origin)


_imported: dict[str, tuple[Path, int]] = {}
"""File of each module imported from the folder of a model file, with its modification time [ns]."""


def _prefer(where: str, folder: Path) -> None:
    """Make Python import a module anew from a folder, if its file has changed or another folder has the same name."""
    file, module = folder / f"{where}.py", sys.modules.get(where)
    if not file.exists():
        return
    current = file.resolve(), file.stat().st_mtime_ns
    loaded = Path(getattr(module, "__file__", None) or "").resolve(), current[1]
    if module is not None and _imported.get(where, loaded) != current:
        del sys.modules[where]
        sys.path.remove(str(folder))
        sys.path.insert(0, str(folder))
        importlib.invalidate_caches()
    _imported[where] = current


def typed(name: str, factory: Callable[..., Any], parameters: dict[str, Any]) -> dict[str, Any]:
    """Convert parameters to the types that a function declares: an int is accepted for a `float`, a bool is not.

    Numbers in arrays, such as open ones, and parameters that the function does not have are not converted.
    """
    declared, converted = inspect.signature(factory).parameters, dict(parameters)
    for key, value in parameters.items():
        if isinstance(value, list) and len(value) > MOST_COORDINATES:
            raise InputError(f"parameter {key} of {name} lists {len(value)} numbers; {MOST_COORDINATES} are the most")
    for key in converted.keys() & declared.keys():
        kind = declared[key].annotation
        try:
            converted[key] = _convert_to_type(converted[key], kind)
        except TypeError as error:
            open_too = inspect.formatannotation(Number)  # accepts open (traced) numbers, which a file cannot contain
            expected = inspect.formatannotation(kind).replace(open_too, "float").replace("collections.abc.", "")
            shown = reprlib.repr(converted[key])
            raise InputError(f"parameter {key} of {name} must be {expected}; got {shown}") from error
    return converted


def _convert_to_type(value: object, declared: Any) -> Any:
    choices = get_args(declared)
    if isinstance(value, jax.Array | np.floating):  # possibly traced: its value cannot be converted
        return value
    if declared is Any:  # the function itself checks it
        return value
    if get_origin(declared) in (Union, UnionType):
        for choice in choices:
            with contextlib.suppress(TypeError):
                return _convert_to_type(value, choice)
    elif get_origin(declared) is Mapping and isinstance(value, dict):
        return {_convert_to_type(key, choices[0]): _convert_to_type(entry, choices[1]) for key, entry in value.items()}
    elif get_origin(declared) is Sequence and isinstance(value, list | tuple):
        return [_convert_to_type(entry, choices[0]) for entry in value]
    # `type` instead of `isinstance`, since True is an int in Python.
    elif type(value) is declared or (type(value), declared) == (int, float):
        return declared(value)
    raise TypeError


def call(name: str, factory: Callable[..., Any], parameters: dict[str, Any]) -> Any:
    """Call a function that builds a model; raises `ValueError` if a parameter is missing or refused."""
    accepted = inspect.signature(factory).parameters
    for parameter in parameters:
        refuse_unknown(f"parameter of {name}", parameter, accepted)
    for key, argument in accepted.items():
        optional = argument.kind in (Argument.VAR_POSITIONAL, Argument.VAR_KEYWORD)
        if key not in parameters and argument.default is argument.empty and not optional:
            raise InputError(f"{name} needs the parameter {key!r}; add it to [parameters]")
    try:
        return factory(**parameters)
    except TypeError as error:
        raise InputError(f"a parameter of {name} is of the wrong kind: {first_line(error)}") from error
    except ValueError as error:  # a user's function refuses parameters by it, this library's by `InputError`
        if isinstance(error, InputError) or getattr(factory, "__module__", "").startswith("covariant."):
            raise
        raise InputError(f"{name} refuses its parameters: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """First line of an error's message, or the name of its type if it has no message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
