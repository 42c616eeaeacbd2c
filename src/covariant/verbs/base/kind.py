"""What a verb asks of a model by its kind: the protocol, and names with units.

A verb asks `kind_of(file)`, in `_kinds.py`, for names, units and columns of the estimates, for the reference that they
are scored against, for observers and their noise, and for measurements of a self-test. It never asks which kind it is.
"""

import abc
import re
from collections.abc import Callable, Collection, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from covariant import logs, simulation
from covariant.calibration import DataSheet, Trial
from covariant.codegen import Signals
from covariant.models import ModelFile
from covariant.observers import AbstractObserver
from covariant.simulation import PositionSensor
from covariant.verbs.base.arguments import Amounts


def numbered(letter: str, count: int) -> tuple[str, ...]:
    """Names from a letter and a number that counts from 1, such as "q1", "q2"."""
    return tuple(f"{letter}{i + 1}" for i in range(count))


def rate_name(coordinate: str) -> str:
    """Name of the rate of a coordinate: v1 of q1, and elbow_dot of elbow."""
    return re.sub("^q", "v", coordinate) if re.fullmatch(r"q\d*", coordinate) else f"{coordinate}_dot"


class Labels(NamedTuple):
    """Names of numbers, and a unit of each, "" where it has none; no units at all where they are not known."""

    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def table(self) -> dict[str, str]:
        """The known units by name."""
        return dict(zip(self.names, self.units, strict=False))

    def called(self, form: str) -> "Labels":
        """Labels of the same units whose names have a form, such as "RMSE {}"."""
        return Labels(tuple(form.format(name) for name in self.names), self.units)

    def cells(self, values: Sequence[float] | np.ndarray) -> dict[str, float]:
        """Cells of a row of a table, by heading."""
        return dict(zip(self.headings, map(float, values), strict=True))

    @property
    def headings(self) -> tuple[str, ...]:
        """The names as headings, such as "v1 [m/s]"."""
        return tuple(f"{name} [{self.table[name]}]" if self.table.get(name) else name for name in self.names)


class AbstractKind(abc.ABC):
    """A model file as the verbs see it.

    Attributes:
        file: The model file.
        what: What is estimated.
        title: The same, as the first word of a title.
        draws_innovations: Whether the panels of a page are also those of the innovations.
        makes_up_for_delays: Whether readings that are late are made up for.
        has_ticks: Whether its positions can be ticks of encoders.
        without_gate: Why an observer of it has no gate, where it has none.
        gates: A sentence on the gates of all observers that are compared.
    """

    what: Literal["velocity", "state"]
    title: str
    draws_innovations = True
    makes_up_for_delays = True
    has_ticks = True
    without_gate: str
    gates = ""

    def __init__(self, file: ModelFile):
        self.file = file
        self.model: Any = file.model

    @property
    def estimates(self) -> Labels:
        """Names and units of the estimates: velocities, after the coordinates where the model names none, or states."""
        names, units, n = self.model.sought.names, self.model.sought.units, self.file.dimension
        return Labels(names or tuple(map(rate_name, self.axes.names)), units or ("1/s",) * n)

    @property
    def axes(self) -> Labels:
        """Names and units for headings: of coordinates; on a group of velocities; of states."""
        if self.model.sought.names:
            return Labels(self.model.sought.names, self.model.sought.units)
        names = self.model.coordinates or numbered("q", self.file.dimension)
        return Labels(names, self.model.units or ("",) * len(names))

    @property
    def force_units(self) -> tuple[str, ...]:
        """Units of generalised forces along the velocities, whose product with them is a power; "" where not known."""
        per_second = {"rad/s": "N m", "m/s": "N"}
        return tuple(per_second.get(unit, "") for unit in self.estimates.units)

    @property
    def positions(self) -> Labels:
        """Names and units of the estimated coordinates; none where the estimates are no coordinates and velocities."""
        return Labels((), ())

    @property
    def message_columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of positions and velocities in messages of ROS."""
        return self.positions.names, self.estimates.names

    @property
    @abc.abstractmethod
    def measured(self) -> Labels:
        """Names of the components of a measurement and of its innovation, and their units, "" where not known."""

    def check(self, y: np.ndarray) -> None:  # noqa: B027  most kinds have nothing to check
        """Check the model at measurements (T, *n); raises `ValueError` where it makes no sense there."""

    def with_inputs(self, log: logs.Log) -> logs.Log:
        """The log with the inputs of the model."""
        return log

    @abc.abstractmethod
    def slopes(self, log: logs.Log) -> tuple[np.ndarray, str] | None:
        """Velocities (T, n) in a log by the slopes of positions of the whole log, and a label; None for states."""

    def without_outliers(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Measurements (T, *n), NaN where they are outliers of coordinates."""
        return y

    def complete(self, y: np.ndarray) -> np.ndarray:
        """Measurements (T, *n) with the positions that no sensor measures, as far as the others determine them."""
        return y

    def dead_centre(self, y: np.ndarray, whole: np.ndarray) -> int | None:
        """The first row of completed positions (T, n) at which the measured y (T, n) hardly tell the others, if any."""
        return None

    def drawn(self, y: np.ndarray) -> np.ndarray | None:
        """Measurements (T, n) to draw beside the estimates; None where these are other quantities."""
        return None

    @abc.abstractmethod
    def configuration(self, x: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Columns of the estimated configuration, which are called as in the log on a group."""

    @abc.abstractmethod
    def tuned(
        self, sheet: Callable[[], DataSheet], rate: float, names: Collection[str], trial: Trial | None = None
    ) -> dict[str, AbstractObserver]:
        """Observers of these names that fit the model, tuned to the noise that the model file tells."""

    @abc.abstractmethod
    def note(self, sheet: Callable[[], DataSheet], rate: float, name: str | None = None) -> str:
        """A sentence on what an observer, or every one of them, is designed from."""

    def unused(self, observer: AbstractObserver, name: str, sensors: bool) -> str:
        """Sentences on what the model file asks for and an observer does not do; a log may have sensors."""
        return ""

    @abc.abstractmethod
    def self_test(self, rate: float, sheet: Callable[[], DataSheet] | None) -> np.ndarray:
        """Measurements (ROWS + 1, *n) for the self-test; with a sheet, one that a gate has to refuse."""

    @abc.abstractmethod
    def signals(self, inputs: int, sensors: tuple[str, ...]) -> Signals:
        """Names and SI units of the numbers that go into an exported observer, and come out of it."""

    @abc.abstractmethod
    def start(self, q0: Amounts | None, v0: Amounts | None) -> Any:
        """The initial state of a simulation."""

    @property
    @abc.abstractmethod
    def first_motion(self) -> tuple[str, list[float]]:
        """The argument of `start`, and its value, of a log that shows a motion."""

    def sense(self, sensor: PositionSensor, y: np.ndarray, seed: int) -> np.ndarray:
        """Measurements of true outputs or configurations (T, *n)."""
        return simulation.sense(sensor, y, seed)

    @abc.abstractmethod
    def truth(self, layout: logs.Columns, y: np.ndarray, x: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Columns of the true configuration, and of the true velocities or states."""
