"""Graphs of an observer that is exported, and which of its numbers may be changed in the code."""

import os
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from covariant import models
from covariant._names import unknown
from covariant.codegen import Program, Recipe, of_family, program, with_open_numbers
from covariant.models import Family, ModelFile, Overrides
from covariant.observers import AbstractObserver
from scalargraph import LoweringError
from scalargraph.errors import InputError

GEOMETRY = ("*rotation", "*place", "*turn", "*slide", "coordinates", "motors", "joints", "base*")
"""Arrays of a robot that say how it is put together: as constants they save nine tenths of the work."""
STORED = ("low", "high", "spacing", "factors")
"""Arrays of a metric on a grid, a table that the code looks up."""


def exported_program(
    name: str,
    observer: AbstractObserver,
    family: Family | None,
    file: ModelFile,
    parameters: Sequence[str] | None,
    real: str,
    y: np.ndarray,
    alone: bool,
) -> Program:
    """The graphs of the observer, with the numbers of the model file open or, where there are none, its arrays."""
    recipe = of_family(observer, family) if family is not None else _recipe(observer, parameters)
    # None: as many as the model has, which a log of free flight does not name.
    inputs, closed = len(file.columns.u) or None, parameters is not None and not parameters
    try:
        return program(recipe, y, inputs, real, True, alone)  # pyright: ignore[reportArgumentType]
    except LoweringError as error:
        if closed:
            raise InputError(f"{name}: no code can be written: {error}") from error
    try:
        # The function from numbers to model may be no graph of scalars while the model is: then its arrays are open.
        return program(_usual(observer), y, inputs, real, True, alone)  # pyright: ignore[reportArgumentType]
    except LoweringError as error:
        remedy = "" if "table" in str(error) else "; try without numbers that may be changed (`parameters=[]`)"
        raise InputError(f"{name}: no code can be written: {error}{remedy}") from error


def open_family(model: object, overrides: Overrides, parameters: Sequence[str] | None) -> Family | None:
    """The model with the numbers of its file open, or None where it has none or they stay as they are."""
    if not isinstance(model, str | os.PathLike):
        return None
    name = models.spec_name(model)
    names = _open_numbers(models.recipe(name, overrides).get("parameters", {}))
    if not names or (parameters is not None and not parameters):
        return None
    return models.family(name, names if parameters is None else tuple(parameters), overrides)


def _recipe(observer: AbstractObserver, parameters: Sequence[str] | None) -> Recipe:
    """The observer with its arrays open, as far as they are named or, by default, no geometry of a robot."""
    if parameters is None:
        return _usual(observer)
    if not parameters:
        return with_open_numbers(observer, ("*",))
    everything = with_open_numbers(observer)
    for pattern in parameters:
        if not any(fnmatchcase(name, pattern) for name in everything.numbers):
            raise InputError(f"parameters: {unknown('number', pattern, tuple(everything.numbers))}")
    closed = [n for n in everything.numbers if not any(fnmatchcase(n, pattern) for pattern in parameters)]
    return with_open_numbers(observer, closed)


def _usual(observer: AbstractObserver) -> Recipe:
    """The recipe that is open but for the geometry of a robot, and arrays of zeros, which cost nothing if closed."""
    zeros = [name for name, value in with_open_numbers(observer).numbers.items() if not np.any(value)]
    return with_open_numbers(observer, (*GEOMETRY, *STORED, *zeros))


def _open_numbers(parameters: dict[str, Any]) -> tuple[str, ...]:
    """Names of the numbers of a model file that are not zero: a first value of zero cannot be told from none."""

    def places(name: str, value: object):
        if isinstance(value, bool) or not isinstance(value, int | float | list):
            return
        if isinstance(value, list):
            for k, inner in enumerate(value):
                yield from places(f"{name}[{k}]", inner)
        elif value != 0:
            yield name

    return tuple(place for key, value in parameters.items() for place in places(key, value))
