"""Findings of a diagnosis, and how they name rows, columns and units."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs import unit_factor
from covariant.models import ModelFile
from covariant.models.robots import servos_in

MOST_NAMED = 5
"""Largest number of rows that a message names."""
KNOWN = {"s": ("s", "ms", "us", "ns"), "rad": ("rad", "deg", "turn")}
"""Units that have a name, by the unit of the model."""


class Finding(NamedTuple):
    """A defect or peculiarity of a log.

    `line` is the remedy, and can be copied into the model file. Programs should read `numbers`, and people `evidence`.

    Attributes:
        what: Name of the finding, such as "unit of time" or "delay".
        where: The column concerned, or "".
        evidence: A sentence with the numbers, their units and their uncertainty.
        line: Line to write into the model file, or change to make in the log; "" if nothing has to change.
        wrong: Whether estimates from the unchanged log are wrong; False for a note.
        numbers: The numbers of the evidence by name, in SI units.

    Example:
        >>> from covariant.calibration import Finding
        >>> delay = Finding("delay", "q2", "q2 is 10 ms late", "[measurement] delay = 0.01", True, {"delay": 0.01})
        >>> delay.wrong, delay.line
        (True, '[measurement] delay = 0.01')
    """

    what: str
    where: str
    evidence: str
    line: str
    wrong: bool
    numbers: dict[str, Any]


class Diagnosis(NamedTuple):
    """Result of `diagnose`.

    `wrong` decides whether to go on; other findings are notes. An empty list of findings says something only about the
    checks in `looked_for`, since a short or quiet log does not allow all of them.

    Attributes:
        findings: The findings, the gravest first.
        looked_for: Names of the checks that log and model allow.
        skipped: Names of the checks that a finding made impossible, which says why.

    Example:
        >>> from covariant.calibration import Diagnosis, Finding
        >>> note = Finding("missing rows", "", "2 rows are missing in 1 place", "nothing to change", False, {"rows": 2})
        >>> Diagnosis((note,), ("missing rows",)).wrong
        False
    """

    findings: tuple[Finding, ...]
    looked_for: tuple[str, ...]
    skipped: tuple[str, ...] = ()

    @property
    def wrong(self) -> bool:
        """Whether estimates from the unchanged log are wrong."""
        return any(finding.wrong for finding in self.findings)


class Rows(NamedTuple):
    """Stamps of a record, and the rows of its file.

    Attributes:
        t: Stamps (T,) [s].
        first: Row of the file, counted from 1, at which the record begins.
        every: The record has each `every`-th row.
    """

    t: Float[np.ndarray, "T"]
    first: int = 1
    every: int = 1

    def named(self, k: int) -> str:
        """Text that names row k of the record, counted from 0, by its row in the file and its stamp."""
        return f"row {self.first + k * self.every} ({self.t[k]:.6g} s)"

    def listed(self, places: Sequence[int] | np.ndarray) -> str:
        """Text that names the first `MOST_NAMED` of some rows, counted from 0, and how many more there are."""
        shown = ", ".join(self.named(int(k)) for k in places[:MOST_NAMED])
        return f"{shown} and {len(places) - MOST_NAMED} more" if len(places) > MOST_NAMED else shown

    def listed_runs(self, places: np.ndarray) -> str:
        """Text that names the first `MOST_NAMED` runs of neighbouring rows, and how many more there are."""
        runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
        texts = [self.named(int(run[0])) + f" to {self.named(int(run[-1]))}" * (len(run) > 1) for run in runs]
        return ", ".join(texts[:MOST_NAMED]) + f" and {len(texts) - MOST_NAMED} more" * (len(texts) > MOST_NAMED)


class Names(NamedTuple):
    """Columns and units of a log.

    Attributes:
        t: Column of the stamps.
        q: Columns of the positions.
        u: Columns of the inputs.
        units: Units of the positions in the model.
        angles: Whether each position (n,) is an angle.
        stated: Units of the columns according to the model file, by the field t, q or u.
        inputs: Units of the inputs in the model, where they are commands.
    """

    t: str
    q: tuple[str, ...]
    u: tuple[str, ...]
    units: tuple[str, ...]
    angles: np.ndarray
    stated: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    inputs: tuple[str, ...] = ()

    def after(self, orders: Mapping[str, Sequence[int]], factors: Mapping[str, np.ndarray]) -> "Names":
        """Names and units after the columns of some fields are reordered, and then multiplied by factors."""
        declared = {field: tuple(self.stated_unit(field, i) for i in order) for field, order in orders.items()}
        columns = {field: tuple(getattr(self, field)[i] for i in orders[field]) for field in ("q", "u")}
        reordered = self._replace(**columns, stated=declared)
        changed = {field: reordered.in_units(field, by) for field, by in factors.items() if (by != 1).any()}
        return reordered._replace(stated={**declared, **changed})

    def line(self, field: str, factors: Sequence[float] | np.ndarray) -> str:
        """Line of the model file that multiplies the columns of a field."""
        texts = self.in_units(field, factors)
        quoted = json.dumps(texts[0], ensure_ascii=False)
        return f"[units] {field} = {quoted if len(set(texts)) == 1 else quoted_list(texts)}"

    def in_units(self, field: str, factors: Sequence[float] | np.ndarray) -> tuple[str, ...]:
        """Units to state for the columns of a field, so that their numbers are multiplied by these factors."""
        stated = ((self.stated_unit(field, i), self._kind(field, i)) for i in range(len(factors)))
        return tuple(_unit_text(unit, float(by), kind) for (unit, kind), by in zip(stated, factors, strict=True))

    def _kind(self, field: str, place: int) -> str:
        """Unit of a column in the model; "1" where it states none."""
        if field == "u":
            return self.inputs[place] if place < len(self.inputs) else "1"
        return {"t": "s"}.get(field) or ("rad" if self.angles[place] else self.units[place] or "1")

    def stated_unit(self, field: str, place: int) -> str:
        """Unit in which a column of a field was read."""
        declared = self.stated.get(field, ())
        return declared[place if len(declared) > 1 else 0] if declared else self._kind(field, place)


def _unit_text(stated: str, factor: float, kind: str) -> str:
    """Unit of a column that was read in the `stated` unit and whose numbers are to be multiplied by a factor."""
    if factor == 1:
        return stated
    # The factor applies after the conversion from the stated unit.
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


def counted(count: int, what: str) -> str:
    """A number of things, as "1 row" or "2 rows"."""
    return f"{count} {what}{'s' if count > 1 else ''}"


def stated_time(t: float) -> str:
    """A time [s] for `start` or `until`, with microseconds where it has them, and also for seconds since 1970."""
    return f"{t:.6f}".rstrip("0").rstrip(".")


def quoted_list(names: Iterable[str]) -> str:
    """The names as a list of a model file."""
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def later_line(file: ModelFile, late: float) -> str:
    """Lines of the model file for positions that follow the inputs later than it says, by a time [s]."""

    def later(delay: float | tuple[float, ...]) -> str:
        delays = np.asarray(delay, float) + late
        texts = ", ".join(f"{value:.2g}" for value in np.atleast_1d(delays))
        return f"delay = {f'[{texts}]' if delays.ndim else texts}"

    if file.input_kind == "command":
        tables = (f"[servo.{name}] {later(delay)}" for name, delay in _command_delays(file))
        acting = ", ".join(tables) + " where commands act late"
    else:
        acting = f"[inputs] {later(file.input_delay)} where inputs act late"
    return f"[measurement] {later(file.delay)} where measurements are late, or {acting}"


def _command_delays(file: ModelFile) -> list[tuple[str, float]]:
    """The joints that are told positions, with the delays of their commands."""
    servos = servos_in(file.model)
    if servos is None:
        return []
    delays = np.broadcast_to(file.input_delay, len(servos.input_names)).tolist()
    named = zip(servos.input_names, delays, strict=True)
    return [(name.removeprefix("cmd_"), delay) for name, delay in named if name.startswith("cmd_")]
