"""What a log tells of its clock and its sensors without a model: missing rows, jitter, outliers, ticks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._finding import Finding
from covariant.scoring import unwrap

GAP = 1.5
"""Steps in time longer than so many usual ones, and than the jitter explains, miss a row."""
JITTER = 0.02
"""Standard deviation of steps in time, as a fraction of the usual one, from which they are called irregular."""
FAR = 8.0
"""Standard deviations from which a measurement between its neighbours is an outlier."""
ROUNDS = 30
"""Most times that measurements are predicted anew."""
COARSE = 0.02
"""Part of the motion among the neighbours of a measurement by which a polynomial may miss it."""
FEW_ROWS = 50
"""Fewest measurements among which outliers are told."""
FEW_OUTLIERS = 5e-3
"""Fraction of outliers that is not worth a finding."""
FEW_REPEATED = 0.02
"""Fraction of rows that repeat the readings before which is not worth a finding."""
MOST_NAMED = 5
"""Rows that a finding names."""
USUAL = 20_000
"""Rows of a long log from which the usual error is taken."""
LATTICE = 0.05
"""How far changes may be from whole ticks, as a fraction of one."""
MOST_TICKS = 1.5
"""Ticks as large as so many standard deviations of the noise: below that the noise hides them."""


def stamps(t: Float[np.ndarray, "T"]) -> list[Finding]:
    """Rows that the stamps (T,) [s] show to be missing, and irregular stamps."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    jitter = 1.4826 * float(np.median(np.abs(steps - usual)))
    gaps = steps > max(GAP * usual, usual + FAR * jitter)
    findings = []
    if gaps.any():
        missing = int(np.sum(np.rint(steps[gaps] / usual) - 1))
        findings.append(
            Finding(
                "missing rows",
                "",
                f"{missing} rows are missing in {int(gaps.sum())} places, the longest of {steps.max():.4g} s, where "
                f"rows are {usual:.4g} s apart",
                "nothing to change: estimates use the stamps, and run on with the model alone meanwhile",
                False,
                {"rows": missing, "places": int(gaps.sum()), "longest": float(steps.max())},
            )
        )
    spread = float(np.std(steps[~gaps]))
    if spread > JITTER * usual:
        findings.append(
            Finding(
                "irregular stamps",
                "",
                f"rows are {usual:.4g} s ± {spread:.2g} s apart, from {steps.min():.4g} s to {steps[~gaps].max():.4g}",
                "nothing to change: estimates use the stamps and assume no constant step",
                False,
                {"step": usual, "std": spread},
            )
        )
    return findings


def missing_cells(y: np.ndarray) -> list[Finding]:
    """Missing measurements, NaN in y (T, …)."""
    lost = np.isnan(y.reshape(len(y), -1)).any(axis=1)
    if not lost.any():
        return []
    share = float(lost.mean())
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]])))
    longest = int(np.max(edges[1::2] - edges[::2]))
    return [
        Finding(
            "missing measurements",
            "",
            f"{int(lost.sum())} of {len(y)} rows ({100 * share:.2g} %) lack one, at most {longest} in a row",
            "nothing to change: estimates run on with the model alone meanwhile",
            False,
            {"rows": int(lost.sum()), "share": share, "longest": longest},
        )
    ]


