"""Candidate corrections of a log: each hypothesis about an error in it is the change that would correct it."""

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from covariant.calibration.diagnosis._smooth import Smooth
from covariant.logs import unit_factor
from covariant.signals import Record

CLOCKS = {
    "seconds": 1.0,
    **{"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9},
    # Such stamps were multiplied by the size of the unit when they were read: this undoes it.
    **{f"seconds that were taken for {name}": 1 / size for name, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))},
}
"""Possible units of the stamps, and the factor that converts them, as they are read, to seconds."""
SHORTEST, LONGEST = 1e-5, 2.0
"""Plausible steps in time [s] of a log of a machine."""
ANGLES = {"radians": 1.0, "degrees": np.pi / 180, "turns": 2 * np.pi}
KNOWN = {"s": ("s", "ms", "us", "ns"), "rad": ("rad", "deg", "turn")}
"""Units that have a name, by the unit of the model."""
COUNTS = (*(2**k for k in range(10, 21)), *(factor * 1000 for factor in (1, 2, 4, 5, 10, 20, 36, 40)))
"""Usual counts per turn of encoders."""


class Change(NamedTuple):
    """A correction of a log.

    New positions are `position * y[:, order] + offset`, new inputs `inputs * u[:, input_order]`, new stamps `time * t`.

    Attributes:
        what: Name of the finding, as "unit of time".
        where: Column concerned, or "".
        words: How the evidence describes the corrected log.
        line: What to write into the model file.
        time: Factor of the stamps.
        position: Factors (n,) of the positions.
        order: Column (n,) of each new position.
        offset: Offsets (n,) of the positions, after the factors.
        inputs: Factors (m,) of the inputs.
        input_order: Column (m,) of each new input.
    """

    what: str
    where: str
    words: str
    line: str
    time: float
    position: np.ndarray
    order: np.ndarray
    offset: np.ndarray
    inputs: np.ndarray
    input_order: np.ndarray

    def of_record(self, record: Record) -> Record:
        """Apply the change to a record.

        Args:
            record: The log, with positions (T, n).

        Returns:
            The corrected log.
        """
        y, u = np.asarray(record.y)[:, self.order], np.asarray(record.u)[:, self.input_order]
        return Record(np.asarray(record.t) * self.time, u * self.inputs, y * self.position + self.offset)

    def of_smooth(self, log: Smooth) -> Smooth:
        """Apply the change to a smoothed log, without smoothing it again; the factor `time` must be 1.

        Args:
            log: The smoothed log.

        Returns:
            The corrected log.
        """
        size = np.abs(self.position)
        return log._replace(
            q=log.q[:, self.order] * self.position + self.offset,
            v=log.v[:, self.order] * self.position,
            a=log.a[:, self.order] * self.position,
            u=log.u[:, self.input_order] * self.inputs,
            noise=log.noise[self.order] * size,
            a_noise=log.a_noise[self.order] * size,
        )


def no_change(n: int, m: int) -> Change:
    """Change that leaves a log with n coordinates and m inputs as it is."""
    none = np.ones(n), np.arange(n), np.zeros(n), np.ones(m), np.arange(m)
    return Change("", "", "as it is", "", 1.0, *none)


class Names(NamedTuple):
    """Columns and units of a log.

    Attributes:
        t: Column of the stamps.
        q: Columns of the positions.
        u: Columns of the inputs.
        units: Units of the positions in the model.
        angles: Which positions (n,) are angles.
        stated: Units of the columns according to the model file, by the field t, q or u.
    """

    t: str
    q: tuple[str, ...]
    u: tuple[str, ...]
    units: tuple[str, ...]
    angles: np.ndarray
    stated: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    def after(self, change: Change) -> "Names":
        """Names and units after a change.

        Args:
            change: The change of the log.

        Returns:
            The names in their new order, with the units that the change implies.
        """
        factors = {"t": np.array([change.time]), "q": change.position, "u": change.inputs}
        orders = {"t": [0], "q": change.order.tolist(), "u": change.input_order.tolist()}
        reordered = self._replace(
            q=tuple(self.q[i] for i in change.order), u=tuple(self.u[i] for i in change.input_order)
        )
        declared = {field: [self._stated(field, i) for i in order] for field, order in orders.items()}
        reordered = reordered._replace(stated={field: tuple(texts) for field, texts in declared.items()})
        changed = {field: reordered.in_units(field, factor) for field, factor in factors.items() if (factor != 1).any()}
        return reordered._replace(stated={**reordered.stated, **changed})

    def line(self, field: str, factors: Sequence[float] | np.ndarray) -> str:
        """Line of the model file that multiplies the columns of a field.

        Args:
            field: The field t, q or u.
            factors: A factor for each column.

        Returns:
            The line, under [units].
        """
        texts = self.in_units(field, factors)
        quoted = json.dumps(texts[0], ensure_ascii=False)
        return f"[units] {field} = {quoted if len(set(texts)) == 1 else _list(texts)}"

    def in_units(self, field: str, factors: Sequence[float] | np.ndarray) -> tuple[str, ...]:
        """Units of the columns of a field that imply given factors.

        Args:
            field: The field t, q or u.
            factors: A factor for each column.

        Returns:
            A unit for each column.
        """
        kinds = [self._kind(field, i) for i in range(len(factors))]
        return tuple(_unit_text(self._stated(field, i), float(factor), kinds[i]) for i, factor in enumerate(factors))

    def _kind(self, field: str, place: int) -> str:
        """Unit of a column in the model; "1" where it states none."""
        return {"t": "s", "u": "1"}.get(field) or ("rad" if self.angles[place] else self.units[place] or "1")

    def _stated(self, field: str, place: int) -> str:
        declared = self.stated.get(field, ())
        return declared[place if len(declared) > 1 else 0] if declared else self._kind(field, place)


