"""Collects the panels of a report for every medium: their curves, labels and drawing order."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.report._estimate import DIFFERENCE, MEASURED, EstimateReport

BAND = 2.0
"""Half width of a band, in standard deviations."""


class Curve(NamedTuple):
    """Samples of one quantity, or a band.

    Attributes:
        t: Stamps (T,) [s].
        values: Samples (T, c), a column for each panel; the upper edge of a band.
        label: Entry of the legend.
        role: Measurements are drawn behind the estimates, and a reference in front of them. Raw slopes are behind all
            others and do not set the axis; bounds are a band; marks are single samples.
        below: Lower edge (T, c) of a band; None for a line.
    """

    t: Float[np.ndarray, "T"]
    values: Float[np.ndarray, "T c"]
    label: str
    role: Literal["estimate", "measured", "raw", "reference", "bounds", "mark"] = "estimate"
    below: Float[np.ndarray, "T c"] | None = None

    @property
    def backdrop(self) -> bool:
        """Whether estimates are compared to this curve, so that it is shown in full."""
        return self.role in ("measured", "reference")


class Quantity(NamedTuple):
    """One kind of panel, drawn for each of its c columns (the coordinates, or a single one).

    Attributes:
        name: Name in file names.
        title: Title above the panel.
        labels: Labels (c) of the y axes, with units.
        curves: Backdrops first, then the estimates in their order, bands of ±2σ and marks.
        scale: Size (c) of the motion itself; an error many times as large only shows that the estimate has diverged.
        deviation: Whether the values are errors; then zero is marked, and the smallest curve is drawn in front.
        log: Whether the y axis is logarithmic.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    curves: tuple[Curve, ...]
    scale: Float[np.ndarray, "c"]
    deviation: bool = False
    log: bool = False


def quantities(report: EstimateReport) -> dict[str, Quantity]:
    """Collect the panels of a report."""
    n = len(report.coordinates)
    t = np.asarray(report.t, float)
    states = {label: np.asarray(x, float) for label, x in report.estimates.items()}
    words = _ON_A_GROUP if report.q_measured is None else _IN_COORDINATES

    def estimated(arrays) -> tuple[Curve, ...]:
        return tuple(Curve(t, np.asarray(values, float).reshape(len(t), -1), label) for label, values in arrays.items())

    positions, raw, travel = (), (), np.zeros(n)
    if report.q_measured is not None:
        measured = np.asarray(report.q_measured, float)
        travel = span(measured)
        # Estimates of n columns are velocities only, without estimated positions to draw.
        configurations = {label: x[:, :n] for label, x in states.items() if x.shape[1] == 2 * n}
        positions = (Curve(t, measured, MEASURED, "measured"), *estimated(configurations))
        raw = (Curve(t, _slopes(t, measured), DIFFERENCE, "raw"),)
    velocities = {label: x[:, -n:] for label, x in states.items()}
    reference, errors, speed = (), (), np.zeros(n)
    if report.v_reference is not None:
        v = np.asarray(report.v_reference, float)
        reference = (Curve(t, v, report.v_reference_label, "reference"),)
        errors = estimated({label: panels - v for label, panels in velocities.items()})
        speed = span(v)
    names = {name: _labels(report, *form) for name, form in words.items()}
    innovations, kind = estimated(report.innovation), report.estimated.capitalize()
    bands = tuple(
        Curve(t, velocities[label] + BAND * std, label, "bounds", velocities[label] - BAND * std)
        for label, std in _arrays(report.std).items()
    )
    around = {
        name: tuple(Curve(t, BAND * std, label, "bounds", -BAND * std) for label, std in _arrays(stds).items())
        for name, stds in (("error", report.std), ("innovation", report.innovation_std))
    }
    first = next(iter(velocities))
    drawn = np.asarray(next(iter(report.innovation.values()), velocities[first]), float)
    panels = (
        Quantity("position", "Position", names["position"], positions, travel),
        Quantity(
            "velocity",
            kind,
            names["velocity"],
            raw + reference + estimated(velocities) + bands + _marks(report, t, velocities[first]),
            speed,
        ),
        *_differences(report, t, velocities, names["velocity"]),
        Quantity("error", f"{kind} error", names["error"], errors + (around["error"] if errors else ()), speed, True),
        Quantity(
            "innovation",
            "Innovation",
            names["innovation"],
            innovations + around["innovation"] + _marks(report, t, drawn, "refused") if innovations else (),
            travel,
            deviation=True,
        ),
        Quantity(
            "distance",
            "Distance to the measurement",
            ("metric distance [√kg m]",),
            estimated(report.distance),
            np.zeros(1),
            deviation=True,
            log=True,
        ),
        *_along(report, t, first),
    )
    return {quantity.name: quantity for quantity in panels if quantity.curves}