def outliers(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"], circles: tuple[int, ...]
) -> tuple[Bool[np.ndarray, "T n"], Float[np.ndarray, "n"]]:
    """Which measurements are outliers (T, n), and how far off they usually are (n,).

    Each measurement is predicted by the cubic through two before and two after it. The farthest one of those near to
    each other is taken out, and its neighbours are predicted anew, until none is far.
    """
    y = np.array(y, float)
    wrong, sizes = np.zeros(y.shape, bool), np.zeros(y.shape[1])
    for i in range(y.shape[1]):
        kept, error, floor = np.flatnonzero(np.isfinite(y[:, i])), np.zeros(1), np.zeros(1)
        column = unwrap(y[:, i : i + 1], (0,) if i in circles else ())[:, 0]
        for _ in range(ROUNDS):
            if len(kept) < FEW_ROWS:
                break
            error = prediction_errors(t[kept], column[kept])
            floor = np.maximum(1.4826 * np.median(np.abs(error)), tick(column[kept]))
            floor = np.maximum(floor, COARSE * _moved(column[kept]))
            size = np.zeros(len(kept))
            far = np.flatnonzero(np.abs(error) > FAR * floor)  # few, of which alone the neighbours are looked at
            scale = np.maximum(floor[far], _around(error, far))
            size[far] = np.where(np.abs(error[far]) > FAR * np.where(scale > 0, scale, np.inf), np.abs(error[far]), 0.0)
            bad = (size > 0) & (size == np.max([np.roll(size, k) for k in (-3, -2, -1, 0, 1, 2, 3)], axis=0))
            if not bad.any():
                break
            wrong[kept[bad], i] = True
            kept = kept[~bad]
        taken_out = np.flatnonzero(wrong[:, i])
        if len(taken_out):
            some = np.arange(0, len(error), max(1, len(error) // USUAL))
            scale = float(np.median(np.maximum(floor[some], _around(error, some))))
            wrong[_readmitted(t, column, kept, taken_out, scale), i] = False
            places = np.flatnonzero(wrong[:, i])
            sizes[i] = (
                np.median(np.abs(column[places] - np.interp(t[places], t[kept], column[kept]))) if len(places) else 0.0
            )
    return wrong, sizes


def prediction_errors(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """What measurements (T,) differ by from the cubic through their four neighbours, scaled to the noise of one."""
    rows = np.arange(len(t))
    five = np.clip(rows - 2, 0, len(t) - 5)[:, None] + np.arange(5)  # at the ends the neighbours are on one side
    return _errors(t, y, five[five != rows[:, None]].reshape(-1, 4), t, y)


def _errors(t, y, near, at, value) -> np.ndarray:
    """What values (k,) at stamps (k,) differ by from the cubics through the measurements `near` (k, 4) them, scaled."""
    offsets = (t[near] - at[:, None]) / (t[near[:, -1:]] - t[near[:, :1]])
    weights = np.ones_like(offsets)  # Lagrange's, at zero
    for k in range(4):
        for other in range(4):
            if other != k:
                weights[:, k] *= offsets[:, other] / (offsets[:, other] - offsets[:, k])
    return (value - np.sum(weights * y[near], axis=1)) / np.sqrt(1 + np.sum(weights**2, axis=1))


def _readmitted(t, y, kept: np.ndarray, taken_out: np.ndarray, scale: float) -> np.ndarray:
    """Those of the rows taken out that are near to what the kept ones predict: they were between two outliers."""
    place = np.clip(np.searchsorted(kept, taken_out), 2, len(kept) - 2)
    error = _errors(t[kept], y[kept], place[:, None] + np.array([-2, -1, 0, 1]), t[taken_out], y[taken_out])
    return taken_out[np.abs(error) < FAR * scale]


def _around(error: np.ndarray, rows: np.ndarray, half: int = 25) -> np.ndarray:
    """Median size of the errors around each of some rows, as a standard deviation."""
    padded = np.pad(np.abs(error), half, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    return 1.4826 * np.median(windows[rows], axis=1)


def _moved(y: np.ndarray) -> np.ndarray:
    """How far apart measurements (T,) are among two before and two after each."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(y, 2, mode="edge"), 5)
    return windows.max(axis=1) - windows.min(axis=1)


def tick(y: Float[np.ndarray, "T"]) -> float:
    """The step that all changes of readings (T,) are multiples of; 0 where there is none."""
    changes = np.abs(np.diff(y[np.isfinite(y)]))
    changes = changes[changes > 1e-9 * max(1.0, np.ptp(y[np.isfinite(y)]))]
    if len(changes) < 20:
        return 0.0
    least = float(np.quantile(changes, 0.01))
    for fraction in (1, 2, 3):
        step = least / fraction
        near = changes[changes < 20.5 * step]
        whole = np.rint(near / step)
        if len(near) >= 20 and np.quantile(np.abs(near / step - whole), 0.95) < LATTICE and _gcd(whole) == 1:
            return float(np.sum(near) / np.sum(whole))  # the mean over many ticks, since logs hold few digits
    return 0.0


def _gcd(whole: np.ndarray) -> int:
    return int(np.gcd.reduce(whole.astype(int)))


def quanta(y: Float[np.ndarray, "T n"], noise: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """The ticks (n,) of encoders that readings (T, n) show; 0 where none are seen above the noise (n,)."""
    found = np.array([tick(column) for column in y.T])
    return np.where(found > MOST_TICKS * noise, found, 0.0)


class Rows(NamedTuple):
    """Stamps (T,) [s] of a log, and which rows of its file they are: `first`, counted from 1, and each `every`-th."""

    t: Float[np.ndarray, "T"]
    first: int = 1
    every: int = 1

    def named(self, k: int) -> str:
        """The row k, from 0, of the record, as people find it in the file."""
        return f"row {self.first + k * self.every} ({self.t[k]:.6g} s)"

    def listed(self, places: Sequence[int] | np.ndarray) -> str:
        """The first rows of some, as many as a line holds."""
        shown = ", ".join(self.named(int(k)) for k in places[:MOST_NAMED])
        return f"{shown} and {len(places) - MOST_NAMED} more" if len(places) > MOST_NAMED else shown


def outlier_findings(
    wrong: Bool[np.ndarray, "T n"],
    sizes: Float[np.ndarray, "n"],
    names: tuple[str, ...],
    units: tuple[str, ...],
    rows: Rows,
) -> list[Finding]:
    """A finding for each column with outliers; `sizes` are their usual distances. A few are a note."""
    findings = []
    for name, unit, column, size in zip(names, units, wrong.T, sizes, strict=True):
        places = np.flatnonzero(column)
        if not len(places):
            continue
        share = float(column.mean())
        many = share > FEW_OUTLIERS
        cells = f"{len(places)} of {len(column)} cells ({100 * share:.2g} %) are" if len(places) > 1 else "one cell is"
        findings.append(
            Finding(
                "outliers",
                name,
                f"{cells} far from {'its' if len(places) == 1 else 'their'} neighbours, "
                f"{'usually ' if len(places) > 1 else ''}by {size:.3g} {unit}".rstrip()
                + f": {rows.listed(places)}",
                "look for what disturbs the sensor; estimates refuse such cells, and --score leaves them out"
                if many
                else "nothing to change: estimates refuse such cells; empty them where they are known to be wrong",
                many,
                {"cells": len(places), "share": share, "size": float(size)},
            )
        )
    return findings


def still_findings(
    y: Float[np.ndarray, "T n"], names: tuple[str, ...], units: tuple[str, ...]
) -> tuple[list[Finding], bool]:
    """Findings of positions that have one value in all rows, and whether these are all positions."""
    still = [i for i, column in enumerate(y.T) if np.nanmin(column) == np.nanmax(column)]
    if not still:
        return [], False
    whole = len(still) == len(names)
    values = ", ".join(f"{names[i]} is {np.nanmin(y[:, i]):.6g} {units[i]}".rstrip() for i in still)
    line = "log a motion" if whole else "look at its sensor and its column, or hold that joint in the model as well"
    finding = Finding(
        "nothing moves" if whole else "a position does not move",
        ", ".join(names[i] for i in still),
        f"{values} in all {len(y)} rows",
        f"{line}: nothing can be told from {'this log' if whole else 'it'}",
        whole,
        {"rows": len(y)},
    )
    return [finding], whole


def repeated_findings(
    y: Float[np.ndarray, "T n"], ticks: Float[np.ndarray, "n"], names: tuple[str, ...], rows: Rows
) -> list[Finding]:
    """A finding of readings that are those of the row before, although the position moves.

    An encoder reads the same number until its next tick; a reading with noise is never the same twice.
    """
    moving = [i for i in range(len(names)) if ticks[i] == 0 and np.nanmin(y[:, i]) < np.nanmax(y[:, i])]
    if not moving:
        return []
    same = (np.diff(y[:, moving], axis=0) == 0).all(axis=1)
    places = np.flatnonzero(same) + 1
    share = float(same.mean())
    if share <= FEW_REPEATED and len(places) <= MOST_NAMED:
        return []
    runs = np.diff(np.flatnonzero(np.concatenate([[True], ~same, [True]])))
    usual = int(np.median(runs[runs > 1]))
    return [
        Finding(
            "repeated rows",
            ", ".join(names[i] for i in moving),
            f"{len(places)} of {len(y)} rows ({100 * share:.2g} %) repeat the readings of the row before, usually "
            f"{usual} in a row have the same: {rows.listed(places)}",
            "the sensor is slower than the log, or rows were copied: leave the cells that repeat empty",
            share > FEW_REPEATED,
            {"rows": len(places), "share": share, "in_a_row": usual},
        )
    ]