def _unit_text(stated: str, factor: float, kind: str) -> str:
    """Unit of a column that was read in the `stated` unit and whose numbers are to be multiplied by a factor."""
    if factor == 1:
        return stated
    # The factor acts on numbers that were converted from the stated unit already.
    total = factor * unit_factor(stated)
    named = next((text for text in KNOWN.get(kind, ()) if math.isclose(total, unit_factor(text), rel_tol=1e-9)), None)
    if named is not None:
        return named
    counts = 2 * math.pi / total
    if kind == "rad" and counts > 1 and math.isclose(counts, round(counts), rel_tol=1e-9):
        return f"turn/{round(counts)}"
    if factor == -1 and stated.startswith("-1 "):
        return stated.removeprefix("-1 ")
    return f"{factor:.3g}" if stated == "1" else f"{factor:.3g} {stated}"


def unit_changes(names: Names, record: Record) -> Iterator[Change]:
    """Changes for stamps that are not in seconds, angles that are not in radians, or both.

    Args:
        names: Columns and units of the log.
        record: The log, whose step in time and values limit the candidates.

    Yields:
        The changes.
    """
    same = no_change(len(names.q), len(names.u))
    step = float(np.median(np.diff(np.asarray(record.t))))
    # A clock that makes the step implausible is not tried: it would match by chance and cost a smoothing.
    clocks = {clock: factor for clock, factor in CLOCKS.items() if SHORTEST <= factor * step <= LONGEST or factor == 1}
    angles = dict(ANGLES) if names.angles.any() else {"radians": 1.0}
    y = np.asarray(record.y)[:, names.angles]
    # Whole numbers beyond a turn: no angles in radians are logged so, but counts are.
    if names.angles.any() and np.all(y[np.isfinite(y)] % 1 == 0) and np.nanmax(np.abs(y)) > 2 * np.pi:
        angles |= {f"counts of {count} a turn": 2 * np.pi / count for count in COUNTS}
    for (clock, time), (angle, size) in itertools.product(clocks.items(), angles.items()):
        if time == size == 1:
            continue
        affected = [name for name, factor in (("time", time), ("positions", size)) if factor != 1]
        description = " and ".join(name for name, factor in ((clock, time), (angle, size)) if factor != 1)
        lines = []
        if time != 1:
            lines.append(names.line("t", [time]))
        if size != 1:
            lines.append(names.line("q", np.where(names.angles, size, 1.0)))
        yield same._replace(
            what="unit of " + " and ".join(affected),
            words=description,
            line="; ".join(lines),
            time=time,
            position=np.where(names.angles, size, 1.0),
        )


def structure_changes(names: Names) -> Iterator[Change]:
    """Changes for columns in the wrong order, with the wrong sign, in another unit than the rest, or half a turn off.

    Args:
        names: Columns and units of the log.

    Yields:
        The changes.
    """
    n, m = len(names.q), len(names.u)
    same = no_change(n, m)
    for j in range(m):
        yield same._replace(
            what="sign of an input",
            where=names.u[j],
            words=f"{names.u[j]} with the other sign",
            line=names.line("u", np.where(np.arange(m) == j, -1.0, 1.0)),
            inputs=np.where(np.arange(m) == j, -1.0, 1.0),
        )
    for i, j in itertools.combinations(range(n), 2):
        # Joint i has input i only where there are as many of both.
        square = n == m
        for what, description, swap_q, swap_u in (
            ("swapped positions", f"{names.q[i]} and {names.q[j]} in each other's place", True, False),
            *(
                (
                    ("swapped inputs", f"{names.u[i]} and {names.u[j]} in each other's place", False, True),
                    ("swapped joints", f"joints {i + 1} and {j + 1} in each other's place", True, True),
                )
                if square
                else ()
            ),
        ):
            q, u = _swapped(n, i, j, swap_q), _swapped(m, i, j, swap_u)
            lines = [f"q = {_list(np.array(names.q)[q])}"] if swap_q else []
            lines += [f"u = {_list(np.array(names.u)[u])}"] if swap_u else []
            yield same._replace(
                what=what,
                where=f"{names.q[i]}, {names.q[j]}" if swap_q else f"{names.u[i]}, {names.u[j]}",
                words=description,
                line="[columns] " + ", ".join(lines),
                order=q,
                input_order=u,
            )
    for i in range(n):
        selected = np.arange(n) == i
        yield same._replace(
            what="sign of a position",
            where=names.q[i],
            words=f"{names.q[i]} with the other sign",
            line=names.line("q", np.where(selected, -1.0, 1.0)),
            position=np.where(selected, -1.0, 1.0),
        )
        if names.angles[i]:
            yield same._replace(
                what="zero of a position",
                where=names.q[i],
                words=f"{names.q[i]} half a turn on",
                line=f"add {np.pi:.9g} to {names.q[i]}, or write the other zero into [parameters]",
                offset=np.where(selected, np.pi, 0.0),
            )
            if n > 1:
                yield same._replace(
                    what="unit of positions",
                    where=names.q[i],
                    words=f"{names.q[i]} in degrees",
                    line=names.line("q", np.where(selected, np.pi / 180, 1.0)),
                    position=np.where(selected, np.pi / 180, 1.0),
                )


def _swapped(count: int, i: int, j: int, swap: bool) -> np.ndarray:
    order = np.arange(count)
    if swap:
        order[[i, j]] = j, i
    return order


def _list(names) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"
