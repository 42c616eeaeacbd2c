"""Holes of a log: where readings are missing for longer than usual, and which rows their errors concern."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.scoring import find_holes, near_holes

LONGEST_SHOWN = 3
"""How many stretches without a measurement are named, the longest ones."""


class Holes(NamedTuple):
    """The holes of a log.

    Attributes:
        t: Stamps (T,) [s].
        spans: The last stamp [s] with a reading before each hole, and the first one after it (H, 2).
        concerned: Rows (T,) in a hole or within `SETTLED` after it.
        no_input: Number of rows that lack an input.
        of_inputs: Whether inputs are missing in a hole too, as rows or as cells.
    """

    t: Float[np.ndarray, "T"]
    spans: Float[np.ndarray, "H 2"]
    concerned: Bool[np.ndarray, "T"]
    no_input: int
    of_inputs: bool

    @property
    def lengths(self) -> Float[np.ndarray, "H"]:
        """Length [s] of each hole."""
        return self.spans[:, 1] - self.spans[:, 0]

    @property
    def table(self) -> dict[str, Any]:
        """Count, longest and total time [s], share of the log, and rows that the holes concern, as JSON data."""
        return {
            "count": len(self.spans),
            "longest": float(f"{self.lengths.max():.6g}"),
            "total": float(f"{self.lengths.sum():.6g}"),
            "share": float(f"{self.lengths.sum() / (self.t[-1] - self.t[0]):.6g}"),
            "rows_in_and_after": int(self.concerned.sum()),
            "rows_without_input": self.no_input,
        }

    def __str__(self) -> str:
        numbers, count = self.table, len(self.spans)
        order = np.argsort(-self.lengths, kind="stable")[:LONGEST_SHOWN]
        where = ", ".join(f"{begin:.4g} to {end:.4g} s" for begin, end in self.spans[order])
        if count == 1:
            text = f"1 hole without readings, of {numbers['longest']:.3g} s (t = {where})"
        else:
            text = (
                f"{count} holes without readings, the longest of {numbers['longest']:.3g} s "
                f"({'the longest at ' * (count > LONGEST_SHOWN)}t = {where}), {numbers['total']:.3g} s in all"
            )
        inputs = f"; {self.no_input} rows lack an input" if self.no_input else ""
        return f"{text}, {100 * numbers['share']:.2g} % of the log{inputs}"


def holes_of(t: np.ndarray, u: np.ndarray, y: np.ndarray) -> Holes | None:
    """The holes of a log with inputs u (T, m) and measurements y (T, *n); None where it has none."""
    spans = find_holes(t, np.asarray(np.isfinite(y.reshape(len(y), -1)).any(1)))
    no_input = int((~np.isfinite(u)).any(1).sum())
    if not len(spans):
        return None
    of_inputs = bool(u.shape[1]) and len(find_holes(t, np.asarray(np.isfinite(u).all(1)))) > 0
    return Holes(t, spans, near_holes(t, spans), no_input, of_inputs)
