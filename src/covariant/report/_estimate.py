"""The content of a report: the arrays of several observers on one log."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

MEASURED = "measured"
"""Legend entry of the measured positions."""

Samples = Float[np.ndarray | Array, "T n"]


class EstimateReport(NamedTuple):
    """Estimates of one log, time first; NaN marks a missing value and is drawn as a gap. `check` tests the shapes.

    - `title`: headline, plain text.
    - `coordinates`, `units`: name and unit of each of the n coordinates, such as "θ" and "rad"; velocities are per
      second.
    - `t` (T,): stamps [s]. `q_measured` (T, n): measured positions [units].
    - `estimates`: label -> (T, 2n), position [units] then velocity [units/s]. The first is the observer reported on.
    - `innovation`: label -> (T, n), measurement minus estimate before correction [units].
    - `distance`: label -> (T,), the length of the innovation in the metric, for observers that compute it.
    - `v_reference` (T, n) [units/s]: reference for the velocities, or None; `v_reference_label` is its label.
    - `rows`: rows of a comparison, best first; columns are the keys. May be empty.
    - `estimated`: what the estimates are scored by, "velocity" or "state".
    - `notes`: plain sentences under the title, such as gains, predicted errors, and samples without measurement.

    On a group a configuration cannot be drawn as a curve. There `q_measured` is None, `coordinates` and `units` are
    those of the n velocities, `estimates` hold the velocities alone (T, n), and the innovation is the error in the body
    frame, along each of them.
    """

    title: str
    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    t: Float[np.ndarray | Array, "T"]
    q_measured: Samples | None
    estimates: Mapping[str, Float[np.ndarray | Array, "T k"]]
    innovation: Mapping[str, Samples] = MappingProxyType({})
    distance: Mapping[str, Float[np.ndarray | Array, "T"]] = MappingProxyType({})
    v_reference: Samples | None = None
    v_reference_label: str = "reference"
    rows: Sequence[Mapping[str, str | float]] = ()
    notes: tuple[str, ...] = ()
    estimated: str = "velocity"

    def check(self) -> "EstimateReport":
        """Return the report, or raise `ValueError` naming the first thing wrong with it."""
        samples, n = len(self.t), len(self.coordinates)
        if not samples or not n or not self.estimates:
            raise ValueError("a report needs at least one sample, one coordinate and one estimate")
        if len(self.units) != n:
            raise ValueError(f"a report needs one unit a coordinate; got {n} coordinates and {len(self.units)} units")
        for name, array, shape in self._shapes(samples, n):
            if np.shape(array) != shape:
                raise ValueError(f"{name} must have the shape {shape}; got {np.shape(array)}")
        for name, entries in (("innovation", self.innovation), ("distance", self.distance)):
            unknown = set(entries) - set(self.estimates)
            if unknown:
                raise ValueError(
                    f"{name} has {sorted(unknown)}, but there are estimates only of {list(self.estimates)}"
                )
        taken = set(self.estimates) & set(self.backdrops)
        if taken:
            raise ValueError(f"an estimate cannot be called {taken.pop()!r}: that names the curve it is compared with")
        return self

    @property
    def backdrops(self) -> list[str]:
        """Labels of the curves that the estimates are compared with."""
        measured = [] if self.q_measured is None else [MEASURED]
        return measured if self.v_reference is None else [*measured, self.v_reference_label]

    def _shapes(self, samples: int, n: int):
        yield "t", self.t, (samples,)
        if self.q_measured is not None:
            yield "q_measured", self.q_measured, (samples, n)
        if self.v_reference is not None:
            yield "v_reference", self.v_reference, (samples, n)
        for label, x in self.estimates.items():
            yield f"estimates[{label!r}]", x, (samples, n if self.q_measured is None else 2 * n)
        for label, e in self.innovation.items():
            yield f"innovation[{label!r}]", e, (samples, n)
        for label, d in self.distance.items():
            yield f"distance[{label!r}]", d, (samples,)