def _arrays(samples: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {label: np.asarray(values, float) for label, values in samples.items()}


def _slopes(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T c"]) -> Float[np.ndarray, "T c"]:
    """Slopes between consecutive readings, at the later one; NaN if one is missing or no time has passed."""
    steps = np.diff(t, prepend=np.nan)[:, None]
    return np.diff(y, axis=0, prepend=np.nan) / np.where(steps > 0, steps, np.nan)


def _marks(
    report: EstimateReport, t: Float[np.ndarray, "T"], values: Float[np.ndarray, "T c"], *names: str
) -> tuple[Curve, ...]:
    """The marked rows, all or those with some names, placed on the curve of the first estimate."""
    chosen = {name: rows for name, rows in report.marks.items() if not names or name in names}
    return tuple(Curve(t[rows], values[rows], name, "mark") for name, rows in chosen.items() if rows.any())


def _differences(
    report: EstimateReport, t: Float[np.ndarray, "T"], velocities: dict[str, np.ndarray], labels: tuple[str, ...]
) -> tuple[Quantity, ...]:
    """Differences between the other estimates and the estimate named by `contrast`.

    The difference between a filter's and a smoother's error has the difference of their covariances (Rauch, Tung &
    Striebel 1965).
    """
    if not report.contrast:
        return ()
    base, stds = velocities[report.contrast], _arrays(report.std)
    curves = []
    for label in velocities:
        if label == report.contrast:
            continue
        curves.append(Curve(t, velocities[label] - base, label))
        if label in stds and report.contrast in stds:
            std = np.sqrt(np.maximum(stds[label] ** 2 - stds[report.contrast] ** 2, 0.0))
            curves.append(Curve(t, BAND * std, label, "bounds", -BAND * std))
    title = f"Difference to the {report.contrast} one, with what is expected of it"
    return (Quantity("difference", title, labels, tuple(curves), span(base), deviation=True),)


def _along(report: EstimateReport, t: Float[np.ndarray, "T"], label: str) -> tuple[Quantity, ...]:
    """The quantities that are estimated along with the motion, with their bands."""
    if report.along is None:
        return ()
    names, units, values, std = report.along
    labels = tuple(f"{name}\n[{unit}]" if unit else name for name, unit in zip(names, units, strict=True))
    band = Curve(t, values + BAND * std, label, "bounds", values - BAND * std)
    pushed = report.shaded is not None and len(report.shaded) > 0
    title = "Estimated along with the motion" + "; shaded where something pushes" * pushed
    return (Quantity("along", title, labels, (Curve(t, values, label), band), span(values)),)


_IN_COORDINATES = {
    "position": ("{}", ""),
    "velocity": ("d{}/dt", "/s"),
    "error": ("error of d{}/dt", "/s"),
    "innovation": ("y − {}", ""),
}
_ON_A_GROUP = {
    "position": ("{}", " s"),
    "velocity": ("{}", ""),
    "error": ("error of {}", ""),
    "innovation": ("along {}", " s"),
}
"""For each kind of panel, a format of its label and the suffix of its unit. The format is filled with the name of a
coordinate or, on a group, of a velocity."""


def span(values: Float[np.ndarray, "T c"]) -> Float[np.ndarray, "c"]:
    """Range of each column."""
    finite = np.isfinite(values)
    # NaN is replaced by infinities, since nanmax would warn of a column without a finite sample.
    high = np.where(finite, values, -np.inf).max(axis=0)
    low = np.where(finite, values, np.inf).min(axis=0)
    return np.where(finite.any(axis=0), high, 0.0) - np.where(finite.any(axis=0), low, 0.0)


def depths(quantity: Quantity, column: int) -> list[int]:
    """Drawing order of the curves.

    Measurements and bands are behind. Then come the estimates, with the first or the smallest in front. Then come a
    reference, whose dashes let the estimate show through, the bounds of errors, and marks.
    """
    size = [_size(c.values[:, column]) if quantity.deviation else rank for rank, c in enumerate(quantity.curves)]
    layers = [_layer(curve, quantity.deviation) for curve in quantity.curves]
    # Within a layer the smallest error is drawn last, in front; of equal errors, the first curve.
    order = sorted(range(len(size)), key=lambda i: (layers[i], -size[i], -i))
    return [order.index(i) for i in range(len(size))]


def _layer(curve: Curve, deviation: bool) -> int:
    if curve.role == "bounds":
        return 3 if deviation else 0
    return {"raw": 0, "measured": 0, "estimate": 1, "reference": 2, "mark": 4}[curve.role]


def shorten(text: str, most: int) -> str:
    """Shorten a text; an ellipsis marks what was cut off."""
    return text if len(text) <= most else text[: most - 1] + "…"


def _size(values: Float[np.ndarray, "T"]) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.median(finite)) if finite.size else 0.0


def _labels(report: EstimateReport, form: str, per: str) -> tuple[str, ...]:
    """Axis labels such as "dθ/dt [rad/s]"; if a name is long, as that of a joint, all are used alone, above units."""
    short = max(map(len, report.coordinates)) <= 4
    names = [form.format(name) + " " if short else shorten(name, 24) + "\n" for name in report.coordinates]
    units = [f"[{unit or '1'}{per}]".replace("/s s", "") if unit or per == "/s" else "" for unit in report.units]
    return tuple((name + unit).strip() for name, unit in zip(names, units, strict=True))
