"""Windows of logs over which a model predicts: short stretches of a log, with the motion at the start of each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from covariant.signals import AnyArray, Record

MOST_ROWS = 20_000
"""Largest number of rows that the windows of a fit hold: windows are left out evenly beyond."""
FEWEST_ROWS, FEWEST_WINDOWS = 12, 8
"""Least number of rows of a window, and of windows of a fit."""
LONGEST_GAP = 5.0
"""A window holds no step longer than so many median steps: after a gap in the stamps the log begins anew."""
BETWEEN_LOGS = 1e9
"""Step [s] put between the inputs of two logs: a lag of the first has died away in the second."""


class Windows(NamedTuple):
    """W windows of L steps each from one or more logs, and the inputs of the whole logs.

    - `t` (W, L + 1) [s], `y` (W, L + 1, ...): stamps and measured positions, NaN where missing; a shorter window is
      filled up with its last stamp and missing positions.
    - `v` (W, L + 1, n): reference velocities, of which the first is where the search for a window's initial velocity
      starts.
    - `rows` (W, L): the row of `inputs` that acts in each step.
    - `inputs` (S, m), `steps` (S,): the inputs of all rows, and the time since the row before [s].
    """

    t: Float[AnyArray, "*k W L1"]
    y: AnyArray
    v: Float[AnyArray, "*k W L1 n"]
    rows: Int[AnyArray, "*k W L"]
    inputs: Float[AnyArray, "*k S m"]
    steps: Float[AnyArray, "*k S"]


def horizon(record: Record, velocity: Float[np.ndarray, "T n"], part: float = 1.0) -> float:
    """A length of the windows [s] that suits a motion: twice the time in which its velocity becomes another one.

    That is the least time τ, of a geometric sequence, after which `v(t + τ) − v(t)` is as large as v itself, root mean
    square over the log, in units of each velocity. Over much shorter times a position hardly shows a force, and over
    much longer ones errors of the initial velocity and of the model grow beyond the range of a linearisation.

    - `velocity` (T, n): reference velocities, such as `scoring.zero_phase_velocity` gives.
    - `part`: fraction of the record that must still hold enough windows, such as what is held out.
    """
    t = np.asarray(record.t)
    step, span = float(np.median(np.diff(t))), float(t[-1] - t[0])
    size = np.sqrt(np.nanmean(velocity**2, axis=0))
    relative = velocity[:, size > 0] / size[size > 0]
    least, most = FEWEST_ROWS * step, span * min(1 / (2 * FEWEST_WINDOWS), part / (FEWEST_WINDOWS + 1))
    if least >= most or not relative.size:
        return max(least, min(most, span / 2))
    times = np.geomspace(least, most, 40)
    for time in times:
        later = np.searchsorted(t, t + time / 2)
        inside = later < len(t)
        change = relative[later[inside]] - relative[inside]
        if np.nanmean(change**2) >= 1.0:
            return float(time)
    return float(most)


def windows(
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    length: float,
    spans: Sequence[tuple[float, float]] | None = None,
) -> Windows:
    """Windows of a length [s], one after the other, over records with their reference velocities (T, n).

    - `spans`: the part of each record [s] to take, from its first stamp to before its second; all of it by default.
      The inputs before it still act through their lag.

    A window starts where the whole position is measured. Raises `ValueError` where there are too few windows.
    """
    spans = [(-np.inf, np.inf)] * len(records) if spans is None else spans
    found: list[tuple[int, np.ndarray]] = []
    longest = 0
    for k, (record, velocity, (begin, end)) in enumerate(zip(records, velocities, spans, strict=True)):
        t = np.asarray(record.t)
        known = np.concatenate([np.asarray(record.y).reshape(len(t), -1), velocity], axis=1)
        whole = np.asarray(np.isfinite(known).all(axis=1))
        pieces = _pieces(t, whole, length, begin, end)
        found += [(k, piece) for piece in pieces]
        longest = max([longest, *(len(piece) for piece in pieces)])
    kept = max(1, MOST_ROWS // max(longest, 1))
    if len(found) > kept:
        found = [found[i] for i in np.linspace(0, len(found) - 1, kept).round().astype(int)]
    if len(found) < FEWEST_WINDOWS:
        raise ValueError(
            f"the log holds {len(found)} windows of {length:.3g} s with at least {FEWEST_ROWS} rows and no gap, and "
            f"{FEWEST_WINDOWS} are needed; give a longer log, or a shorter horizon"
        )
    offsets = np.concatenate([[0], np.cumsum([len(np.asarray(record.t)) for record in records])])
    index = np.stack([_padded(piece, longest) for _, piece in found])
    real = np.arange(longest) < np.array([len(piece) for _, piece in found])[:, None]
    rows = index + np.array([offsets[k] for k, _ in found])[:, None]
    t, y, v, u = (
        np.concatenate(parts)
        for parts in zip(
            *((np.asarray(r.t), np.asarray(r.y), w, np.asarray(r.u)) for r, w in zip(records, velocities, strict=True)),
            strict=True,
        )
    )
    y = y[rows].astype(float)
    y[~real] = np.nan
    steps = np.diff(t, prepend=t[:1] - BETWEEN_LOGS)
    steps[offsets[:-1]] = BETWEEN_LOGS
    return Windows(t[rows], y, v[rows], rows[:, :-1], u, steps)


def _pieces(t: np.ndarray, whole: np.ndarray, length: float, begin: float, end: float) -> list[np.ndarray]:
    """The rows of each window of one record; no row is in two of them, so that their errors are independent."""
    step = float(np.median(np.diff(t)))
    starts = np.flatnonzero(whole & (t >= begin) & (t < end))
    pieces, at = [], 0
    while at < len(starts):
        first = starts[at]
        last = int(np.searchsorted(t, min(t[first] + length + step / 2, end)))  # the row after the window
        gaps = np.flatnonzero(np.diff(t[first:last]) > LONGEST_GAP * step)
        whole_length = t[last - 1] - t[first] > 0.9 * length
        if gaps.size:
            last = first + int(gaps[0]) + 1
        if last - first > FEWEST_ROWS and (gaps.size or whole_length):
            pieces.append(np.arange(first, last))
        at = int(np.searchsorted(starts, last))
    return pieces


def _padded(rows: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([rows, np.full(length - len(rows), rows[-1])])
