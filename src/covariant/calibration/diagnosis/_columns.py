"""Suspicions about the columns of a log: their units, order, signs and zeros."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import quoted_list
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.signals import Record

CLOCKS = {
    "seconds": 1.0,
    **{"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9},
    # Such stamps were multiplied by the size of the unit when they were read; these factors undo it.
    **{f"seconds that were taken for {name}": 1 / size for name, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))},
}
"""Possible units of the stamps, each with the factor that converts stamps as read to seconds."""
SHORTEST, LONGEST = 1e-5, 2.0
"""Plausible steps in time [s] of a log of a machine."""
ANGLES = {"radians": 1.0, "degrees": np.pi / 180, "turns": 2 * np.pi}
COUNTS = (*(2**k for k in range(10, 21)), *(factor * 1000 for factor in (1, 2, 4, 5, 10, 20, 36, 40)))
"""Usual counts per turn of encoders."""


class Change(NamedTuple):
    """A correction of columns.

    New positions are `position * y[:, order] + offset`, new inputs `inputs * u[:, input_order]`, new stamps `time * t`.

    Attributes:
        position: Factors (n,) of the positions.
        order: Column (n,) of each new position.
        offset: Offsets (n,) of the positions, after the factors.
        inputs: Factors (m,) of the inputs.
        input_order: Column (m,) of each new input.
        time: Factor of the stamps.
    """

    position: np.ndarray
    order: np.ndarray
    offset: np.ndarray
    inputs: np.ndarray
    input_order: np.ndarray
    time: float = 1.0

    @classmethod
    def none(cls, n: int, m: int) -> "Change":
        """The change that leaves n positions and m inputs as they are."""
        return cls(np.ones(n), np.arange(n), np.zeros(n), np.ones(m), np.arange(m))

    def apply(self, case: Case) -> Case:
        """The case with corrected columns, and with their names and units."""
        t, u, y = (np.asarray(array) for array in case.record[:3])
        y, u = y[:, self.order] * self.position + self.offset, u[:, self.input_order] * self.inputs
        names = case.names.after(
            {"t": [0], "q": self.order.tolist(), "u": self.input_order.tolist()},
            {"t": np.array([self.time]), "q": self.position, "u": self.inputs},
        )
        ticks = np.abs(self.position) * case.ticks[self.order]
        return case._replace(record=Record(t * self.time, u, y), names=names, ticks=ticks)


def units(case: Case) -> Iterator[Suspicion]:
    """Stamps that are not in seconds, angles that are not in radians, or both."""
    names, no_change = case.names, _no_change(case)
    step = float(np.median(np.diff(np.asarray(case.record.t))))
    # A unit that makes the step in time implausible is not tried: it could match by chance, and costs a smoothing.
    clocks = {clock: factor for clock, factor in CLOCKS.items() if SHORTEST <= factor * step <= LONGEST or factor == 1}
    angles = dict(ANGLES) if names.angles.any() else {"radians": 1.0}
    y = np.asarray(case.record.y)[:, names.angles]
    # Whole numbers beyond 2π are no angles in radians, but may be encoder counts.
    if names.angles.any() and np.all(y[np.isfinite(y)] % 1 == 0) and np.nanmax(np.abs(y)) > 2 * np.pi:
        angles |= {f"counts of {count} a turn": 2 * np.pi / count for count in COUNTS}
    for (clock, time), (angle, size) in itertools.product(clocks.items(), angles.items()):
        position = np.where(names.angles, size, 1.0)
        parts = []
        if time != 1:
            parts.append(("time", clock, names.line("t", [time])))
        if size != 1:
            parts.append(("positions", angle, names.line("q", position)))
        if parts:
            affected, described, lines = zip(*parts, strict=True)
            words = f"with {' and '.join(described)}"
            change = no_change._replace(time=time, position=position)
            yield Suspicion(f"unit of {' and '.join(affected)}", "", words, "; ".join(lines), change.apply)


def input_signs(case: Case) -> Iterator[Suspicion]:
    """Inputs with the other sign."""
    for name, factors in _one_by_one(case.names.u, -1.0):
        change, line = _no_change(case)._replace(inputs=factors), case.names.line("u", factors)
        yield Suspicion("sign of an input", name, f"with {name} with the other sign", line, change.apply)


def swaps(case: Case) -> Iterator[Suspicion]:
    """Swapped columns: two positions, two inputs, or both of two joints."""
    (q, u), no_change = (case.names.q, case.names.u), _no_change(case)
    for i, j in itertools.combinations(range(len(q)), 2):
        positions, inputs = (_swapped(columns, i, j) for columns in (q, u))
        in_q = f"q = {quoted_list(q[k] for k in positions)}"
        words = f"with {q[i]} and {q[j]} in each other's place"
        change = no_change._replace(order=positions)
        yield Suspicion("swapped positions", f"{q[i]}, {q[j]}", words, f"[columns] {in_q}", change.apply)
        if len(q) != len(u):
            continue  # joint i has input i only where there are as many of both
        in_u = f"u = {quoted_list(u[k] for k in inputs)}"
        words = f"with {u[i]} and {u[j]} in each other's place"
        change = no_change._replace(input_order=inputs)
        yield Suspicion("swapped inputs", f"{u[i]}, {u[j]}", words, f"[columns] {in_u}", change.apply)
        words = f"with joints {i + 1} and {j + 1} in each other's place"
        change = no_change._replace(order=positions, input_order=inputs)
        yield Suspicion("swapped joints", f"{q[i]}, {q[j]}", words, f"[columns] {in_q}, {in_u}", change.apply)


def position_signs(case: Case) -> Iterator[Suspicion]:
    """Positions with the other sign."""
    for name, factors in _one_by_one(case.names.q, -1.0):
        change, line = _none(case)._replace(position=factors), case.names.line("q", factors)
        yield Suspicion("sign of a position", name, f"with {name} with the other sign", line, change.apply)


def zeros(case: Case) -> Iterator[Suspicion]:
    """Angles whose zero is half a turn off."""
    for (name, factors), angle in zip(_one_by_one(case.names.q, 0.0), case.names.angles, strict=True):
        if angle:
            line = f"add {np.pi:.9g} to {name}, or write the other zero into [parameters]"
            change = _no_change(case)._replace(offset=np.where(factors == 0, np.pi, 0.0))
            yield Suspicion("zero of a position", name, f"with {name} half a turn on", line, change.apply)


def single_degrees(case: Case) -> Iterator[Suspicion]:
    """One of several angles in degrees."""
    for (name, factors), angle in zip(_one_by_one(case.names.q, ANGLES["degrees"]), case.names.angles, strict=True):
        if angle and len(factors) > 1:
            change, line = _none(case)._replace(position=factors), case.names.line("q", factors)
            yield Suspicion("unit of positions", name, f"with {name} in degrees", line, change.apply)


COLUMNS: tuple[Callable[[Case], Iterator[Suspicion]], ...] = (
    units,
    input_signs,
    swaps,
    position_signs,
    zeros,
    single_degrees,
)
"""Suspicions about columns; of several that explain about as much, the first is reported."""


def _no_change(case: Case) -> Change:
    return Change.none(len(case.names.q), len(case.names.u))


def _one_by_one(names: tuple[str, ...], factor: float) -> Iterator[tuple[str, np.ndarray]]:
    """Each name, with an array of factors that is `factor` for this name and 1 for the others."""
    for i, name in enumerate(names):
        yield name, np.where(np.arange(len(names)) == i, factor, 1.0)


def _swapped(columns: tuple[str, ...], i: int, j: int) -> np.ndarray:
    order = np.arange(len(columns))
    if j < len(order):
        order[[i, j]] = j, i
    return order
