"""Defines the content of a report: the arrays of several observers on one log."""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from scalargraph.errors import InputError

MEASURED = "measured"
"""Legend entry of the measured positions."""

DIFFERENCE = "difference of the readings"
"""Legend entry of the raw velocity, the slope between consecutive readings."""

BANDS = "±2σ"
"""Legend entry of the bands of two standard deviations."""

MARKS = {"no measurement": "circle-open", "refused": "x", "restarted": "diamond-open"}
"""Legend entries of rows that a report may mark, with the name of each symbol."""

Samples = Float[np.ndarray | Array, "T n"]


class Along(NamedTuple):
    """Quantities that are estimated along with the motion, such as external forces.

    Attributes:
        names: Names of the k quantities.
        units: Unit of each quantity.
        values: Estimates (T, k) in these units.
        std: Their standard deviations (T, k).

    Example:
        >>> import numpy as np
        >>> from covariant.report import Along
        >>> Along(("external_force1",), ("N m",), np.zeros((3, 1)), np.ones((3, 1))).units
        ('N m',)
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "T k"]
    std: Float[np.ndarray, "T k"]


class EstimateReport(NamedTuple):
    """Estimates of one log, with time first; `figure` and `write_report` draw them.

    NaN marks a missing value and is drawn as a gap. `check` tests the shapes. Arrays may be from NumPy or JAX.

    Attributes:
        title: Title, plain text.
        coordinates: Names of the n coordinates, such as "θ". Without `q_measured`, names of the estimated quantities.
        units: Unit of each, such as "rad", or "" for none; velocities are in these units per second. Without
            `q_measured`, units of the estimated quantities.
        t: (T,), stamps [s].
        q_measured: (T, n), measured positions [units]. None for states, and for systems on a group, whose
            configuration cannot be drawn as curves.
        estimates: By label: velocities (T, n) or states (T, n), as `estimated` says. With measured positions also
            (T, 2n), estimated positions followed by velocities. The first label is the observer reported on.
        innovation: By label, (T, n): measurement minus estimate before the correction [units]; on a group the error in
            the body frame along each velocity.
        distance: By label, (T,): length of the innovation in the metric, for observers that compute it.
        v_reference: (T, n), reference for the estimates, in the same units; None if there is none.
        v_reference_label: Label of the reference in the legend.
        rows: Rows of a table; columns are the keys. May be empty.
        notes: Plain sentences under the title, such as gains and predicted errors.
        estimated: "velocity" or "state".
        headline: The result in one line: what was estimated, and how accurately.
        warnings: Sentences on anything unusual, such as samples without measurement.
        best: Number of first rows that are marked as the best: several if they are equally good.
        std: By label, (T, n): standard deviations of the estimates, in the same units; drawn as bands of ±2σ.
        innovation_std: By label, (T, n): standard deviations that the filter expects of the innovation.
        along: Quantities that the first observer estimates along with the motion; None if there are none.
        marks: Rows (T,) of the first observer that are marked, by a name of `MARKS`.
        shaded: (k, 2), begin and end [s] of shaded intervals, in which an external force acts.
        contrast: Label of an estimate, such as a smoother's, to which the others are compared by differences; "" for
            none.
        facts: Facts about the computation, by name: log, rate, gains, version, command.
        code: Lines to copy, such as those of a model file.
        table: Columns (T,) by name, which the page offers as a CSV file; empty for none.
        hidden: Labels of curves that are shown only after a click.

    Example:
        >>> import numpy as np
        >>> from covariant.report import EstimateReport, figure
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> truth = np.cos(t)[:, None]
        >>> report = EstimateReport(
        ...     title="Pendulum",
        ...     coordinates=("θ",),
        ...     units=("rad",),
        ...     t=t,
        ...     q_measured=np.sin(t)[:, None],
        ...     estimates={"intrinsic": truth + 0.01},
        ...     v_reference=truth,
        ... )
        >>> [ax.get_ylabel() for ax in figure(report).axes]
        ['dθ/dt [rad/s]', 'error of dθ/dt [rad/s]']
        >>> figure(report).savefig("pendulum.png")
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
    estimated: Literal["velocity", "state"] = "velocity"
    headline: str = ""
    warnings: tuple[str, ...] = ()
    best: int = 0
    std: Mapping[str, Samples] = MappingProxyType({})
    innovation_std: Mapping[str, Samples] = MappingProxyType({})
    along: Along | None = None
    marks: Mapping[str, Bool[np.ndarray, "T"]] = MappingProxyType({})
    shaded: Float[np.ndarray, "k 2"] | None = None
    contrast: str = ""
    facts: Mapping[str, str] = MappingProxyType({})
    code: str = ""
    table: Mapping[str, np.ndarray] = MappingProxyType({})
    hidden: tuple[str, ...] = ()

    def check(self) -> "EstimateReport":
        """Check the shapes and labels of the report.

        Returns:
            The report itself.

        Raises:
            ValueError: A field is wrong; one line names the first such field and what it must be.
        """
        samples, n = len(self.t), len(self.coordinates)
        if not samples or not n or not self.estimates:
            raise InputError("a report needs at least one sample, one coordinate and one estimate")
        if len(self.units) != n:
            raise InputError(f"a report needs one unit a coordinate; got {n} coordinates and {len(self.units)} units")
        if self.estimated not in _PLURAL:
            raise InputError(f"estimated must be one of {', '.join(_PLURAL)}; got {self.estimated!r}")
        if self.estimated == "state" and self.q_measured is not None:
            raise InputError("q_measured belongs to velocities; a report of states has none, and it must be None")
        for label, x in self.estimates.items():
            if np.shape(x) not in self._accepted(samples, n):
                accepted = " or ".join(f"{shape} ({what})" for shape, what in self._accepted(samples, n).items())
                raise InputError(f"estimates[{label!r}] must have the shape {accepted}; got {np.shape(x)}")
        for name, array, shape in self._shapes(samples, n):
            if np.shape(array) != shape:
                raise InputError(f"{name} must have the shape {shape}; got {np.shape(array)}")
        for name in ("innovation", "distance", "std", "innovation_std"):
            entries = getattr(self, name)
            unknown = set(entries) - set(self.estimates)
            if unknown:
                raise InputError(
                    f"{name} has {sorted(unknown)}, but there are estimates only of {list(self.estimates)}"
                )
        reserved = set(self.estimates) & {*self.backdrops, BANDS}
        if reserved:
            raise InputError(f"an estimate cannot be called {reserved.pop()!r}: that names another entry of the legend")
        return self

    @property
    def backdrops(self) -> list[str]:
        """Labels of the curves to which the estimates are compared."""
        measured = [] if self.q_measured is None else [MEASURED, DIFFERENCE]
        return measured if self.v_reference is None else [*measured, self.v_reference_label]

    def _accepted(self, samples: int, n: int) -> dict[tuple[int, int], str]:
        """The shapes that an estimate may have, with a description of the columns for each."""
        accepted = {(samples, n): _PLURAL[self.estimated]}
        if self.q_measured is not None:
            accepted[samples, 2 * n] = "positions and then velocities"
        return accepted

    def _shapes(self, samples: int, n: int) -> Iterator[tuple[str, Samples, tuple[int, ...]]]:
        yield "t", self.t, (samples,)
        if self.q_measured is not None:
            yield "q_measured", self.q_measured, (samples, n)
        if self.v_reference is not None:
            yield "v_reference", self.v_reference, (samples, n)
        for name in ("innovation", "std", "innovation_std"):
            for label, e in getattr(self, name).items():
                yield f"{name}[{label!r}]", e, (samples, n)
        for label, d in self.distance.items():
            yield f"distance[{label!r}]", d, (samples,)


_PLURAL = {"velocity": "velocities", "state": "states"}
"""The quantities that may be estimated, with their plurals."""
