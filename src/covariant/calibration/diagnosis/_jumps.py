"""Jumps between neighbouring readings that are no motion: an encoder that wraps or loses its zero, a second sender."""

import heapq
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding, Names, Rows, stated_time
from covariant.calibration.diagnosis._readings import FEWEST, local_std, prediction_errors, sudden_steps
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import (
    ALL_JUMPS,
    APART,
    BETWEEN_ENDS,
    FAR,
    FEWEST_WRAPS,
    GAP,
    MINORITY,
    OFF_ZERO,
    SAME_JUMP,
    SUDDEN,
    WHOLE_RANGE,
)
from covariant.scoring import unwrap

MOST_TOGETHER = 6
"""Rows between two readings of one sender up to which readings of the other one count as in turn with them."""
HYPOTHESES = 8
"""Number of assignments of readings to two motions that are followed."""
SAME_TICKS, SAME_TURN = 1e-4, 5e-3
"""Relative difference of a period from a whole fraction of a turn up to which it is that: with known ticks, and not."""
MOST_ZEROS = 3
"""Largest number of jumps that are tried as a shift of the zero, the largest first."""
MOST_DIVISIONS = 1000
"""Largest whole number of periods in a turn that a message names."""


def periods(
    t: Float[np.ndarray, "T"],
    y: Float[np.ndarray, "T n"],
    ticks: Float[np.ndarray, "n"],
    circles: tuple[int, ...] = (),
) -> Float[np.ndarray, "n"]:
    """Periods (n,) at which readings wrap; 0 for those that do not, and for angles on a circle that wrap at 2π."""
    seen = [np.isfinite(column) for column in y.T]
    found = [_period(t[rows], y[rows, i], tick) for i, (rows, tick) in enumerate(zip(seen, ticks, strict=True))]
    return without_full_turns(np.array(found), circles)


def without_full_turns(found: Float[np.ndarray, "n"], circles: tuple[int, ...]) -> Float[np.ndarray, "n"]:
    """Periods without those of angles on a circle that wrap at 2π, which the model already handles."""
    whole = [i in circles and math.isclose(size, 2 * np.pi, rel_tol=SAME_JUMP) for i, size in enumerate(found)]
    return np.where(whole, 0.0, found)


