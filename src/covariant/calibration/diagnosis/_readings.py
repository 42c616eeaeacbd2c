"""What the readings of positions show without a model: outliers, repeats, ticks, noise and speeds."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._finding import Finding, Rows
from covariant.calibration.diagnosis._thresholds import (
    ALTERNATES,
    ALTERNATES_WHOLLY,
    COARSE,
    FAR,
    FEW_OUTLIERS,
    LEAST_TICK,
    STATED_LATTICE,
)
from covariant.logs import Register
from covariant.models import MechanicalSystem
from covariant.scoring import unwrap
from covariant.signals import Record

ROUNDS = 30
"""Largest number of rounds in which outliers are removed and the rest is predicted anew."""
SAMPLED = 20_000
"""Rows of a long log from which the usual error is estimated."""
FEWEST = 50
"""Least number of readings of a position that show its noise and outliers."""
ALIKE = 0.05
"""Relative difference up to which the numbers of coordinates of one unit are reported as one."""
ROUNDING = 1e-9
"""Differences of readings, relative to the largest of them, up to which they are rounding errors and no change."""
UNEVEN, HALF = 10.0, 25
"""Largest noise around a reading relative to the usual one, and the rows on either side from which it is estimated."""
AMID = 6
"""Rows on either side of one of which half are outliers, from which it belongs to their run."""
TOGETHER = 5
"""Number of neighbouring speeds of which the median is taken: one wrong measurement spoils two."""
NEIGHBOURS = (4, 6, 8, 10)
"""Numbers of neighbours that predict a reading: the fewest whose errors are noise, and not motion between the rows."""
BESIDE = 7
"""Steps from reading to reading of which the median is the motion."""
LONGEST_BURST, MOST_JUMPS, SAME_MOTION, FAST = 50, 0.1, 0.1, 4.0
"""Most rows of a run of wrong readings, the fraction of steps that jump from which there are no such runs, the
difference of the motions before and after it as a fraction of its jumps, and the usual step relative to the noise from
which jumps are compared with it."""
USUAL = 0.99
"""Quantile of these medians: high, since a log may stand still for a long time."""


def missing_cells(y: np.ndarray) -> list[Finding]:
    """Finding on missing measurements."""
    lost = np.isnan(y.reshape(len(y), -1)).any(axis=1)
    if not lost.any():
        return []
    share = float(lost.mean())
    # The mask changes in pairs: where a gap begins, and where it ends.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]])))
    longest = int(np.max(edges[1::2] - edges[::2]))
    evidence = f"{int(lost.sum())} of {len(y)} rows ({100 * share:.2g} %) lack one, at most {longest} in a row"
    line = "nothing to change: estimates run on with the model alone meanwhile"
    numbers = {"rows": int(lost.sum()), "share": share, "longest": longest}
    return [Finding("missing measurements", "", evidence, line, False, numbers)]


def outliers(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"], circles: tuple[int, ...], ticks: Any = 0.0
) -> tuple[Bool[np.ndarray, "T n"], Float[np.ndarray, "n"]]:
    """Detect outliers among position measurements, without a model.

    Each measurement is predicted by the cubic through two before and two after it. The worst one in each neighbourhood
    is removed, and its neighbours are predicted anew, until no error is large.

    Args:
        t: Stamps (T,) [s].
        y: Measured coordinates (T, n); NaN where missing.
        circles: Indices of the coordinates that are angles.
        ticks: Known ticks (n,) of the encoders, or one for all, 0 for none; others are looked for in the readings.

    Returns:
        Which measurements are outliers (T, n), and their usual distance (n,) from their neighbours, 0 without outliers.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import outliers
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> y = np.sin(2 * t)[:, None]
        >>> y[100] += 1.0
        >>> wrong, distance = outliers(t, y, circles=())
        >>> np.flatnonzero(wrong).tolist(), distance.round(2).tolist()
        ([100], [1.0])
    """
    y = np.array(y, float)
    wrong, sizes = np.zeros(y.shape, bool), np.zeros(y.shape[1])
    for i, known in enumerate(np.broadcast_to(ticks, y.shape[1])):
        around = (0,) if i in circles else ()
        seen = np.flatnonzero(np.isfinite(y[:, i]))
        wrong[seen, i] = _bursts(t[seen], unwrap(y[seen, i : i + 1], around)[:, 0], known, 2 * np.pi * len(around))
        # Wrong readings may be half a turn apart, so that the readings after them are on another turn.
        column = unwrap(np.where(wrong, np.nan, y)[:, i : i + 1], around)[:, 0]
        remaining, error, floor = np.flatnonzero(np.isfinite(column)), np.zeros(1), np.zeros(1)
        for _ in range(ROUNDS):
            if len(remaining) < FEWEST:
                break
            error = prediction_errors(t[remaining], column[remaining])
            floor = np.maximum(1.4826 * np.median(np.abs(error)), known or Register.of(column[remaining]).tick)
            # A cubic misses some of a sharp motion, in proportion to what happens among its points.
            floor = np.maximum(floor, COARSE * _local_range(column[remaining]))
            size = np.zeros(len(remaining))
            candidates = np.flatnonzero(np.abs(error) > FAR * floor)  # few: only they need the local deviation
            # In a long burst most neighbours are wrong too, but no noise is so many times as large as elsewhere.
            most = UNEVEN * max(float(np.median(np.abs(error))), float(np.median(floor)))
            scale = np.maximum(floor[candidates], np.minimum(local_std(error, candidates), most))
            off = np.abs(error[candidates])
            size[candidates] = np.where(off > FAR * np.where(scale > 0, scale, np.inf), off, 0.0)
            # Only the worst of seven neighbours is removed at a time: it spoils the predictions of the others.
            bad = (size > 0) & (size == np.max([np.roll(size, k) for k in (-3, -2, -1, 0, 1, 2, 3)], axis=0))
            if not bad.any():
                break
            wrong[remaining[bad], i] = True
            remaining = remaining[~bad]
        while (amid := _amid(wrong[:, i]) & ~wrong[:, i]).any():
            wrong[:, i] |= amid
        remaining, removed = remaining[~wrong[remaining, i]], np.flatnonzero(wrong[:, i])
        if len(removed):
            sampled = np.arange(0, len(error), max(1, len(error) // SAMPLED))
            scale = float(np.median(np.maximum(floor[sampled], local_std(error, sampled))))
            wrong[_readmit_rows(t, column, remaining, removed, scale), i] = False
            places = np.flatnonzero(wrong[:, i])
            off = np.abs(y[places, i] - np.interp(t[places], t[remaining], y[remaining, i]))
            sizes[i] = np.median(off) if len(places) else 0.0
    return wrong, sizes


def prediction_errors(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"], neighbours: int = 4
) -> Float[np.ndarray, "T"]:
    """Errors of measurements against the polynomial through their neighbours, scaled to the noise of one."""
    rows = np.arange(len(t))
    # At the ends the neighbours are on one side.
    around = np.clip(rows - neighbours // 2, 0, len(t) - neighbours - 1)[:, None] + np.arange(neighbours + 1)
    return _errors(t, y, around[around != rows[:, None]].reshape(-1, neighbours), t, y)


def _errors(t, y, neighbours, at, value) -> np.ndarray:
    """Scaled errors of values (k,) at stamps (k,) against the polynomials through the `neighbours` (k, p)."""
    # In units of the span, so that the products below are of order one whatever the unit of time.
    offsets = (t[neighbours] - at[:, None]) / (t[neighbours[:, -1:]] - t[neighbours[:, :1]])
    weights = np.ones_like(offsets)  # Lagrange's, at zero
    count = neighbours.shape[1]
    for k in range(count):
        for other in range(count):
            if other != k:
                weights[:, k] *= offsets[:, other] / (offsets[:, other] - offsets[:, k])
    # The variance of an error is that of the measurement and of its weighted neighbours.
    return (value - np.sum(weights * y[neighbours], axis=1)) / np.sqrt(1 + np.sum(weights**2, axis=1))


def sudden_steps(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T1"]:
    """Steps from reading to reading beyond the motion, which is the median of the neighbouring steps."""
    steps, passed = np.diff(y), np.diff(t)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(steps / passed, BESIDE // 2, mode="edge"), BESIDE)
    return steps - np.median(windows, axis=1) * passed


def _bursts(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"], tick: float, turn: float) -> Bool[np.ndarray, "T"]:
    """Runs of readings to which neither the motion before nor that after leads, while each leads to the other.

    A single reading is predicted by its neighbours; of a run they are wrong as well.
    """
    wrong = np.zeros(len(y), bool)
    if len(y) < FEWEST:
        return wrong
    sudden = sudden_steps(t, y)
    motion = float(np.quantile(np.abs(np.diff(y)), 0.9))
    least = max(tick or Register.of(y).tick, motion / FAST, np.finfo(float).tiny)
    usual = np.maximum(local_std(sudden, np.arange(len(sudden))), least)
    jumps = np.flatnonzero(np.abs(sudden) > FAR * usual)
    jumps = jumps[(jumps >= 2) & (jumps < len(y) - 3)] if len(jumps) < MOST_JUMPS * len(y) else jumps[:0]
    for k in jumps:
        for j in jumps[(jumps > k + 1) & (jumps <= k + LONGEST_BURST)]:
            # Rows k + 1 to j are the run: readings against the motion with the mean of the speeds beside it.
            speed = np.mean([(y[b] - y[a]) / (t[b] - t[a]) for a, b in ((k - 2, k), (j + 1, j + 3))])
            off = y[k + 1 : j + 2] - y[k] - speed * (t[k + 1 : j + 2] - t[k])
            off = np.abs(off - turn * np.rint(off / turn) if turn else off)
            size = min(abs(sudden[k]), abs(sudden[j]))
            if not wrong[k] and off[-1] < max(SAME_MOTION * size, FAR * usual[k]) < size / 2:
                wrong[k + 1 : j + 1] = off[:-1] > size / 2
                break
    return wrong


def _amid(wrong: Bool[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    """Rows most of whose neighbours are wrong on both sides: by chance a reading of a burst fits among the others."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(wrong, AMID), 2 * AMID + 1)
    before, after = around[:, :AMID].sum(axis=1), around[:, AMID + 1 :].sum(axis=1)
    return (before + after >= AMID) & (np.minimum(before, after) > 0)


