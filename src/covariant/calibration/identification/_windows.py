"""Windows of logs over which a model predicts, each with the motion at its start, and those that are held out."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from covariant._linalg import known_rms
from covariant.signals import AnyArray, Record
from scalargraph.errors import InputError

MOST_ROWS = 20_000
"""Largest number of rows in the windows of a fit; beyond it windows are left out evenly."""
FEWEST_ROWS, FEWEST_WINDOWS = 12, 8
"""Least number of rows of a window, and of windows of a fit."""
LONGEST_GAP = 5.0
"""Longest step of a window, in median steps: after a longer gap in the stamps a new window begins."""
FITTED = 2 / 3
"""Fraction of a log, its first part, that a fit to it alone or a tuning uses; the rest is held out."""
BETWEEN_LOGS = 1e9
"""Step [s] put between the inputs of two logs, so that a lag of the first has died away in the second."""


class Windows(NamedTuple):
    """W windows of L steps each from one or more logs, and the inputs of the whole logs.

    Attributes:
        t: Stamps (W, L + 1) [s]; a shorter window is padded with its last stamp and missing positions.
        y: Measured positions (W, L + 1, ...), NaN where missing.
        v: Reference velocities (W, L + 1, n); at the first the search for a window's initial velocity starts.
        rows: Row (W, L) of `inputs` that acts in each step.
        inputs: Inputs (S, m) of all rows of the logs.
        steps: Time (S,) since the row before [s].
        machine: Index (W,) of the machine whose log a window is from, of several with numbers of their own.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import cut_windows
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.02)
        >>> pieces = cut_windows([Record(t, y=np.sin(t)[:, None])], [np.cos(t)[:, None]], length=1.0)
        >>> pieces.t.shape, pieces.v.shape, pieces.inputs.shape
        ((9, 51), (9, 51, 1), (500, 0))
    """

    t: Float[AnyArray, "*k W L1"]
    y: AnyArray
    v: Float[AnyArray, "*k W L1 n"]
    rows: Int[AnyArray, "*k W L"]
    inputs: Float[AnyArray, "*k S m"]
    steps: Float[AnyArray, "*k S"]
    machine: Int[AnyArray, "*k W"]

    def of_machines(self, machines: Sequence[int]) -> "Windows":
        """The windows of some machines, in rising order, as those of a fit to their logs alone."""
        theirs = np.isin(self.machine, machines)
        t, y, v, rows, machine = (
            np.asarray(each)[theirs] for each in (self.t, self.y, self.v, self.rows, self.machine)
        )
        return Windows(t, y, v, rows, self.inputs, self.steps, np.searchsorted(machines, machine))


def horizon(record: Record, velocity: Float[np.ndarray, "T n"], part: float = 1.0, count: int = 1) -> float:
    """Length of the windows that suits a motion: twice the time in which its velocity changes by its own size.

    That is the least τ, of a geometric sequence, for which `v(t + τ/2) − v(t)` is as large as v itself, root mean
    square over the log, in units of each velocity. Over much shorter times a position hardly shows a force, and over
    much longer ones errors of the initial velocity and of the model grow beyond the range of a linearisation.

    Args:
        record: The log.
        velocity: Reference velocities (T, n), as from `scoring.zero_phase_velocity`.
        part: Fraction of the record that must still contain enough windows, such as the held-out part.
        count: Number of records like this one that are cut into windows together: of short ones a window may be the
            longer, the more there are.

    Returns:
        The length [s].

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import horizon
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 60.0, 0.05)
        >>> round(horizon(Record(t, y=np.sin(t)[:, None]), np.cos(t)[:, None]))  # about 2 π / 3
        2
    """
    t = np.asarray(record.t)
    step, span = float(np.median(np.diff(t))), float(t[-1] - t[0])
    size = known_rms(velocity)
    relative = velocity[:, size > 0] / size[size > 0]
    # Room for twice the windows that a fit needs, and for one more than it needs in the part.
    least, most = FEWEST_ROWS * step, span * min(1 / (2 * FEWEST_WINDOWS), part / (FEWEST_WINDOWS + 1))
    if count > 1 and most < least:
        # A third of the records is held out, and each of them holds a whole number of windows that share no row.
        each = max(1, math.ceil(FEWEST_WINDOWS / max(1, count // 3)))
        most = (span + step) / each - 1.5 * step
    if least >= most or not relative.size:
        return max(least, min(most, span / 2))
    times = np.geomspace(least, most, 40)
    for time in times:
        later = np.searchsorted(t, t + time / 2)
        inside = later < len(t)
        change = relative[later[inside]] - relative[inside]
        if known_rms(change, (0, 1)) >= 1.0:
            return float(time)
    return float(most)


def cut_windows(
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    length: float,
    spans: Sequence[tuple[float, float]] | None = None,
    machines: Sequence[int] | None = None,
) -> Windows:
    """Cut records into consecutive windows of one length.

    A window starts where the whole position is measured.

    Args:
        records: The logs.
        velocities: Reference velocities (T, n) of each.
        length: Length of the windows [s].
        spans: Part of each record [s] to use, from its first stamp to before its second; all of it by default. The
            inputs before it still act through their lag.
        machines: Index of the machine of each record; by default one machine has made all.

    Returns:
        The windows.

    Raises:
        ValueError: There are too few windows, or nothing moves.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import cut_windows
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 20.0, 0.02)
        >>> record, v = Record(t, y=np.sin(t)[:, None]), np.cos(t)[:, None]
        >>> later = cut_windows([record], [v], length=1.0, spans=[(8.0, 20.0)])
        >>> round(float(later.t.min()), 6), len(later.t)
        (8.0, 11)
    """
    if all((velocity == 0.0).all() for velocity in velocities):  # an unknown velocity is not zero
        raise InputError("nothing moves in the logs, so that they tell no parameter; log a motion")
    spans = [(-np.inf, np.inf)] * len(records) if spans is None else spans
    selected: list[tuple[int, np.ndarray]] = []
    longest = 0
    for k, (record, velocity, (begin, end)) in enumerate(zip(records, velocities, spans, strict=True)):
        t = np.asarray(record.t)
        numbers = np.concatenate([np.asarray(record.y).reshape(len(t), -1), velocity], axis=1)
        whole = np.asarray(np.isfinite(numbers).all(axis=1))
        pieces = _pieces(t, whole, length, begin, end)
        selected += [(k, piece) for piece in pieces]
        longest = max([longest, *(len(piece) for piece in pieces)])
    limit = max(1, MOST_ROWS // max(longest, 1))
    if len(selected) > limit:
        selected = [selected[i] for i in np.linspace(0, len(selected) - 1, limit).round().astype(int)]
    if len(selected) < FEWEST_WINDOWS:
        raise InputError(
            f"the log holds {len(selected)} windows of {length:.3g} s with at least {FEWEST_ROWS} rows and no gap, and "
            f"{FEWEST_WINDOWS} are needed; give a longer log, or a shorter horizon"
        )
    offsets = np.concatenate([[0], np.cumsum([len(np.asarray(record.t)) for record in records])])
    index = np.stack([_pad_rows(piece, longest) for _, piece in selected])
    real = np.arange(longest) < np.array([len(piece) for _, piece in selected])[:, None]
    rows = index + np.array([offsets[k] for k, _ in selected])[:, None]
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
    machine = np.zeros(len(records), int) if machines is None else np.asarray(machines)
    return Windows(t[rows], y, v[rows], rows[:, :-1], u, steps, machine[[k for k, _ in selected]])


def _pieces(t: np.ndarray, whole: np.ndarray, length: float, begin: float, end: float) -> list[np.ndarray]:
    """Rows of each window of one record; no row is in two of them, so that their errors are independent."""
    step = float(np.median(np.diff(t)))
    starts = np.flatnonzero(whole & (t >= begin) & (t < end))
    pieces, at = [], 0
    while at < len(starts):
        first = starts[at]
        # Half a step of slack, for stamps that are rounded.
        last = int(np.searchsorted(t, min(t[first] + length + step / 2, end)))  # the row after the window
        gaps = np.flatnonzero(np.diff(t[first:last]) > LONGEST_GAP * step)
        whole_length = t[last - 1] - t[first] > 0.9 * length
        if gaps.size:
            last = first + int(gaps[0]) + 1
        if last - first > FEWEST_ROWS and (gaps.size or whole_length):
            pieces.append(np.arange(first, last))
        at = int(np.searchsorted(starts, last))
    return pieces


def _pad_rows(rows: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([rows, np.full(length - len(rows), rows[-1])])


def split_windows(
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    length: float,
    machines: Sequence[int] | None = None,
) -> tuple[Windows, Windows]:
    """Cut windows to fit, and held-out ones: of several records of a machine the last; if no machine has several, the
    last third of each."""
    machines = [0] * len(records) if machines is None else machines
    last = held_out_logs([np.asarray(record.t) for record in records], length, machines)
    if last.any():

        def cut(chosen: list[int]) -> Windows:
            kept, speeds = [records[k] for k in chosen], [velocities[k] for k in chosen]
            return cut_windows(kept, speeds, length, machines=[machines[k] for k in chosen])

        return cut(np.flatnonzero(~last).tolist()), cut(np.flatnonzero(last).tolist())
    ends = [(float(record.t[0]), float(record.t[-1])) for record in records]
    borders = [begin + FITTED * (end - begin) for begin, end in ends]
    first, rest = [(-np.inf, border) for border in borders], [(border, np.inf) for border in borders]
    fitted, held_out = (cut_windows(records, velocities, length, spans, machines) for spans in (first, rest))
    return fitted, held_out


def held_out_logs(
    stamps: Sequence[Float[np.ndarray, "_"]], length: float, machines: Sequence[int]
) -> Bool[np.ndarray, "K"]:
    """Logs (K,) that are held out: of each machine with several the least number of the last that hold enough windows,
    and less than half of them."""
    # Windows share no row, so that each takes a step more than its length.
    counts = np.array([int(len(t) / (length / np.median(np.diff(t)) + 1) + 1e-9) for t in stamps])
    held_out = np.zeros(len(counts), bool)
    for machine in set(machines):
        own = np.flatnonzero(np.asarray(machines) == machine)
        last = 1
        while sum(counts[own[-last:]]) < FEWEST_WINDOWS and last < (len(own) - 1) // 2:
            last += 1
        held_out[own[-last:]] = len(own) > 1
    return held_out
