"""Readings that were not read: those that repeat the row before, although the position moves, or lie between others."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case, without_rows
from covariant.calibration.diagnosis._finding import MOST_NAMED, Finding, Names, Rows, stated_time
from covariant.calibration.diagnosis._readings import ROUNDING, readings
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import (
    ABRUPT,
    AROUND,
    AT_REST,
    FAST_TICKS,
    FEW_REPEATED,
    FEWEST_FAST,
    HELD_ROWS,
    HELD_TICKS,
    HELD_TIMES,
)
from covariant.logs import Register

EDGE_ROWS = (3, 6, 12, 25, 50)
"""Rows beside a run of equal readings in which its motion is looked at: the fewest in which it exceeds the ticks."""
MOST_RUNS = 3
"""Longest runs of equal readings that are suspected."""


def made_rows(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"], names: Names, rows: Rows
) -> tuple[Bool[np.ndarray, "T n"], list[Finding]]:
    """Readings (T, n) that lie on the line between others, in all but every k-th row, and findings on them."""
    made, findings = np.zeros(y.shape, bool), []
    for i, column in enumerate(y.T):
        every, first = Register.read_rows(t, column)
        if every == 1:
            continue
        made[:, i] = np.arange(len(t)) % every != first
        begin = f" --from {t[first] - t[0]:.6g}" if first else ""
        evidence = f"only one in {every} rows was read, {rows.named(first)} and every {every} rows from there: the "
        evidence += "others lie on the line between readings, and show neither noise nor ticks"
        line = f"leave them out by --every {every * rows.every}{begin}, or leave these cells empty"
        numbers = {"every": every, "first": first}
        findings.append(Finding("interpolated rows", names.q[i], evidence, line, True, numbers))
    return made, findings


def find_repeats(
    y: Float[np.ndarray, "T n"], ticks: Float[np.ndarray, "n"], names: tuple[str, ...], rows: Rows
) -> tuple[Bool[np.ndarray, "T n"], list[Finding]]:
    """Readings (T, n) that repeat those of the row before, although the position moves, and findings on them.

    An encoder reads the same number until its next tick; a reading with noise is never the same twice.
    """
    same = np.concatenate([np.zeros((1, y.shape[1]), bool), np.diff(y, axis=0) == 0])
    moving = (ticks == 0) & (np.nanmin(y, axis=0) < np.nanmax(y, axis=0))
    repeated, findings = same & moving, []
    whole = same[:, moving].all(axis=1) & moving.any()
    places, share = np.flatnonzero(whole), float(whole[1:].mean())
    line = "the sensor is slower than the log, or rows were copied: leave the cells that repeat empty"
    if (share > FEW_REPEATED or len(places) > MOST_NAMED) and not _only_at_rest(y[:, moving], whole):
        # Distances between changes of the reading are the lengths of its runs.
        runs = np.diff(np.flatnonzero(np.append(~whole, True)))
        usual = int(np.median(runs[runs > 1]))
        evidence = f"{len(places)} of {len(y)} rows ({100 * share:.2g} %) repeat the readings of the row before, "
        evidence += f"usually {usual} in a row have the same: {rows.listed(places)}"
        where, numbers = ", ".join(np.array(names)[moving]), {"rows": len(places), "share": share, "in_a_row": usual}
        findings.append(Finding("repeated rows", where, evidence, line, share > FEW_REPEATED, numbers))
    for i in np.flatnonzero(ticks > 0):
        fast = _fast(y[:, i], float(ticks[i]))
        share = float(same[fast, i].mean()) if fast.sum() >= FEWEST_FAST else 0.0
        if share <= HELD_TICKS:
            continue
        repeated[:, i] = same[:, i] & fast
        places = np.flatnonzero(repeated[:, i])
        evidence = f"of {fast.sum()} rows between which {names[i]} moves by more than a tick, {100 * share:.2g} % "
        evidence += f"repeat the reading of the row before: {rows.listed(places)}"
        if not moving.any():
            numbers = {"rows": len(places), "share": share}
            findings.append(Finding("repeated rows", names[i], evidence, line, True, numbers))
    return repeated, findings


def _fast(y: Float[np.ndarray, "T"], tick: float) -> Bool[np.ndarray, "T"]:
    """Rows (T,) around which an encoder moves by more than a tick a row."""
    fast = np.zeros(len(y), bool)
    if len(y) > 2 * AROUND:
        wide = y[2 * AROUND :] - y[: -2 * AROUND]
        # The same direction on both sides, so that a turn or a spike is no motion.
        there = (y[AROUND:-AROUND] - y[: -2 * AROUND]) * wide > 0
        fast[AROUND:-AROUND] = there & (np.abs(wide) > FAST_TICKS * 2 * AROUND * tick)
    return fast


def _only_at_rest(y: Float[np.ndarray, "T k"], same: Bool[np.ndarray, "T"]) -> bool:
    """Whether readings repeat at rest, and hardly in the fastest quarter of the motion: those of a coarse encoder."""
    if len(y) < 8 * AROUND:
        return False
    moved = np.nan_to_num(np.abs(y[2 * AROUND :] - y[: -2 * AROUND]))
    fastest = (moved > np.quantile(moved, 0.75, axis=0)).any(axis=1)
    return bool(same[AROUND:-AROUND][fastest].mean() < AT_REST * same.mean()) if fastest.any() else False


def stuck(case: Case, read: Float[np.ndarray, "T n"], rows: Rows) -> Iterator[Suspicion]:
    """Suspect that positions were not read in a span in which they keep one value, the longest first.

    At rest an encoder reads one value as well, but it comes to rest and leaves it slowly. A turn takes at most five
    times as long as the ticks beside it. `read` are the positions with their outliers, which the last readings of a
    span may look like.
    """
    t, y = rows.t, read
    spans: dict[tuple[int, int], str] = {}  # thresholds
    white = None
    for i, column in enumerate(y.T):
        seen = np.flatnonzero(np.isfinite(column))
        x = column[seen]
        edges = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]]))
        lengths = np.diff(edges)
        for k in np.flatnonzero(lengths >= HELD_ROWS) if len(lengths) > 1 else ():
            begin, end = edges[k], edges[k + 1] - 1
            white = readings(case.record, case.model.circles).white if white is None else white
            smallest = max(8 * float(case.ticks[i]), ROUNDING * float(np.abs(x).max()))
            sides = ((lengths[max(k - 2, 0) : k], x[begin::-1]), (lengths[k + 1 : k + 3], x[end:]))
            longer = [lengths[k] >= HELD_TIMES * beside.max(initial=1) for beside, _ in sides]
            at_once = any(long and _abrupt(away, smallest) for long, (_, away) in zip(longer, sides, strict=True))
            # A reading with noise is never the same twice, at rest neither.
            noisy = case.ticks[i] == 0 and bool(white[i])
            if at_once or all(longer):
                span = int(seen[begin]), int(seen[end])
                found = "certain" if noisy else "part of the log" if at_once else "rest"
                spans[span] = min(spans.get(span, found), found)  # in the order of the alphabet
    for begin, end in sorted(spans, key=lambda span: span[0] - span[1])[:MOST_RUNS]:
        # Columns of one sender stop together, with a row more or less where one of them turned.
        parts = [column[begin + 1 : end][np.isfinite(column[begin + 1 : end])] for column in y.T]
        held = {i: part[0] for i, part in enumerate(parts) if len(part) and np.ptp(part) == 0 < np.nanstd(y[:, i])}
        where = ", ".join(case.names.q[i] for i in held)
        texts = (f"{case.names.q[i]} reads {value:.6g} {case.names.units[i]}".rstrip() for i, value in held.items())
        claim = f"{' and '.join(texts)} in all rows from {rows.named(begin)} to {rows.named(end)}"
        line = f"leave the cells of {where} empty there; look at the sensor, its cable and what may hold it still"
        if end >= len(t) - 1 - HELD_ROWS:
            line = f"until = {stated_time(t[begin])} keeps the rows before that; or {line}"
        elif begin <= HELD_ROWS:
            line = f"start = {stated_time(t[end + 1])} keeps the rows after that; or {line}"
        numbers = {"rows": end - begin + 1, "begin": float(t[begin]), "end": float(t[end])}
        apply = without_rows(list(held), float(t[begin]), float(t[end]))
        words = "without these readings"
        yield Suspicion("repeated rows", where, words, line, apply, spans[begin, end], claim, numbers)


def _abrupt(x: Float[np.ndarray, "k"], smallest: float) -> bool:
    """Whether readings after a run of equal ones, outward from its value, go on at once with their speed."""
    for count in EDGE_ROWS:
        if len(x) <= 2 * count:
            return False
        first, second = abs(x[count] - x[0]), abs(x[2 * count] - x[count])
        if first > smallest:
            # From rest, at a constant acceleration, the second stretch is at least twice as long as the first.
            return bool(first > ABRUPT * second)
    return False