def _period(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"], tick: float) -> float:
    """Period of one column: all its jumps have this size, and its readings lie in an interval of this length."""
    if len(y) < FEWEST:
        return 0.0
    steps = np.diff(y)
    span = float(np.ptp(y))
    # Most columns have no step of half their range, so that this ends here.
    if np.count_nonzero(np.abs(steps) > WHOLE_RANGE / 2 * span) < FEWEST_WRAPS:
        return 0.0
    # Readings run from one end to the other; what switches between two values is nowhere between them.
    if np.mean(np.abs(y - (y.max() + y.min()) / 2) < span / 4) < BETWEEN_ENDS:
        return 0.0
    jumps = sudden_steps(t, y)
    usual = max(1.4826 * float(np.median(np.abs(jumps))), tick)
    large = np.flatnonzero(np.abs(jumps) > max(WHOLE_RANGE / 2 * span, FAR * usual))
    if len(large) < FEWEST_WRAPS:
        return 0.0
    size = float(np.median(np.abs(jumps[large])))
    alike = np.abs(np.abs(jumps[large]) - size) < SAME_JUMP * size + FAR * usual
    if alike.mean() < ALL_JUMPS or not WHOLE_RANGE * size < span < (1 + SAME_JUMP) * size + FAR * usual:
        return 0.0
    # The steps beside a jump give the motion in it best, where they are none themselves.
    around = large[alike & (large > 0) & (large < len(steps) - 1)]
    around = around[~np.isin(around - 1, large) & ~np.isin(around + 1, large)]
    if len(around) >= FEWEST_WRAPS:
        rates = steps / np.diff(t)
        moved = steps[around] - (rates[around - 1] + rates[around + 1]) / 2 * np.diff(t)[around]
        size = float(np.median(np.abs(moved)))
    return _plain_period(size, tick)


def _plain_period(size: float, tick: float) -> float:
    """The plainest number near a measured period: whole ticks, and a whole fraction of a turn where that is as near."""
    plain = round(size / tick) * tick if tick > 0 else size
    parts = round(2 * np.pi / size)
    near = SAME_TICKS if tick > 0 else SAME_TURN
    if 1 <= parts <= MOST_DIVISIONS and abs(2 * np.pi / parts - plain) < near * plain:
        return 2 * np.pi / parts
    return plain


def period_findings(found: Float[np.ndarray, "n"], ticks: Float[np.ndarray, "n"], names: Names) -> list[Finding]:
    """A finding on the columns that wrap at a period which the model file does not state."""
    if not found.any():
        return []
    places = np.flatnonzero(found)
    parts = []
    for i in places:
        size, counts = f"{found[i]:.5g} {names.units[i]}".rstrip(), found[i] / ticks[i] if ticks[i] else 0.0
        text = f"all jumps of {names.q[i]} are ±{size}"
        text += f", {round(counts)} ticks" if counts > 1 else ""
        divisions = 2 * np.pi / found[i]
        if names.angles[i] and abs(divisions - round(divisions)) < 1e-6 and round(divisions) > 1:
            text += f", 1/{round(divisions)} of a turn"
        parts.append(f"{text}, and its readings stay within as much")
    texts = [f"{value:.9g}" if value else "0" for value in found]
    written = texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"
    where, evidence = ", ".join(names.q[i] for i in places), f"{'; '.join(parts)}: the sensor wraps there"
    return [Finding("period", where, evidence, f"[measurement] period = {written}", True, {"period": found.tolist()})]


def moved_zeros(case: Case, read: Float[np.ndarray, "T n"], rows: Rows) -> Iterator[Suspicion]:
    """Suspect that the zero of a position is another one from a row on, the largest jumps first.

    `read` are the positions with their outliers: a jump makes the readings beside it look like some.
    """
    t, y, found = rows.t, unwrap(np.asarray(case.record.y), case.model.circles), []
    for i, tick in enumerate(case.ticks):
        seen = np.flatnonzero(np.isfinite(y[:, i]))
        if len(seen) < FEWEST:
            continue
        steps, passed = np.diff(y[seen, i]), np.diff(t[seen])
        # The motion in a step is that of the steps before and after it, which an outlier among them does not change.
        rates = np.pad(steps / passed, 3, mode="edge")
        medians = np.median(np.lib.stride_tricks.sliding_window_view(rates, 3), axis=1)
        beside = rates[2:-4] + rates[4:-2], medians[: len(steps)] + medians[4:]
        near, far = (steps - passed * each / 2 for each in beside)
        jumps = np.where(np.abs(near) < np.abs(far), near, far)  # of a fast motion the steps next to it say more
        usual = max(1.4826 * float(np.median(np.abs(jumps))), float(tick), np.finfo(float).tiny)
        large = np.flatnonzero(np.abs(jumps) > OFF_ZERO * usual)
        large = large[np.abs(jumps[large]) > OFF_ZERO * local_std(jumps, large)]
        for k in large[np.argsort(-np.abs(jumps[large]))[:MOST_ZEROS]]:
            between = np.nan_to_num(np.abs(np.diff(read[seen[k] : seen[k + 1] + 1, i])))
            row = int(seen[k] + 1 + np.argmax(between))
            largest = np.delete(np.abs(steps - jumps * (np.abs(jumps) > OFF_ZERO * usual)), k).max()
            at_once = between.max() > abs(jumps[k]) / 2 and t[row] - t[row - 1] < GAP * np.median(passed)
            certain = at_once and abs(jumps[k]) > SUDDEN * largest
            found.append((-float(abs(jumps[k]) / usual), i, row, float(jumps[k]), bool(certain)))
    for _, i, row, jump, certain in sorted(found)[:MOST_ZEROS]:
        name, unit, time = case.names.q[i], case.names.units[i], float(t[row])
        size = f"{jump:.3g} {unit}".rstrip()
        claim = f"{name} jumps by {size} at {rows.named(row)}, and goes on from there"
        line = (
            f"until = {stated_time(time)} keeps the rows before that; or subtract {size} from {name} from there on; "
            f"look for a coupling that slips, steps that are lost, or a zero that is set anew"
        )

        def apply(case: Case, i: int = i, time: float = time, jump: float = jump) -> Case:
            moved = np.array(case.record.y, float)
            moved[np.asarray(case.record.t) >= time, i] -= jump
            return case.with_readings(moved)

        numbers = {"jump": jump, "begin": time, "end": time}
        words = "without this jump"
        threshold = "certain" if certain else "part of the log"
        yield Suspicion("zero of a position", name, words, line, apply, threshold, claim, numbers)


def second_sender(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> Bool[np.ndarray, "T"] | None:
    """Rows of the rarer of two motions from which the readings of a column come in turn; None if it is one motion."""
    seen = np.flatnonzero(np.isfinite(y))
    if len(seen) < 2 * FEWEST:
        return None
    second = _follow(t[seen], y[seen])
    # Where the motions meet, or an outlier is followed, the two may change places: the rarer one is so in each part.
    for part in np.array_split(np.arange(len(seen)), max(len(seen) // (2 * FEWEST), 1)):
        second[part] ^= second[part].mean() > 0.5
    rare, usual = seen[second], seen[~second]
    switches = np.count_nonzero(np.diff(second.astype(int)) == 1)
    if len(rare) < max(FEWEST / 2, MINORITY * len(seen)) or switches < FEWEST / 5:
        return None
    distance = np.abs(y[rare] - np.interp(t[rare], t[usual], y[usual]))
    error = _usual_error(t[usual], y[usual])
    # Outliers form no motion: the readings that are apart have to predict each other, between readings of
    # the first motion.
    after = np.searchsorted(usual, rare)
    inside = (after > 0) & (after < len(usual))
    before, after = usual[np.maximum(after - 1, 0)], usual[np.minimum(after, len(usual) - 1)]
    apart = (distance > APART * error + np.abs(y[after] - y[before])) & (after - before <= MOST_TOGETHER) & inside
    if apart.sum() < max(FEWEST / 2, MINORITY * len(seen)):
        return None
    # A sender moves; cells that were lost and filled by a number do not.
    middle = np.median(y[rare[apart]])
    if np.median(np.abs(y[rare[apart]] - middle)) <= error:
        return None
    among = _usual_error(t[rare[apart]], y[rare[apart]])
    if not APART * max(error, among) < float(np.median(distance[apart])):
        return None
    # Of one fast motion each half predicts the other: only readings of two motions do not predict each other.
    edges = second & (np.insert(~second[:-1], 0, False) | np.append(~second[1:], False))
    if not APART * error < float(np.median(np.abs(prediction_errors(t[seen], y[seen])[edges]))):
        return None
    rows = np.zeros(len(y), bool)
    rows[rare] = True
    return rows


def _usual_error(t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T"]) -> float:
    return 1.4826 * float(np.median(np.abs(prediction_errors(t, y))))


def _follow(t: np.ndarray, y: np.ndarray) -> Bool[np.ndarray, "T"]:
    """Assign each reading to one of two motions, each of which its last two readings predict.

    Where the motions cross a reading fits both, and only later ones tell: the `HYPOTHESES` best assignments go on.
    """
    second = np.zeros(len(y), bool)
    # The second motion begins at the largest step among the first readings, which is one from the first motion to it.
    begin = int(np.argmax(np.abs(np.diff(y[: 2 * FEWEST])))) + 1
    second[begin] = True
    for order in (range(begin + 1, len(y)), range(begin - 2, -1, -1)):
        one, other = (t[begin - 1], y[begin - 1], 0.0), (t[begin], y[begin], 0.0)
        beam: list[tuple[float, Any, Any]] = [(0.0, (one, other), None)]
        for k in order:
            extended = {}
            for cost, motions, path in beam:
                for which in (0, 1):
                    motion, error = _extend(motions[which], t[k], y[k])
                    pair = (motion, motions[1]) if which == 0 else (motions[0], motion)
                    total = cost + error
                    if pair not in extended or total < extended[pair][0]:
                        extended[pair] = (total, pair, (which, path))
            beam = heapq.nsmallest(HYPOTHESES, extended.values(), key=lambda each: each[0])
        path = beam[0][2]
        for k in reversed(order):
            second[k], path = bool(path[0]), path[1]
    return second


def _extend(motion: tuple[float, float, float], t: float, y: float) -> tuple[tuple[float, float, float], float]:
    """A motion (time, position, velocity) after another reading, and how far that is from where the motion leads."""
    time, position, velocity = motion
    step = t - time
    # Noise of two readings that are close makes their slope useless, so that the last reading alone may predict better.
    error = min(abs(y - position), abs(y - position - velocity * step))
    return (t, y, (y - position) / step), error


def sender_finding(second: Bool[np.ndarray, "T"], name: str, rows: Rows) -> Finding:
    """The finding on rows that come from a second sender."""
    places = np.flatnonzero(second)
    evidence = f"the readings come from two motions in turn: {len(places)} of {len(second)} rows are "
    evidence += f"of the rarer one, {rows.listed(places)}"
    line = f"keep the rows of one sender, or leave the cells of {name} empty in those of the other"
    numbers = {"rows": len(places), "share": float(second.mean())}
    return Finding("several senders", name, evidence, line, True, numbers)