def _readmit_rows(t, y, remaining: np.ndarray, removed: np.ndarray, scale: float) -> np.ndarray:
    """Removed rows that agree with the remaining ones after all: they were between two outliers."""
    # Two rows on either side of the removed one; at the ends the nearest four.
    place = np.clip(np.searchsorted(remaining, removed), 2, len(remaining) - 2)
    error = _errors(t[remaining], y[remaining], place[:, None] + np.array([-2, -1, 0, 1]), t[removed], y[removed])
    return removed[np.abs(error) < FAR * scale]


def local_std(error: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Robust standard deviation of the errors around each of some rows."""
    padded = np.pad(np.abs(error), HALF, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF + 1)
    return 1.4826 * np.median(windows[rows], axis=1)


def _local_range(y: np.ndarray) -> np.ndarray:
    """Range of the measurements (T,) among two before and two after each."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(y, 2, mode="edge"), 5)
    return windows.max(axis=1) - windows.min(axis=1)


def quanta(y: Float[np.ndarray, "T n"], noise: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Ticks of encoders, from their readings."""
    ticks = np.array([Register.of(column).tick for column in y.T])
    return np.where(ticks > LEAST_TICK * noise, ticks, 0.0)


def outlier_findings(
    wrong: Bool[np.ndarray, "T n"],
    sizes: Float[np.ndarray, "n"],
    names: tuple[str, ...],
    units: tuple[str, ...],
    rows: Rows,
) -> list[Finding]:
    """Findings on columns with outliers; a few outliers are only a note."""
    findings = []
    for name, unit, column, size in zip(names, units, wrong.T, sizes, strict=True):
        places = np.flatnonzero(column)
        if not len(places):
            continue
        share = float(column.mean())
        many = share > FEW_OUTLIERS
        cells, by = "one cell is far from its neighbours", f"by {size:.3g} {unit}".rstrip()
        if len(places) > 1:
            cells = f"{len(places)} of {len(column)} cells ({100 * share:.2g} %) are far from their neighbours"
            by = f"usually {by}"
        line = "nothing to change: estimates refuse such cells; empty them where they are known to be wrong"
        if many:
            line = "look for what disturbs the sensor; estimates refuse such cells, and scores leave them out"
        evidence = f"{cells}, {by}: {rows.listed_runs(places)}"
        numbers = {"cells": len(places), "share": share, "size": float(size)}
        findings.append(Finding("outliers", name, evidence, line, many, numbers))
    return findings


def still_findings(
    y: Float[np.ndarray, "T n"], names: tuple[str, ...], units: tuple[str, ...]
) -> tuple[list[Finding], bool]:
    """Findings on positions that have one value in all rows."""
    still = [i for i, column in enumerate(y.T) if np.nanmin(column) == np.nanmax(column)]
    if not still:
        return [], False
    whole = len(still) == len(names)
    values = ", ".join(f"{names[i]} is {np.nanmin(y[:, i]):.6g} {units[i]}".rstrip() for i in still)
    what, line = "nothing moves", "log a motion: nothing can be told from this log"
    if not whole:
        what = "a position does not move"
        line = "look at its sensor and its column, or hold it in the model as well: nothing can be told from it"
    where, evidence = ", ".join(names[i] for i in still), f"{values} in all {len(y)} rows"
    return [Finding(what, where, evidence, line, whole, {"rows": len(y)})], whole


class Readings(NamedTuple):
    """Noise and ticks of each position, in its unit.

    Attributes:
        noise: Standard deviation (n,) of the part of a reading that its neighbours do not predict; NaN for few.
        white: Whether that is noise (n,); otherwise motion between the rows counts as well, and it is an upper bound.
        ticks: One tick (n,) of the encoder; 0 where readings are no whole ticks apart, or noise hides them.
    """

    noise: Float[np.ndarray, "n"]
    white: Bool[np.ndarray, "n"]
    ticks: Float[np.ndarray, "n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Standard deviation (n,) of a reading: that of an error uniform over a tick, or the noise."""
        return np.where(self.ticks > 0, self.ticks / np.sqrt(12), self.noise)

    @property
    def known(self) -> bool:
        """Whether every position has enough readings."""
        return bool(np.isfinite(self.noise).all())


def readings(record: Record, circles: tuple[int, ...]) -> Readings:
    """Estimate noise and ticks of each position of a record."""
    t, y = np.asarray(record.t), unwrap(np.asarray(record.y), circles)
    noise, white = np.full(y.shape[1], np.nan), np.zeros(y.shape[1], bool)
    for i, column in enumerate(y.T):
        seen = np.isfinite(column)
        if seen.sum() > FEWEST:
            noise[i], white[i] = _noise(t[seen], column[seen])
    return Readings(noise, white, quanta(y, np.nan_to_num(noise)))


def _noise(t: np.ndarray, y: np.ndarray) -> tuple[float, bool]:
    """Noise of a column, and whether it is white; otherwise the noise is an upper bound."""
    noise, white = np.inf, False
    for neighbours in NEIGHBOURS:
        error = prediction_errors(t, y, neighbours)
        # The factor makes the median size of normal errors their standard deviation.
        noise = min(noise, 1.4826 * float(np.median(np.abs(error))))
        # Neighbouring errors share measurements with opposite signs: those of white noise alternate. At even stamps the
        # weights of p neighbours are binomial, as (1, −4, 6, −4, 1)/6: the correlation of white noise is −p/(p + 1),
        # that of smooth motion positive. What many neighbours do not predict of a fast motion alternates as well.
        usual = neighbours / (neighbours + 1)
        least = ALTERNATES if neighbours == NEIGHBOURS[0] else ALTERNATES_WHOLLY * usual
        white = bool(np.mean(error[1:] * error[:-1]) < least * np.mean(error**2))
        if white:
            break
    return noise, white


def known_ticks(
    record: Record, circles: tuple[int, ...], stated: float | Sequence[float] | None
) -> Float[np.ndarray, "n"]:
    """Ticks of each position: those that the readings show, or where these are few, the stated ones that they fit."""
    ticks, y = readings(record, circles).ticks, unwrap(np.asarray(record.y), circles)
    for i, tick in enumerate(np.broadcast_to(0.0 if stated is None else stated, len(ticks))):
        if ticks[i] == 0 and tick > 0:
            steps = np.diff(y[np.isfinite(y[:, i]), i]) / tick
            if len(steps) and np.quantile(np.abs(steps - np.round(steps)), 0.95) < STATED_LATTICE:
                ticks[i] = tick
    return ticks


def one_or_each(values: Float[np.ndarray, "n"], units: Sequence[str], digits: int) -> float | tuple[float, ...]:
    """Round the numbers of the coordinates, and merge those that are nearly equal."""
    rounded = tuple(float(f"{value:.{digits}g}") for value in values)
    alike = len(set(units)) <= 1 and np.ptp(values) <= ALIKE * np.max(values)
    return rounded[int(np.argmax(values))] if alike else rounded


def shown(values: Sequence[float] | np.ndarray, units: Sequence[str], digits: int) -> str:
    """Text of the numbers of coordinates with their units; equal ones appear once."""
    texts = (f"{value:.{digits}g} {unit}".rstrip() for value, unit in zip(values, units, strict=True))
    if len(set(units)) == 1 and np.ptp(values) <= ALIKE * np.max(values):
        return f"{np.max(values):.{digits}g} {units[0]}".rstrip()
    return ", ".join(dict.fromkeys(texts))


def written(value: float | tuple[float, ...]) -> str:
    """Text of one number, or of one for each coordinate, in the syntax of a model file."""
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)


def usual_speeds(model: MechanicalSystem, record: Record) -> tuple[float, ...]:
    """Usual size of each velocity in a record, from differences of neighbouring positions.

    Args:
        model: The mechanical system, whose manifold says which coordinates are angles.
        record: The log; measurements may be missing or wrong.

    Returns:
        The speeds (n,) [rad/s or m/s]; zero where too little was measured.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import usual_speeds
        >>> from covariant.models import oscillator
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> speeds = usual_speeds(oscillator(), Record(t, y=0.5 * np.sin(2 * t)[:, None]))
        >>> [round(speed, 2) for speed in speeds]
        [1.0]
    """
    t, y, manifold = np.asarray(record.t), np.asarray(record.y), model.manifold
    if manifold.commuting:
        columns = [(t[seen], column[seen, None]) for column in y.T for seen in (np.isfinite(column),)]
        circles = manifold.circles
        speeds = [np.abs(_wrap_change(np.diff(q[:, 0]), i in circles) / np.diff(s)) for i, (s, q) in enumerate(columns)]
        return tuple(_usual(rates) for rates in speeds)
    complete = np.isfinite(y).reshape(len(t), -1).all(axis=1)
    displacement = jax.jit(jax.vmap(manifold.local))(jnp.asarray(y[complete][:-1]), jnp.asarray(y[complete][1:]))
    rates = np.abs(np.asarray(displacement)) / np.diff(t[complete])[:, None]
    return tuple(_usual(column) for column in rates.T)


def _wrap_change(change: np.ndarray, circle: bool) -> np.ndarray:
    # Onto [−π, π): a step of more than half a turn is one the other way.
    return (change + np.pi) % (2 * np.pi) - np.pi if circle else change


def _usual(rates: np.ndarray) -> float:
    if len(rates) < TOGETHER:
        return 0.0
    medians = np.median(np.lib.stride_tricks.sliding_window_view(rates, TOGETHER), axis=1)
    return float(np.quantile(medians, USUAL))
