"""The observer that `export` writes."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from covariant.codegen import Signals
from covariant.models import ModelFile
from covariant.observers import AbstractObserver, Gated
from covariant.workflow._inputs import coordinates, numbered, sought_columns, sought_units
from covariant.workflow._outcome import force_units
from covariant.workflow._sensors import FileSensor

UNGATED = "It has no gate and refuses no measurement, as asked."


class Exported(NamedTuple):
    """Observer to write as code.

    Attributes:
        name: Name of the observer.
        observer: The observer, behind its gate.
        design: A sentence on its numbers.
        measured: Measurements (ROWS + 1, *n) for the self-test.
        gate: Sentences on its gate, or why there is none.
        warning: That the speed in the gate is assumed, and what to do; may be empty.
    """

    name: str
    observer: AbstractObserver
    design: str
    measured: np.ndarray
    gate: str
    warning: str = ""

    @property
    def inner(self) -> Any:
        """The observer behind the gate, which has the gains and of which a certificate is."""
        return self.observer.observer if isinstance(self.observer, Gated) else self.observer

    def with_inner(self, inner: AbstractObserver) -> AbstractObserver:
        """The observer, behind its gate, with another one in place of `inner`."""
        return dataclasses.replace(self.observer, observer=inner) if isinstance(self.observer, Gated) else inner


def signals(file: ModelFile, parts: tuple[FileSensor, ...], inputs: int) -> Signals:
    """Names and SI units of the numbers that go into an exported observer, and come out of it.

    Args:
        file: The model file.
        parts: Its sensors that the observer uses.
        inputs: Number of inputs.
    """
    u = file.columns.u if len(file.columns.u) == inputs else numbered("u", inputs)
    if not file.mechanical:
        states = _named(sought_columns(file), sought_units(file))
        return Signals(file.columns.q, u, (("x", states),))
    n = file.dimension
    # A system of this library with as many inputs as velocities takes generalised forces.
    forces = force_units(file) if file.system and inputs == n else ("",) * inputs
    v = _named(sought_columns(file), sought_units(file))
    if not file.model.manifold.commuting:
        whole = ("the configuration, its matrices by rows; rotations have no unit, positions are in m, angles in rad",)
        return Signals(whole, _named(u, forces), (("v", v),))
    names, units = coordinates(file)
    q = _named(file.columns.q if len(file.columns.q) == n else names, units)
    read = tuple(name for part in parts for name in part.signals)
    return Signals(q + read, _named(u, forces), (("q", q), ("v", v)))


def _named(names: tuple[str, ...], units: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True))
