"""Suspicions about the columns of a log: their units, order, signs and zeros."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Names, quoted_list
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import PLAIN_SCALE
from covariant.signals import Record

CLOCKS = {
    "seconds": 1.0,
    **{"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9},
    # Reading has multiplied such stamps by the size of the unit, which this factor undoes.
    **{f"seconds that were taken for {name}": 1 / size for name, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))},
}
"""Possible units of the stamps, and the factor that converts them, as they are read, to seconds."""
SHORTEST, LONGEST = 1e-5, 2.0
"""Plausible steps in time [s] of a log of a machine."""
ANGLES = {"radians": 1.0, "degrees": np.pi / 180, "turns": 2 * np.pi}
PREFIXES = {1e-3: "m", 1e3: "k", 1e-6: "u", 1e-2: "c", 1e6: "M"}
"""Prefixes of units of inputs, by their factors."""
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
    def none(cls, case: Case) -> "Change":
        """The change that leaves the n positions and m inputs of a case as they are."""
        n, m = len(case.names.q), len(case.names.u)
        return cls(np.ones(n), np.arange(n), np.zeros(n), np.ones(m), np.arange(m))

    def apply(self, case: Case) -> Case:
        """The case with corrected columns, and with their names and units."""
        t, u, y = (np.asarray(array) for array in case.record[:3])
        u = u[:, self.input_order] * self.inputs
        same = (self.position == 1).all() and (self.order == np.arange(len(self.order))).all() and not self.offset.any()
        # Positions that stay stay the same array, by which what is smoothed of them is found again.
        y = case.record.y if same else y[:, self.order] * self.position + self.offset
        names = case.names.after(
            {"t": [0], "q": self.order.tolist(), "u": self.input_order.tolist()},
            {"t": np.array([self.time]), "q": self.position, "u": self.inputs},
        )
        ticks = np.abs(self.position) * case.ticks[self.order]
        return case._replace(record=Record(t * self.time, u, y), names=names, ticks=ticks)


def units(case: Case) -> Iterator[Suspicion]:
    """Stamps that are not in seconds, angles that are not in radians, or both."""
    names, none = case.names, Change.none(case)
    step = float(np.median(np.diff(np.asarray(case.record.t))))
    # A clock that makes the step implausible is not tried: it could match by chance, and would cost a smoothing.
    clocks = {clock: factor for clock, factor in CLOCKS.items() if SHORTEST <= factor * step <= LONGEST or factor == 1}
    angles = dict(ANGLES) if names.angles.any() else {"radians": 1.0}
    y = np.asarray(case.record.y)[:, names.angles]
    # Whole numbers beyond a turn are not angles in radians, but may be encoder counts.
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
            change = none._replace(time=time, position=position)
            yield Suspicion(f"unit of {' and '.join(affected)}", "", words, "; ".join(lines), change.apply)


def input_units(case: Case) -> Iterator[Suspicion]:
    """Inputs, one or all of them, in a unit with another prefix."""
    names, none = case.names, Change.none(case)
    count = len(names.u)
    groups = [np.ones(count, bool)] * bool(count)
    groups += [np.arange(count) == i for i in range(count)] if count > 1 else []
    for which, factor in itertools.product(groups, PREFIXES):
        factors = np.where(which, factor, 1.0)
        where = ", ".join(name for name, one in zip(names.u, which, strict=True) if one)
        change, line = none._replace(inputs=factors), input_line(names, factors)
        words = f"with {where} {_prefixed(names, factor) or f'times {factor:g}'}"
        yield Suspicion("unit of an input", where, words, line, change.apply)


def plain_scale(scale: float, std: float) -> float | None:
    """The factor of a prefix that a fitted scale is equal to; None for an odd one."""
    near = (factor for factor in PREFIXES if abs(scale / factor - 1) < max(PLAIN_SCALE, 3 * std / factor))
    return next(near, None)


def input_line(names: Names, factors: np.ndarray) -> str:
    """Line of the model file that multiplies the inputs by factors, with a unit of a prefix where there is one."""
    units = [_prefixed(names, float(factor)) for factor in factors]
    base = "N m" if names.angles.all() else "N"
    if (None in units and any(factor != 1 for factor in factors)) or any(names.stated.get("u", ())):
        return names.line("u", factors)
    texts = [unit or base for unit in units]
    return f"[units] u = {quoted_list(texts) if len(set(texts)) > 1 else quoted_list(texts[:1])[1:-1]}"


def _prefixed(names: Names, factor: float) -> str | None:
    """Unit with a prefix of inputs that are torques, or forces; None where they may be either."""
    if names.angles.any() and not names.angles.all():
        return None
    unit = "N m" if names.angles.all() else "N"
    prefix = PREFIXES.get(factor)
    return unit if factor == 1 else None if prefix is None else f"{prefix}{unit}"


def input_signs(
    case: Case, which: Iterable[int] | None = None, what: str = "an input", threshold: str = "columns"
) -> Iterator[Suspicion]:
    """Inputs with the other sign: each of some columns, by default of all, or all together."""
    signs = list(_one_by_one(case.names.u, -1.0))
    if which is None and len(signs) > 1:
        signs.append((", ".join(case.names.u), np.full(len(signs), -1.0)))
    for name, factors in signs if which is None else [signs[j] for j in which]:
        change, line = Change.none(case)._replace(inputs=factors), case.names.line("u", factors)
        yield Suspicion(f"sign of {what}", name, f"with {name} with the other sign", line, change.apply, threshold)


def swapped_inputs(case: Case, i: int, j: int, what: str = "inputs", threshold: str = "columns") -> Suspicion:
    """Two inputs in each other's place."""
    u, order = case.names.u, _transposition(case.names.u, i, j)
    words, line = f"with {u[i]} and {u[j]} in each other's place", f"[columns] u = {quoted_list(u[k] for k in order)}"
    change = Change.none(case)._replace(input_order=order)
    return Suspicion(f"swapped {what}", f"{u[i]}, {u[j]}", words, line, change.apply, threshold)


