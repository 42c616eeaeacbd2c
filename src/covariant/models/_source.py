"""Finds a model: a system of this library by its name, or an attribute of a module."""

import contextlib
import functools
import importlib
import inspect
import os
import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter as Argument
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import jax
import numpy as np

from covariant._typing import Number
from covariant.models._mechanical import MechanicalSystem
from covariant.models._state_space import StateSpace, state_space
from covariant.models._systems import SYSTEMS
from covariant.models._toml import refuse_unknown

Model = MechanicalSystem | StateSpace
"""The kinds of models, `MechanicalSystem` and `StateSpace`."""


CRAFT = ("cybership", "odin", "supply_vessel")
"""Systems whose functions make a craft, which is a model file's system in state-space form."""


def _states_of(factory: Callable[..., Any]) -> Callable[..., StateSpace]:
    """A function that makes a craft, as one that makes its state-space model with the same parameters."""

    @functools.wraps(factory)
    def made(*arguments: Any, **parameters: Any) -> StateSpace:
        return state_space(factory(*arguments, **parameters))

    return made


def system(name: Any) -> Callable[..., Model]:
    """The function that makes a system; for an unknown name raises `ValueError` that suggests the nearest one."""
    if not isinstance(name, str):
        raise ValueError(f'system must be a name, as in system = "oscillator"; got {name!r}')
    refuse_unknown("system", name, SYSTEMS)
    return _function(name)


@functools.cache  # one function for each name, so that compiled programs are found again
def _function(name: str) -> Callable[..., Model]:
    module, _, attribute = SYSTEMS[name].partition(":")
    factory = getattr(importlib.import_module(f"covariant.models.{module}"), attribute)
    return _states_of(factory) if name in CRAFT else factory


def attribute(spec: str, folder: Path | None = None) -> Any:
    """The object that `module:attribute` names; the current folder, or the given one, is searched too.

    Raises `ValueError` where there is none.
    """
    where, _, name = spec.partition(":")
    beside = os.getcwd() if folder is None else str(folder.resolve())
    if ("" not in sys.path or folder is not None) and beside not in sys.path:
        sys.path.insert(0, beside)  # as `python -m` does; it stays, since the module may import others later
    if folder is not None:
        _prefer(where, Path(beside))
    try:
        module = importlib.import_module(where)
    except Exception as error:  # a module may fail in any way while it is imported
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise ValueError(f"module {where!r} cannot be imported: {reason}") from error
    if name not in vars(module):
        refuse_unknown(f"attribute of module {where!r}", name, [key for key in vars(module) if key[0] != "_"])
    return vars(module)[name]


_imported: dict[str, tuple[Path, int]] = {}
"""The file of each module beside a model file, and the time [ns] at which it had last been changed."""


def _prefer(where: str, folder: Path) -> None:
    """Let the module of a folder be imported as it is now, not as it was, nor one of its name from another folder."""
    own, known = folder / f"{where}.py", sys.modules.get(where)
    if not own.exists():
        return
    as_it_is = own.resolve(), own.stat().st_mtime_ns
    found = Path(getattr(known, "__file__", None) or "").resolve(), as_it_is[1]
    if known is not None and _imported.get(where, found) != as_it_is:
        del sys.modules[where]
        sys.path.remove(str(folder))
        sys.path.insert(0, str(folder))
        importlib.invalidate_caches()
    _imported[where] = as_it_is


def typed(name: str, factory: Callable[..., Any], parameters: dict[str, Any]) -> dict[str, Any]:
    """Parameters converted to the types that the function declares: an int serves as a `float`, a bool does not.

    Numbers of arrays, such as those being fitted, and parameters that the function does not take are left as they are.
    Raises `ValueError` for one of another type.
    """
    declared, found = inspect.signature(factory).parameters, dict(parameters)
    for key in found.keys() & declared.keys():
        kind = declared[key].annotation
        try:
            found[key] = _typed(found[key], kind)
        except TypeError as error:
            open_too = inspect.formatannotation(Number)  # a number may be open, but not one from a file
            wanted = inspect.formatannotation(kind).replace(open_too, "float").replace("collections.abc.", "")
            given = reprlib.repr(found[key])
            raise ValueError(f"parameter {key} of {name} must be {wanted}; got {given}") from error
    return found


def _typed(value: Any, declared: Any) -> Any:
    choices = get_args(declared)
    if isinstance(value, jax.Array | np.floating):
        return value
    if get_origin(declared) in (Union, UnionType):
        for choice in choices:
            with contextlib.suppress(TypeError):
                return _typed(value, choice)
    elif get_origin(declared) is Mapping and isinstance(value, dict):
        return {_typed(key, choices[0]): _typed(entry, choices[1]) for key, entry in value.items()}
    elif get_origin(declared) is Sequence and isinstance(value, list | tuple):
        return [_typed(entry, choices[0]) for entry in value]
    elif type(value) is declared or (type(value), declared) == (int, float):
        return declared(value)
    raise TypeError


def call(name: str, factory: Callable[..., Any], parameters: dict[str, Any]) -> Any:
    """The result of a function; raises `ValueError` naming a parameter it does not take, lacks or refuses."""
    accepted = inspect.signature(factory).parameters
    for given in parameters:
        refuse_unknown(f"parameter of {name}", given, accepted)
    for key, argument in accepted.items():
        optional = argument.kind in (Argument.VAR_POSITIONAL, Argument.VAR_KEYWORD)
        if key not in parameters and argument.default is argument.empty and not optional:
            raise ValueError(f"{name} needs the parameter {key!r}; add it to [parameters]")
    try:
        return factory(**parameters)
    except TypeError as error:
        raise ValueError(f"a parameter of {name} is of the wrong kind: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """The first line of an error's message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
