"""Describes the sizes and shapes of the numbers of a compiled observer, also as data for a file."""

import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from covariant.codegen import Program
from covariant.engine._sources import LIBRARY
from scalargraph.errors import InputError


class Layout(NamedTuple):
    """Sizes and shapes of the numbers of a compiled observer.

    Attributes:
        sizes: Counts of numbers in a state, an estimate and an info.
        y: Shape of a measurement.
        u: Number of inputs.
        info, estimate: Pytrees of the shapes and types of an info and an estimate.
    """

    sizes: tuple[int, int, int]
    y: tuple[int, ...]
    u: int
    info: Any
    estimate: Any

    @classmethod
    def of(cls, traced: Program) -> "Layout":
        """The layout of a traced observer."""
        state, estimate, info = (sum(leaf.size for leaf in leaves) for leaves in (traced.state, traced.x, traced.info))
        return cls((state, estimate, info), traced.y, traced.u, traced.told_as, traced.estimated_as)

    def data(self) -> list[Any] | None:
        """The layout as JSON data; None if it contains a class from outside this library."""
        try:
            return [list(self.sizes), list(self.y), self.u, _data(self.info), _data(self.estimate)]
        except InputError:
            return None

    @classmethod
    def from_data(cls, data: Any) -> "Layout":
        """The layout that `data` describes; raises `ValueError` if the data are not valid."""
        try:
            sizes, y, u, info, estimate = data
            states, estimates, infos = map(int, sizes)
            return cls((states, estimates, infos), tuple(map(int, y)), int(u), _tree(info), _tree(estimate))
        except (TypeError, AttributeError, KeyError, ValueError) as error:
            raise InputError(f"no layout: {error}") from error


def _data(tree: Any) -> Any:
    if tree is None:
        return None
    if isinstance(tree, jax.ShapeDtypeStruct):
        return {"shape": list(tree.shape), "dtype": tree.dtype.name}
    if type(tree) is not tuple and _tuples(type(tree).__module__, type(tree).__qualname__) is not type(tree):
        raise InputError(f"{type(tree)} is not a tuple of this library")
    named = () if type(tree) is tuple else (type(tree).__module__, type(tree).__qualname__)
    return {"class": list(named), "fields": list(map(_data, tree))}


def _tree(data: Any) -> Any:
    if data is None:
        return None
    if "shape" in data:
        return jax.ShapeDtypeStruct(tuple(map(int, data["shape"])), np.dtype(data["dtype"]))
    fields: Sequence[Any] = list(map(_tree, data["fields"]))
    return _tuples(*data["class"])(*fields) if data["class"] else tuple(fields)


def _tuples(module: str, name: str) -> Any:
    """A NamedTuple class from a loaded module of this library; a file cannot name any other class."""
    held = getattr(sys.modules.get(module), name, None) if module.partition(".")[0] in LIBRARY else None
    if not (isinstance(held, type) and issubclass(held, tuple) and hasattr(held, "_fields")):
        raise InputError(f"{module}.{name} is not a tuple of this library")
    return held