def swaps(case: Case) -> Iterator[Suspicion]:
    """Swapped columns: two positions, two inputs, or positions and inputs of two coordinates."""
    (q, u), none = (case.names.q, case.names.u), Change.none(case)
    for i, j in itertools.combinations(range(len(q)), 2):
        positions, inputs = (_transposition(columns, i, j) for columns in (q, u))
        in_q = f"q = {quoted_list(q[k] for k in positions)}"
        words = f"with {q[i]} and {q[j]} in each other's place"
        change = none._replace(order=positions)
        yield Suspicion("swapped positions", f"{q[i]}, {q[j]}", words, f"[columns] {in_q}", change.apply)
        if len(q) != len(u):
            continue  # input i belongs to joint i only if there are as many inputs as joints
        yield swapped_inputs(case, i, j)
        line = f"[columns] {in_q}, u = {quoted_list(u[k] for k in inputs)}"
        words = f"with {q[i]} and {q[j]}, and {u[i]} and {u[j]}, in each other's place"
        change = none._replace(order=positions, input_order=inputs)
        yield Suspicion(f"swapped {case.file.vocabulary.coordinate}s", f"{q[i]}, {q[j]}", words, line, change.apply)


def position_signs(case: Case) -> Iterator[Suspicion]:
    """Positions with the other sign."""
    for name, factors in _one_by_one(case.names.q, -1.0):
        change, line = Change.none(case)._replace(position=factors), case.names.line("q", factors)
        yield Suspicion("sign of a position", name, f"with {name} with the other sign", line, change.apply)


def zeros(case: Case) -> Iterator[Suspicion]:
    """Angles whose zero is half a turn off."""
    for (name, factors), angle in zip(_one_by_one(case.names.q, 0.0), case.names.angles, strict=True):
        if angle:
            line = f"add {np.pi:.9g} to {name}, or write the other zero into [parameters]"
            change = Change.none(case)._replace(offset=np.where(factors == 0, np.pi, 0.0))
            yield Suspicion("zero of a position", name, f"with {name} half a turn on", line, change.apply)


def single_degrees(case: Case) -> Iterator[Suspicion]:
    """One of several angles in degrees."""
    for (name, factors), angle in zip(_one_by_one(case.names.q, ANGLES["degrees"]), case.names.angles, strict=True):
        if angle and len(factors) > 1:
            change, line = Change.none(case)._replace(position=factors), case.names.line("q", factors)
            yield Suspicion("unit of positions", name, f"with {name} in degrees", line, change.apply)


COLUMNS: tuple[Callable[[Case], Iterator[Suspicion]], ...] = (
    units,
    input_units,
    input_signs,
    swaps,
    position_signs,
    zeros,
    single_degrees,
)
"""Suspicions about columns, in order of preference: the first of several that explain about as much is reported."""


def _one_by_one(names: tuple[str, ...], factor: float) -> Iterator[tuple[str, np.ndarray]]:
    """Each name, with factors that are `factor` for this name and 1 for the others."""
    for i, name in enumerate(names):
        yield name, np.where(np.arange(len(names)) == i, factor, 1.0)


def _transposition(columns: tuple[str, ...], i: int, j: int) -> np.ndarray:
    order = np.arange(len(columns))
    if j < len(order):
        order[[i, j]] = j, i
    return order
